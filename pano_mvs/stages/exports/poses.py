"""Export of the poses for other photogrammetry programs."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from pano_mvs.api import All, Context, Files, One, Panorama, Params, Poses, stage
from pano_mvs.io.poses.metashape import write_metashape
from pano_mvs.io.poses.openmvg import write_openmvg
from pano_mvs.scene.files import group_file
from pano_mvs.scene.pose_groups import split_groups
from pano_mvs.scene.upright import world_up, z_up_from_world


class PosesParams(Params):
    """Settings of export.poses."""

    programs: tuple[Literal["openmvg", "metashape"], ...] = Field(
        default=("openmvg", "metashape"), description="programs whose files are written"
    )


@stage("export.poses")
def poses_files(poses: One[Poses], images: All[Panorama], params: PosesParams, ctx: Context) -> Files:
    """Write the poses as poses/sfm_data.json for openMVG, with points and tracks, and poses/cameras.xml for Metashape.

    Cameras are spherical and have the size of the image files. Both files have the world of the poses; the component in
    Metashape's file turns it so that z points up. Further groups of poses are sfm_data_1.json, cameras_1.xml …
    """
    files: dict[str, Path] = {}
    sizes_hw = {name: image.source_size_hw for name, image in images.items()}
    for number, group in enumerate(split_groups(poses)):
        if "openmvg" in params.programs:
            name = group_file("sfm_data.json", number)
            files[f"poses/{name}"] = ctx.scratch / name
            write_openmvg(ctx.scratch / name, group, sizes_hw)
        if "metashape" in params.programs:
            name = group_file("cameras.xml", number)
            files[f"poses/{name}"] = ctx.scratch / name
            turn = z_up_from_world(world_up(group))
            write_metashape(ctx.scratch / name, group, sizes_hw, file_from_world=turn)
    return Files(files)
