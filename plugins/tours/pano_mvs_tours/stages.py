"""The stages of tours."""

from pano_mvs_tours.exports import panoramas, tour_of_panoramas
from pano_mvs_tours.house import house_file, links
from pano_mvs_tours.source import tour

__all__ = ["house_file", "links", "panoramas", "tour", "tour_of_panoramas"]
