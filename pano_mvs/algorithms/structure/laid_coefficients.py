"""The coefficients that `python -m tools benchmarks depth.laid` has fitted."""

from pano_mvs.algorithms.logistic import Model, Term

FITTED = Model(
    3.085,
    {
        "nearer": Term((1.04, 0.8681, 0.4992, 0.2026, 0.08751), (0.194, 1.7446, 0.6976, 0.428), 0.0),
        "clash": Term((111.9, 74.7, 47.0, 20.0, 4.0), (0.3674, 0.0, 0.1602, 0.9187), 0.3163),
        "unlike": Term((137.0, 92.0, 63.0, 31.0, 8.579), (0.8597, 0.0, 0.0, 2.122), 1.174),
    },
)
