"""The coefficients that `python -m tools benchmarks depth.laid` has fitted."""

from pano_mvs.algorithms.logistic import Model, Term

FITTED = Model(
    3.1452,
    {
        "nearer": Term((1.091, 0.9387, 0.6235, 0.2256, 0.0908), (0.0, 1.2023, 0.8035, 0.6989), 0.0),
        "unlike": Term((120.0, 86.0, 54.6, 22.79, 5.268), (0.0, 0.7694, 0.631, 2.4666), 1.4553),
        "through": Term((5.038, 2.013, 0.6687, 0.0), (1.0538, 1.0828, 0.5141), 0.0),
    },
)
