"""A source that reads the scenes of a virtual tour."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pano_mvs.algorithms.faces.sampling import panorama_from_cube
from pano_mvs.api import Context, FilePart, InputError, Panorama, Params, SourceItem, SourcePath, source
from pano_mvs.io.images.tours import FACES, list_scenes
from pano_mvs.scene.image_files.image_file import decode_image, write_png


class TourParams(Params):
    """Settings of source.tour."""

    path: SourcePath = Field(description="folder of the tour, searched recursively")
    nadir_deg: float = Field(default=0.0, ge=0, le=90, description="ignore this angle around straight down (tripod)")
    zenith_deg: float = Field(default=0.0, ge=0, le=90, description="ignore this angle around straight up")
    max_width: int = Field(default=4096, ge=16, description="wider panoramas are scaled down to this width")


def list_tour(params: TourParams) -> Iterator[SourceItem]:
    """List the scenes of a tour.

    Raises:
        InputError: if there are fewer than two.
    """
    notes: list[str] = []
    scenes = list_scenes(params.path, notes)
    if len(scenes) < 2:
        raise InputError(f"{params.path}: contains only one scene ({scenes[0].name}); depth needs two or more")
    for scene in scenes:
        files = {f"{face}_{row}_{column}": path for (face, row, column), path in scene.tiles.items()}
        yield SourceItem(f"{scene.name}.png", files, notes=tuple(notes))


@source("source.tour", list_items=list_tour, memory="1GB")
def tour(item: SourceItem, params: TourParams, ctx: Context) -> Panorama:
    """Read the panoramas of a virtual tour from the tiles of their cubes, in the finest resolution.

    Known are the tiles of Marzipano, Pannellum and krpano, and six files for each scene. The panoramas are stored
    without loss, as `<scene>.png`, with the front face in the middle.
    """
    faces = {face: _joined(item, face) for face in FACES}
    side = faces["f"].shape[0]
    width = min(params.max_width, 4 * side) // 4 * 4
    kept = ctx.scratch / "panorama.png"
    write_png(kept, panorama_from_cube(faces, width))
    size_hw = width // 2, width
    ctx.metric("face_px", side)
    return Panorama(
        image=FilePart(kept),
        size_hw=size_hw,
        source_size_hw=size_hw,
        nadir_deg=params.nadir_deg,
        zenith_deg=params.zenith_deg,
    )


def _joined(item: SourceItem, face: str) -> NDArray[np.uint8]:
    """Return a face from its tiles."""
    tiles = {tuple(map(int, key.split("_")[1:])): key for key in item.files if key.startswith(f"{face}_")}
    rows = [
        [_picture(item, tiles[row, column]) for column in sorted({column for _, column in tiles})]
        for row in sorted({row for row, _ in tiles})
    ]
    try:
        return np.ascontiguousarray(np.concatenate([np.concatenate(row, axis=1) for row in rows], axis=0))
    except ValueError as error:
        place = item.file(tiles[0, 0]).path
        raise InputError(
            f"{place}: this tile and those beside it do not fit together. Export the tour again"
        ) from error


def _picture(item: SourceItem, key: str) -> NDArray[np.uint8]:
    file = item.file(key)
    return decode_image(file.path, file.read_bytes())
