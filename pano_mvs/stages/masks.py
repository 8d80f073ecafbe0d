"""Masks: stages that mask further areas of panoramas, which later stages then ignore."""

from __future__ import annotations

from pydantic import Field

from pano_mvs.algorithms.masks.one_color import areas_of_color
from pano_mvs.api import Context, Each, Panorama, Params, arguments_from, params_from, stage


@params_from(areas_of_color)
class ColorParams(Params):
    """Settings of mask.color."""

    color: str = Field(default="#000000", pattern="^#[0-9a-fA-F]{6}$", description="colour to ignore, as #rrggbb")


@stage("mask.color")
def color(image: Each[Panorama], params: ColorParams, ctx: Context) -> Panorama:
    """Mask large areas of one colour, such as black areas left by a stitcher or a white disc over the tripod."""
    red, green, blue = bytes.fromhex(params.color[1:])
    found = areas_of_color(
        image.load(),
        (red, green, blue),
        **arguments_from(areas_of_color, params),
    )
    ctx.metric("masked", float(found.mean()))
    return image.with_mask(~found, ctx.scratch)
