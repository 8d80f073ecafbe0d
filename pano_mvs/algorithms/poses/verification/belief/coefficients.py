"""The coefficients that `python -m tests.benchmarks.belief.refit` has fitted."""

from pano_mvs.algorithms.poses.verification.belief.model import Model, Term

FITTED = Model(
    6.4038,
    {
        "ratio": Term((0.088, 0.4129, 0.806, 0.9295, 1.013), (0.9347, 0.5563, 0.6364, 0.0), 0.7726),
        "share": Term((0.0159, 0.03368, 0.08124, 0.2645, 0.4962), (0.0, 0.218, 1.9343, 0.832), 0.7726),
        "agreeing": Term((0.0, 1.0, 3.0), (1.9021, 0.9138), 0.0),
        "scale_worst": Term((0.0287, 0.0143, 0.007467, 0.003478, 0.001398), (0.6744, 0.6705, 0.4291, 1.0381), 1.4293),
        "place_rival": Term((1.516, 1.0, 0.7389, 0.2209, 0.0), (0.4851, 0.0, 0.0, 0.6433), 1.5632),
        "repeats": Term((1.127, 0.8022, 0.6563, 0.3824, 0.02854), (0.0, 0.0, 0.2974, 0.9417), 0.0),
        "joint_contradicting": Term((0.9731, 0.2185, 0.0711, 0.04633, 0.02469), (0.0, 0.0, 0.5985, 0.8613), 0.0963),
    },
)
