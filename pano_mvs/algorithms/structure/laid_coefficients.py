"""The coefficients that `python -m tools benchmarks depth.laid` has fitted."""

from pano_mvs.algorithms.logistic import Model, Term

FITTED = Model(
    3.4521,
    {
        "nearer": Term((1.059, 0.8728, 0.505, 0.1993, 0.0), (0.1935, 1.5595, 0.6347, 0.8912), 0.0),
        "unlike": Term((124.7, 80.03, 49.24, 20.0, 5.065), (0.0739, 0.2482, 0.8951, 2.5429), 1.4818),
    },
)
