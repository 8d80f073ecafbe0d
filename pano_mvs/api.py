"""The one import that the author of a plugin needs.

from pano_mvs.api import Context, Each, Near, Panorama, Params, Pose, RangeMap, stage

class MySweepParams(Params):
    planes: int = 128

@stage("depth.my_sweep", version=1)
def my_sweep(ref: Each[Panorama], pose: Each[Pose], sources: Near[Panorama], source_poses: Near[Pose],
             params: MySweepParams, ctx: Context) -> RangeMap: ...
"""

from pano_mvs.core.errors import GateError, InputError, PanoMvsError, UsageError
from pano_mvs.engine.context import Context
from pano_mvs.engine.params import NOT_IN_KEY, InputPath, Params, SourcePath
from pano_mvs.engine.ports import All, Each, Names, Near, One
from pano_mvs.engine.stage import SourceItem, source, stage
from pano_mvs.geometry import Rigid3, Similarity3
from pano_mvs.scene import (
    Axis,
    Features,
    FilePart,
    Files,
    GlobalDescriptor,
    Pairs,
    Panorama,
    PointCloud,
    Pose,
    Poses,
    RangeMap,
    Record,
    Scores,
    TwoView,
    Views,
)

__all__ = [
    "NOT_IN_KEY",
    "All",
    "Axis",
    "Context",
    "Each",
    "Features",
    "FilePart",
    "Files",
    "GateError",
    "GlobalDescriptor",
    "InputError",
    "InputPath",
    "Names",
    "Near",
    "One",
    "Pairs",
    "PanoMvsError",
    "Panorama",
    "Params",
    "PointCloud",
    "Pose",
    "Poses",
    "RangeMap",
    "Record",
    "Rigid3",
    "Scores",
    "Similarity3",
    "SourceItem",
    "SourcePath",
    "TwoView",
    "UsageError",
    "Views",
    "source",
    "stage",
]
