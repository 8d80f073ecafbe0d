"""The coefficients that `python -m tests.benchmarks.belief.refit` has fitted."""

from pano_mvs.algorithms.poses.verification.belief.model import Model, Term

FITTED = Model(
    6.24,
    {
        "ratio": Term((0.06537, 0.263, 0.35), (0.8355, 1.3683), 0.6932),
        "share": Term((0.01387, 0.02752, 0.0682, 0.2393, 0.4812), (0.0, 0.0, 2.0353, 0.9998), 0.6932),
        "agreeing": Term((0.0, 1.0, 3.0), (2.2976, 0.7946), 0.0),
        "scale_worst": Term((0.02917, 0.0143, 0.007187, 0.003317, 0.001222), (0.8145, 0.8376, 0.2609, 1.0758), 1.2645),
        "place_rival": Term((1.589, 1.0, 0.7922, 0.2274, 0.0), (0.623, 0.0, 0.0, 0.8164), 1.8318),
        "repeats": Term((1.077, 0.8034, 0.6563, 0.3955, 0.01754), (0.0, 0.0, 0.514, 0.8488), 0.0),
        "joint_contradicting": Term((0.8852, 0.1732, 0.0711, 0.04689, 0.02375), (0.0, 0.0, 0.7864, 1.0999), 0.0),
    },
)
