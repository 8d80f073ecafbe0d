"""The cloud as LAS, LAZ and E57, which surveyors' programs read, and panoramas with their poses out of E57."""

from pano_mvs_las.sources import poses_e57, source_e57
from pano_mvs_las.stages import e57, las

__all__ = ["e57", "las", "poses_e57", "source_e57"]
