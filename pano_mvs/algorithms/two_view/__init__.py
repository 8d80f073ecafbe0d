"""Two-view geometry of panoramas: robust estimation of relative poses on the sphere, and their verification."""

from pano_mvs.algorithms.two_view.ransac import RelativePose, estimate_two_view
from pano_mvs.algorithms.two_view.verification import verify_pair

__all__ = ["RelativePose", "estimate_two_view", "verify_pair"]
