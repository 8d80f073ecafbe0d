"""The cloud as LAS, LAZ and E57: what surveyors' programs read."""

from pano_mvs_las.stages import e57, las

__all__ = ["e57", "las"]
