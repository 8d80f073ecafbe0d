"""Exports for COLMAP and what reads its files: sparse models and dense workspaces."""

from __future__ import annotations

from pano_mvs.api import All, Context, Files, One, Panorama, Poses, stage
from pano_mvs.io.colmap_model import write_colmap_model


@stage("export.colmap")
def colmap(poses: One[Poses], images: All[Panorama], ctx: Context) -> Files:
    """COLMAP model of EQUIRECTANGULAR cameras, with points and tracks, in colmap/sparse/0."""
    folder = ctx.scratch / "model"
    folder.mkdir()
    write_colmap_model(folder, poses, {name: images[name].source_size_hw for name in poses.names if name in images})
    return Files({f"colmap/sparse/0/{path.name}": path for path in sorted(folder.iterdir())})
