"""The coefficients that `python -m tools benchmarks belief.refit` has fitted."""

from pano_mvs.algorithms.logistic import Model, Term

FITTED = Model(
    5.952,
    {
        "ratio": Term((0.06537, 0.263, 0.35), (0.8178, 1.3615), 0.5233),
        "share": Term((0.01387, 0.02752, 0.0682, 0.25), (0.0, 0.0, 2.743), 0.5233),
        "agreeing": Term((0.0, 1.0, 3.0), (2.2409, 0.8667), 0.0),
        "scale_worst": Term((0.02917, 0.0143, 0.007187, 0.003317, 0.001222), (0.8443, 0.8306, 0.2542, 1.0555), 1.228),
        "place_rival": Term((1.589, 1.0, 0.7922, 0.2274, 0.0), (0.6032, 0.0, 0.0, 0.8091), 1.91),
        "repeats": Term((1.077, 0.8034, 0.6563, 0.3955, 0.01754), (0.0, 0.0, 0.5212, 0.871), 0.0),
        "joint_contradicting": Term((0.8852, 0.1732, 0.0711, 0.04689, 0.02375), (0.0, 0.0, 0.7923, 1.0105), 0.0),
    },
)
