"""The stages of two-lens cameras."""

from pano_mvs_rigs.source import dual_fisheye

__all__ = ["dual_fisheye"]
