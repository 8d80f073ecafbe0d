"""Immutable typed records that pass between stages, and how each is stored."""

from pano_mvs.scene.cloud import PointCloud
from pano_mvs.scene.features import Features, GlobalDescriptor, WeakImage, WeakImages
from pano_mvs.scene.files import Files
from pano_mvs.scene.house import House, PlacedBy
from pano_mvs.scene.panorama import Panorama, SceneLink
from pano_mvs.scene.poses import Pose, Poses, WorldAxes
from pano_mvs.scene.range_map import RangeMap
from pano_mvs.scene.record import Axis, FilePart, Part, Parts, Record
from pano_mvs.scene.rooms import Ceilings, RoomLines, RoomOutline
from pano_mvs.scene.scores import Scores
from pano_mvs.scene.two_view import Pairs, TwoView, TwoViews, Views

__all__ = [
    "Axis",
    "Ceilings",
    "Features",
    "FilePart",
    "Files",
    "GlobalDescriptor",
    "House",
    "Pairs",
    "Panorama",
    "Part",
    "Parts",
    "PlacedBy",
    "PointCloud",
    "Pose",
    "Poses",
    "RangeMap",
    "Record",
    "RoomLines",
    "RoomOutline",
    "SceneLink",
    "Scores",
    "TwoView",
    "TwoViews",
    "Views",
    "WeakImage",
    "WeakImages",
    "WorldAxes",
]
