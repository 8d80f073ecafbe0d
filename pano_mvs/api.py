"""The one import that the author of a plugin needs.

from pano_mvs.api import Context, Each, Near, Panorama, Params, Pose, RangeMap, stage

class MySweepParams(Params):
    planes: int = 128

@stage("depth.my_sweep")
def my_sweep(ref: Each[Panorama], pose: Each[Pose], sources: Near[Panorama], source_poses: Near[Pose],
             params: MySweepParams, ctx: Context) -> RangeMap: ...
"""

from pano_mvs.algorithms.sweep.backends.registry import register_sweep_backend
from pano_mvs.algorithms.sweep.costs.registry import register_sweep_cost
from pano_mvs.algorithms.sweep.preparation import SweepInput
from pano_mvs.algorithms.sweep.windows import CostWindow
from pano_mvs.algorithms.sweep.winner import Winners
from pano_mvs.core.errors import GateError, InputError, PanoMvsError, UsageError
from pano_mvs.core.parts import Parts
from pano_mvs.core.settings import setting
from pano_mvs.engine.stages.context import Context
from pano_mvs.engine.stages.params import NOT_IN_KEY, InputPath, Params, PartOf, SourcePath
from pano_mvs.engine.stages.ports import All, Each, Names, Near, One
from pano_mvs.engine.stages.settings import params_from, settings_from
from pano_mvs.engine.stages.stage import SourceItem, source, stage
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
from pano_mvs.scene.image_files.image_file import decode_image, write_png
from pano_mvs.scene.pose_groups import join_groups, per_group, split_groups

__all__ = [
    "NOT_IN_KEY",
    "All",
    "Axis",
    "Context",
    "CostWindow",
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
    "PartOf",
    "Parts",
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
    "SweepInput",
    "TwoView",
    "UsageError",
    "Views",
    "Winners",
    "decode_image",
    "join_groups",
    "params_from",
    "per_group",
    "register_sweep_backend",
    "register_sweep_cost",
    "setting",
    "settings_from",
    "source",
    "split_groups",
    "stage",
    "write_png",
]
