"""The stages of photographs."""

from pano_mvs_photographs.cloud_colors import photographs
from pano_mvs_photographs.localise_stage import localise

__all__ = ["localise", "photographs"]
