"""The relative pose of two panoramas: robust estimation on the sphere, and whether to believe it."""

from pano_mvs.algorithms.two_view.ransac import RelativePose, estimate_two_view
from pano_mvs.algorithms.two_view.verification import verify_pair

__all__ = ["RelativePose", "estimate_two_view", "verify_pair"]
