"""Everything that plugins import from pano_mvs; backends of the sweep also import `pano_mvs.api.sweep`.

from pano_mvs.api import Context, Each, Near, Panorama, Params, Pose, RangeMap, stage

class MySweepParams(Params):
    planes: int = 128

@stage("depth.my_sweep")
def my_sweep(ref: Each[Panorama], pose: Each[Pose], sources: Near[Panorama], source_poses: Near[Pose],
             params: MySweepParams, ctx: Context) -> RangeMap: ...
"""

from pano_mvs.algorithms.sweep.backends.registry import register_sweep_backend
from pano_mvs.algorithms.sweep.costs import register_sweep_cost
from pano_mvs.algorithms.sweep.preparation import SweepInput
from pano_mvs.algorithms.sweep.windows import CostWindow
from pano_mvs.algorithms.sweep.winner import Winners
from pano_mvs.algorithms.two_view.verification import verify_pair
from pano_mvs.core.errors import InputError, PanoMvsError, RunStoppedError, UsageError
from pano_mvs.core.named_registry import NamedRegistry
from pano_mvs.core.settings import Setting, checks_settings, setting
from pano_mvs.engine.stages.context import Context
from pano_mvs.engine.stages.params import (
    NOT_IN_KEY,
    InputPath,
    Params,
    ReadBy,
    RegisteredIn,
    SourcePath,
    arguments_from,
    params_from,
    settings_from,
)
from pano_mvs.engine.stages.stage import All, Each, Names, Near, One, SourceItem, is_only_planned, source, stage
from pano_mvs.geometry import (
    Rigid3,
    Similarity3,
    pad_panorama,
    pixel_from_ray,
    ray_from_pixel,
    ray_grid,
    roll_panorama,
    sample_panorama,
)
from pano_mvs.geometry.geodesy import lla_from_local
from pano_mvs.io.point_selection import CHUNK_POINTS, chunks, select_points
from pano_mvs.io.point_selection import SelectedPoints as KeptPoints
from pano_mvs.io.point_selection import Selection as PointSelection
from pano_mvs.scene import (
    Axis,
    Ceilings,
    Features,
    FilePart,
    Files,
    GlobalDescriptor,
    House,
    Pairs,
    Panorama,
    PlacedBy,
    PointCloud,
    Pose,
    Poses,
    RangeMap,
    Record,
    RoomLines,
    RoomOutline,
    SceneLink,
    Scores,
    TwoView,
    TwoViews,
    Views,
    WorldAxes,
)
from pano_mvs.scene.files import group_file
from pano_mvs.scene.image_file import decode_image, write_png
from pano_mvs.scene.pose_groups import join_groups, per_group, split_groups
from pano_mvs.scene.upright import world_up, y_up_from_world, z_up_from_world

__all__ = [
    "CHUNK_POINTS",
    "NOT_IN_KEY",
    "All",
    "Axis",
    "Ceilings",
    "Context",
    "CostWindow",
    "Each",
    "Features",
    "FilePart",
    "Files",
    "GlobalDescriptor",
    "House",
    "InputError",
    "InputPath",
    "KeptPoints",
    "NamedRegistry",
    "Names",
    "Near",
    "One",
    "Pairs",
    "PanoMvsError",
    "Panorama",
    "Params",
    "PlacedBy",
    "PointCloud",
    "PointSelection",
    "Pose",
    "Poses",
    "RangeMap",
    "ReadBy",
    "Record",
    "RegisteredIn",
    "Rigid3",
    "RoomLines",
    "RoomOutline",
    "RunStoppedError",
    "SceneLink",
    "Scores",
    "Setting",
    "Similarity3",
    "SourceItem",
    "SourcePath",
    "SweepInput",
    "TwoView",
    "TwoViews",
    "UsageError",
    "Views",
    "Winners",
    "WorldAxes",
    "arguments_from",
    "checks_settings",
    "chunks",
    "decode_image",
    "group_file",
    "is_only_planned",
    "join_groups",
    "lla_from_local",
    "pad_panorama",
    "params_from",
    "per_group",
    "pixel_from_ray",
    "ray_from_pixel",
    "ray_grid",
    "register_sweep_backend",
    "register_sweep_cost",
    "roll_panorama",
    "sample_panorama",
    "select_points",
    "setting",
    "settings_from",
    "source",
    "split_groups",
    "stage",
    "verify_pair",
    "world_up",
    "write_png",
    "y_up_from_world",
    "z_up_from_world",
]
