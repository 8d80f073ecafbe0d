"""A mask of the sky, and the cloud as text: a worked example of a plugin."""

from pano_mvs_example.sky_mask import sky
from pano_mvs_example.xyz_file import xyz

__all__ = ["sky", "xyz"]
