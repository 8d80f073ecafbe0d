"""The coefficients that `python -m tools benchmarks depth.laid` has fitted."""

from pano_mvs.algorithms.logistic import Model, Term

FITTED = Model(
    3.4215,
    {
        "nearer": Term((0.9728, 0.5702, 0.3558, 0.1915, 0.1003), (1.402, 0.2899, 0.8745, 0.3436), 0.0),
        "unlike": Term((113.0, 73.0, 41.0, 14.1, 4.317), (0.0, 0.6994, 1.3959, 1.5324), 1.5135),
        "through": Term((6.585, 2.668, 0.8329, 0.0), (0.0, 1.9721, 1.558), 0.0),
        "shared": Term((4.0, 3.0, 2.0, 1.0, 0.0), (0.4531, 0.3838, 0.1485, 0.6424), 0.0),
    },
)
