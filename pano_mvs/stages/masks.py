"""Masks: stages that mask further areas of panoramas, which later stages then ignore."""

from __future__ import annotations

from pydantic import Field

from pano_mvs.algorithms.masks.one_color import areas_of_color
from pano_mvs.api import Context, Each, Panorama, Params, stage


class ColorParams(Params):
    """Settings of mask.color."""

    color: str = Field(default="#000000", pattern="^#[0-9a-fA-F]{6}$", description="colour to ignore, as #rrggbb")
    tolerance: int = Field(default=8, ge=0, le=255, description="maximum difference of a channel, in grey levels")
    min_area_deg2: float = Field(default=4.0, ge=0, description="minimum size of an area, in square degrees")
    margin_px: int = Field(default=2, ge=0, le=64, description="width in pixels by which areas are dilated")


@stage("mask.color")
def color(image: Each[Panorama], params: ColorParams, ctx: Context) -> Panorama:
    """Mask large areas of one colour, such as black areas left by a stitcher or a white disc over the tripod."""
    red, green, blue = bytes.fromhex(params.color[1:])
    found = areas_of_color(
        image.load(),
        (red, green, blue),
        tolerance=params.tolerance,
        min_area_deg2=params.min_area_deg2,
        margin_px=params.margin_px,
    )
    ctx.metric("masked", float(found.mean()))
    return image.with_mask(~found, ctx.scratch)
