"""The scenes of a virtual tour, whose panoramas are six faces of a cube, whole or in tiles of several resolutions."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from pano_mvs.core.errors import InputError
from pano_mvs.core.text import shortened_list
from pano_mvs.io.images.captures import PICTURE_SUFFIXES, files_below, natural_key

FACES = "frblud"
_NAMES = {"front": "f", "right": "r", "back": "b", "left": "l", "up": "u", "top": "u", "down": "d", "bottom": "d"}
_FACE = "|".join([*_NAMES, *FACES])
# Scene, level, face, row and column in the path of a tile without its extension.
_LAYOUTS = (
    re.compile(r"(?P<scene>.*?)/?(?P<level>\d+)/(?P<face>[frblud])/(?P<row>\d+)/(?P<column>\d+)"),  # Marzipano
    re.compile(r"(?P<scene>.*?)/?(?P<level>\d+)/(?P<face>[frblud])(?P<row>\d+)_(?P<column>\d+)"),  # Pannellum
    re.compile(r"(?P<scene>.*?)(?:/[frblud]|/mres_[frblud])?/l(?P<level>\d+)(?:/[frblud])?/(?:\d+/)?"
               r"l\d+_(?P<face>[frblud])_(?P<row>\d+)_(?P<column>\d+)"),  # krpano
    re.compile(rf"(?P<scene>.*?)[/_.-]?(?P<face>{_FACE})", re.IGNORECASE),  # six files
)  # fmt: skip


@dataclass(frozen=True)
class TourScene:
    """One scene.

    Attributes:
        name: of its folder or the common part of its files, below the folder that all scenes share.
        tiles: file of each tile of the finest complete resolution, by face, row and column, which count from 0.
    """

    name: str
    tiles: Mapping[tuple[str, int, int], Path]


def list_scenes(folder: Path, notes: list[str]) -> list[TourScene]:
    """Return the scenes of a tour in natural order.

    Known are tiles of Marzipano (`2/f/0/1.jpg`), Pannellum (`2/f0_1.jpg`) and krpano (`l2/f/01/l2_f_01_02.jpg`), and
    six files (`hall_f.jpg`, `hall/front.jpg`).

    Args:
        folder: of the tour, or of its tiles.
        notes: a warning is appended for each scene without a complete cube.

    Raises:
        InputError: if there is no complete scene.
    """
    found: dict[str, dict[int, dict[tuple[str, int, int], Path]]] = {}
    for path in files_below(folder, notes):
        place = path.relative_to(folder).with_suffix("").as_posix()
        match = next((match for layout in _LAYOUTS if (match := layout.fullmatch(place))), None)
        if match is None or path.suffix.lower() not in PICTURE_SUFFIXES:
            continue
        groups = match.groupdict()
        face = _NAMES.get(groups["face"].lower(), groups["face"].lower())
        tile = face, int(groups.get("row") or 0), int(groups.get("column") or 0)
        found.setdefault(groups["scene"], {}).setdefault(int(groups.get("level") or 0), {})[tile] = path
    scenes = {name: tiles for name, levels in found.items() if (tiles := _finest(levels))}
    if incomplete := [name or folder.name for name in found if name not in scenes]:
        notes.append(f"{len(incomplete)} scenes have no complete cube and are skipped: {shortened_list(incomplete)}")
    if not scenes:
        raise InputError(
            f"{folder}: no tour here. Six faces of a cube are needed for each scene: tiles of Marzipano, Pannellum or "
            "krpano, or files such as hall_f.jpg, hall_r.jpg, hall_b.jpg, hall_l.jpg, hall_u.jpg and hall_d.jpg"
        )
    shared = os.path.commonpath([str(PurePosixPath(name).parent) for name in scenes]) if scenes else ""
    named = {_below(name, shared) or folder.name: tiles for name, tiles in scenes.items()}
    return [TourScene(name, named[name]) for name in sorted(named, key=natural_key)]


def _below(name: str, shared: str) -> str:
    return PurePosixPath(name).relative_to(shared).as_posix() if name else ""


def _finest(levels: Mapping[int, Mapping[tuple[str, int, int], Path]]) -> dict[tuple[str, int, int], Path]:
    """Return the tiles of the finest level in which all faces have the same rows and columns without a gap."""
    for level in sorted(levels, reverse=True):
        tiles = levels[level]
        rows, columns = sorted({row for _, row, _ in tiles}), sorted({column for _, _, column in tiles})
        expected = {(face, row, column) for face in FACES for row in rows for column in columns}
        gapless = all(places == list(range(places[0], places[-1] + 1)) and places[0] <= 1 for places in (rows, columns))
        if gapless and len(rows) == len(columns) and expected == set(tiles):
            return {(face, row - rows[0], column - columns[0]): path for (face, row, column), path in tiles.items()}
    return {}
