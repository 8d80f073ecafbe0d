"""The source of virtual tours: the panoramas of their scenes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pano_mvs.algorithms.faces.layout import arranged_faces
from pano_mvs.algorithms.faces.sampling import panorama_from_cube
from pano_mvs.api import Context, FilePart, InputError, Panorama, Params, SourceItem, SourcePath, source
from pano_mvs.scene.image_file import decode_image, write_png
from pano_mvs.stages.source import FolderParams, folder
from pano_mvs_tours.tour_configurations import FACES
from pano_mvs_tours.tour_folders import TourScene, list_scenes

_WHOLE = "panorama"  # the role of an equirectangular image among the files of a scene


class TourParams(Params):
    """Settings of source.tour."""

    path: SourcePath = Field(description="folder of the tour, searched recursively")
    nadir_deg: float = Field(default=0.0, ge=0, le=90, description="ignore this angle around straight down (tripod)")
    zenith_deg: float = Field(default=0.0, ge=0, le=90, description="ignore this angle around straight up")
    max_width: int = Field(default=4096, ge=16, description="wider panoramas are scaled down to this width")


def list_tour(params: TourParams) -> Iterator[SourceItem]:
    """List the scenes of a tour."""
    notes: list[str] = []
    scenes = list_scenes(params.path, notes)
    if len(scenes) < 2:
        raise InputError(f"{params.path}: contains only one scene ({scenes[0].name}); depth needs two or more")
    count = sum(len(scene.links) for scene in scenes)
    linked = f"; {count} links between them are hints for the selection of pairs" if count else ""
    notes.append(f"{len(scenes)} scenes of a virtual tour are read{linked}")
    items = {
        scene.name: f"{scene.name}{'.png' if scene.panorama is None else scene.panorama.suffix}" for scene in scenes
    }
    for scene in scenes:
        links = tuple(link._replace(name=items[link.name]) for link in scene.links)
        yield SourceItem(items[scene.name], _files_of(scene), notes=tuple(notes), links=links)


def _files_of(scene: TourScene) -> dict[str, Path]:
    if scene.panorama is not None:
        return {_WHOLE: scene.panorama}
    return {f"{face}_{row}_{column}": path for (face, row, column), path in scene.tiles.items()}


@source("source.tour", list_items=list_tour, memory="1GB")
def tour(item: SourceItem, params: TourParams, ctx: Context) -> Panorama:
    """Read the panoramas of a virtual tour from the tiles of their cubes, in the finest resolution.

    The configuration of Marzipano, Pannellum or krpano names the scenes, their tiles or equirectangular images, and
    their links. Without one, the tiles of these programs, skyboxes of Matterport, and six files for each scene are
    known by their names. Cubes are stored without loss, as `<scene>.png`, with the front face in the middle.
    """
    if _WHOLE in item.files:
        plain = FolderParams.model_validate(params.model_dump())
        image = SourceItem(item.name, {"image": item.files[_WHOLE]}, digests={"image": item.digests.get(_WHOLE, "")})
        return replace(folder(image, plain, ctx), links=item.links)
    faces, rearranged = arranged_faces({face: _joined(item, face) for face in FACES})
    if rearranged:
        ctx.note("the faces of {count} cubes did not fit together and were put in the order in which their edges do")
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
        links=item.links,
    )


def _joined(item: SourceItem, face: str) -> NDArray[np.uint8]:
    keys = (key for key in item.files if key.startswith(f"{face}_"))
    tiles = {tuple(map(int, key.split("_")[1:])): item.file(key) for key in keys}
    pictures = {place: decode_image(tile.path, tile.read_bytes()) for place, tile in tiles.items()}
    rows = [
        [pictures[row, column] for column in sorted({column for _, column in tiles})]
        for row in sorted({row for row, _ in tiles})
    ]
    try:
        return np.ascontiguousarray(np.concatenate([np.concatenate(row, axis=1) for row in rows], axis=0))
    except ValueError as error:
        raise InputError(
            f"{tiles[0, 0].path}: this tile and those beside it do not fit together. Export the tour again"
        ) from error
