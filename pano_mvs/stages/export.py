"""Exports: files that other programs open."""

from __future__ import annotations

from pydantic import Field

from pano_mvs.api import Context, Each, Files, One, Panorama, Params, PointCloud, RangeMap, stage
from pano_mvs.io.ply import write_ply
from pano_mvs.io.preview import write_preview
from pano_mvs.io.range_files import write_confidence_png, write_range_tiff


class PlyParams(Params):
    """Settings of export.ply."""

    quality: bool = Field(default=False, description="add to each point how many views agree, and its confidence")


@stage("export.ply")
def ply(cloud: One[PointCloud], params: PlyParams, ctx: Context) -> Files:
    """The fused cloud as cloud.ply: binary little endian, x y z nx ny nz red green blue."""
    path = ctx.scratch / "cloud.ply"
    write_ply(path, cloud, quality=params.quality)
    return Files({"cloud.ply": path})


@stage("export.ranges")
def ranges(range_map: Each[RangeMap], ctx: Context) -> Files:
    """Each range map as range/<image>.tiff (float32, NaN invalid) and confidence/<image>.png (8 bit, 0 invalid)."""
    tiff, png = ctx.scratch / "range.tiff", ctx.scratch / "confidence.png"
    write_range_tiff(tiff, range_map.range)
    write_confidence_png(png, range_map.confidence)
    return Files({"range/{item}.tiff": tiff, "confidence/{item}.png": png})


@stage("export.previews")
def previews(range_map: Each[RangeMap], image: Each[Panorama], ctx: Context) -> Files:
    """A picture for each view, preview/<image>.jpg: the panorama beside its colour-mapped range with a scale bar."""
    path = ctx.scratch / "preview.jpg"
    write_preview(path, image.load(), range_map.range)
    return Files({"preview/{item}.jpg": path})
