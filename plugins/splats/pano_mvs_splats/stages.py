"""The stages that write files for trainers."""

from pano_mvs_splats.nerfstudio import nerfstudio, nerfstudio_frames
from pano_mvs_splats.splat_bundle import splat_bundle, splat_frames

__all__ = ["nerfstudio", "nerfstudio_frames", "splat_bundle", "splat_frames"]
