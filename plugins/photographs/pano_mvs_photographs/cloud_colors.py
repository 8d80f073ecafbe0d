"""The stage that colours a cloud by photographs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from pano_mvs.api import (
    Context,
    One,
    Params,
    PointCloud,
    settings_from,
    stage,
)
from pano_mvs.scene.image_file import decode_image
from pano_mvs.scene.photographs import Photographs
from pano_mvs_photographs.camera import PhotographCamera
from pano_mvs_photographs.colors import PhotographColors, PhotographColorSettings


def colored_memory_bytes(_: Params, inputs: Mapping[str, Any]) -> int:
    """Return the memory for the cloud's colours and one photograph, of at most 50 megapixels."""
    return 700_000_000 + 400 * len(inputs["cloud"])


@stage("fusion.photographs", settings=PhotographColorSettings, memory=colored_memory_bytes)
def photographs(cloud: One[PointCloud], photographs: One[Photographs], params: Params, ctx: Context) -> PointCloud:
    """Colour the cloud by photographs that poses.localise has placed, where they see it.

    The exposure of each photograph is matched with the colours of the cloud. Points that are hidden, or look different
    in the photograph, keep their colours, as do the points of further groups of poses.
    """
    clouds = cloud.groups()
    if not clouds or not len(photographs):
        ctx.metric("colored", 0.0)
        return cloud
    colors = PhotographColors(clouds[0], settings_from(PhotographColorSettings, params))
    for idx, name in enumerate(photographs.names):
        camera = PhotographCamera(
            photographs.cam_from_world(idx), float(photographs.focals_px[idx]), float(photographs.radials[idx])
        )
        if not colors.add(decode_image(photographs.pictures[idx].path), camera):
            ctx.note(f"{name} shows too little of the cloud to colour it")
    ctx.metric("colored", colors.colored / max(1, len(clouds[0])))
    clouds[0] = replace(clouds[0], colors_rgb=colors.colors_rgb())
    return PointCloud.of_groups(clouds)
