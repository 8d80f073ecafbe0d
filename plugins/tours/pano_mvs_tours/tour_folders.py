"""The scenes of a virtual tour: the pictures of each, its name, and the scenes to which it leads."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path, PurePosixPath
from posixpath import join, normpath
from typing import TypeAlias
from urllib.parse import unquote

from pano_mvs.core.errors import InputError
from pano_mvs.core.file_names import item_problem, plain_title
from pano_mvs.core.text import shortened, shortened_list
from pano_mvs.io.images.captures import (
    PICTURE_SUFFIXES,
    UNSTITCHED_SUFFIXES,
    describe_picture,
    files_below,
    natural_key,
    unstitched_reason,
)
from pano_mvs.io.images.names import match_image_names, without_extension
from pano_mvs.scene import SceneLink
from pano_mvs_tours.tour_configurations import FACES, NAMES, Grid, StatedScene, stated_scenes

Tiles: TypeAlias = dict[tuple[str, int, int], Path]

_FACE = "|".join([*NAMES, *FACES])
_SKYBOX = dict(zip("012345", "ufrbld", strict=True))
# Scene, level, face, row and column in the path of a tile without its extension.
_TILES = (
    re.compile(r"(?P<scene>.*?)/?(?P<level>\d+)/(?P<face>[frblud])/(?P<row>\d+)/(?P<column>\d+)"),  # Marzipano
    re.compile(r"(?P<scene>.*?)/?(?P<level>\d+)/(?P<face>[frblud])(?P<row>\d+)_(?P<column>\d+)"),  # Pannellum
    re.compile(r"(?P<scene>.*?)(?:/[frblud]|/mres_[frblud])?/l(?P<level>\d+)(?:/[frblud])?/(?:\d+/)?"
               r"l\d+_(?P<face>[frblud])_(?P<row>\d+)_(?P<column>\d+)"),  # krpano
    re.compile(r"(?P<scene>.*?)[/_]?skybox(?P<face>[0-5])_sami"),  # Matterport3D
)  # fmt: skip
_SIX_FILES = (
    re.compile(r"(?P<scene>.*?)[/_.-]?skybox_?(?P<face>[0-5])"),  # Matterport
    re.compile(rf"(?P<scene>.*?)[/_.-]?(?P<face>{_FACE})", re.IGNORECASE),
)


@dataclass(frozen=True)
class TourScene:
    """One scene."""

    # its title in the tour's configuration; without one, the name of its folder or the common part of its files, below
    # the folder that all scenes share
    name: str
    # file of each tile of the finest complete resolution, by face, row and column, which count from 0; empty for an
    # equirectangular image
    tiles: Mapping[tuple[str, int, int], Path]
    links: tuple[SceneLink, ...] = ()  # to other scenes, by their names
    panorama: Path | None = None  # its equirectangular image, or None for a cube


def list_scenes(folder: Path, notes: list[str]) -> list[TourScene]:
    """Return the scenes of a tour, in the order of its configuration, or in natural order if there is none.

    The configuration is that of Marzipano (`data.js`), Pannellum or krpano. Without one, tiles of Marzipano
    (`2/f/0/1.jpg`), Pannellum (`2/f0_1.jpg`) and krpano (`l2/f/01/l2_f_01_02.jpg`), the six files of Matterport
    (`…_skybox0_sami.jpg`), and six files (`hall_f.jpg`, `hall/front.jpg`) are known.

    Raises:
        InputError: if there is no complete scene.
    """
    capture = _Capture(folder, list(files_below(folder, notes)))
    if scenes := list(_stated(capture, notes, notes)):
        return scenes
    found = _scenes(capture, _TILES)
    if not any(map(_finest, found.values())):
        found = _scenes(capture, _TILES + _SIX_FILES)
    complete = {name: tiles for name, levels in found.items() if (tiles := _finest(levels))}
    if incomplete := [name or folder.name for name in found if name not in complete]:
        notes.append(f"{len(incomplete)} scenes have no complete cube and are skipped: {shortened_list(incomplete)}")
    unstitched = next((path for path in capture.files if path.suffix.lower() in UNSTITCHED_SUFFIXES), None)
    if not complete and unstitched is not None:
        raise InputError(f"{folder}: no tour here, but {unstitched_reason(unstitched)}")
    if not complete:
        raise InputError(
            f"{folder}: no tour here. Six faces of a cube are needed for each scene: tiles of Marzipano, Pannellum or "
            "krpano, or files such as hall_f.jpg, hall_r.jpg, hall_b.jpg, hall_l.jpg, hall_u.jpg and hall_d.jpg"
        )
    shared = os.path.commonpath([str(PurePosixPath(name).parent) for name in complete])
    named = {_below(name, shared) or folder.name: tiles for name, tiles in complete.items()}
    return [TourScene(name, named[name]) for name in sorted(named, key=natural_key)]


def is_tour(folder: Path) -> bool:
    """Return whether a folder holds two scenes or more, and no other panorama.

    Scenes are complete cubes, or panoramas that a configuration joins by links with directions. Subfolders of cubes may
    hold other panoramas.

    Raises:
        InputError: if the names of its files alone show these cubes, because its configuration cannot be read.
    """
    try:
        capture = _Capture(folder, list(files_below(folder, [])))
    except InputError:
        return False
    cubes, whole, unreadable = _cubes(capture, _TILES), set[Path](), list[str]()
    if len(cubes) < 2:
        scenes = list(_stated(capture, [], unreadable))
        cubes = [dict(scene.tiles) for scene in scenes if scene.tiles]
        if any(link.direction_deg is not None for scene in scenes for link in scene.links):
            whole = {scene.panorama for scene in scenes if scene.panorama is not None}
    by_name = not cubes and bool(unreadable)
    if by_name:
        cubes = _cubes(capture, _TILES + _SIX_FILES)
    used = {path for tiles in cubes for path in tiles.values()} | whole
    others = (path for path in capture.pictures.values() if (whole or path.parent == folder) and path not in used)
    holds = len(cubes) + len(whole) > 1 and not any(map(_is_panorama, others))
    if holds and by_name:
        raise InputError(
            f"{unreadable[0]}. Correct the file, or read the scenes by the names of their files with "
            "--set images.use=source.tour"
        )
    return holds


def _cubes(capture: _Capture, layouts: Iterable[re.Pattern[str]]) -> list[Tiles]:
    return [tiles for levels in _scenes(capture, layouts).values() if (tiles := _finest(levels))]


def _is_panorama(path: Path) -> bool:
    try:
        return bool(describe_picture(path))
    except InputError:
        return False


class _Capture:
    """The files of a folder by their paths below it: what a configuration states is looked up here alone."""

    def __init__(self, folder: Path, files: Sequence[Path]) -> None:
        self.folder, self.files = folder, files
        found = [path for path in files if path.suffix.lower() in PICTURE_SUFFIXES]
        self.pictures = {path.relative_to(folder).as_posix(): path for path in found}
        self._stems = {_stem(name): path for name, path in self.pictures.items()}
        self._by_last_part = _by_last_part(self.pictures)
        self._cubes: dict[tuple[Path, int], Tiles] = {}

    def picture(self, url: str, place: str) -> Path | None:
        """Return the picture with a URL that counts from a folder, possibly in another format, or None."""
        name = normpath(join(place, unquote(url.partition("?")[0]).lstrip("/")))
        return self.pictures.get(name) or self._stems.get(_stem(name))

    def alike(self, url: str) -> Path | None:
        """Return the picture with the path most similar to a URL's, with the same name, or None."""
        name = _closest(normpath(unquote(url.partition("?")[0])), self._by_last_part)
        return None if name is None else self.pictures[name]

    def tiles(self, grid: Grid, place: str) -> Tiles:
        """Return the tiles of a cube, or nothing if one is missing, or one stands in two places."""
        first = self.picture(grid.url("f", 0, 0), place) if 0 < 6 * grid.side**2 <= len(self.pictures) else None
        if first is None:
            return {}
        if (first, grid.side) not in self._cubes:  # many scenes may name the same tiles
            self._cubes[first, grid.side] = self._all_tiles(grid, place)
        return self._cubes[first, grid.side]

    def _all_tiles(self, grid: Grid, place: str) -> Tiles:
        found: Tiles = {}
        for tile in product(FACES, range(grid.side), range(grid.side)):
            if (path := self.picture(grid.url(*tile), place)) is None:
                return {}
            found[tile] = path
        return found if len(set(found.values())) == len(found) else {}


def _stem(name: str) -> str:
    return str(PurePosixPath(name).with_suffix("")) if PurePosixPath(name).name else name


def _stated(capture: _Capture, notes: list[str], unreadable: list[str]) -> Iterator[TourScene]:
    """Yield the scenes that the configurations in a folder state; of two with the same pictures, the first one.

    Where the paths of its tiles show that a cube exists in a finer resolution than is stated, this one is used.
    Configurations that cannot be read are added to `unreadable`.
    """
    by_path = _scenes(capture, _TILES)
    cubes = {name: tiles for name, levels in by_path.items() if (tiles := _finest(levels))}
    by_last_part = _by_last_part(cubes)
    cube_of = {path: name for name in cubes for tiles in by_path[name].values() for path in tiles.values()}
    scenes, taken, missing = list[tuple[Path, StatedScene, Tiles, Path | None]](), set[Path](), list[str]()
    elsewhere = list[str]()
    files = [path for path in capture.files if path.suffix.lower() in {".js", ".json", ".xml", ".html", ".htm"}]
    files.sort(key=lambda path: (len(path.parts), natural_key(path.relative_to(capture.folder).as_posix())))
    for file in files[:200]:
        try:
            stated = stated_scenes(file)
        except (OSError, ValueError) as error:
            unreadable.append(f"{file}: not used as the configuration of a tour ({shortened(str(error), 200)})")
            continue
        for scene in stated:
            tiles, panorama = _pictures_of(scene, capture, file)
            finest = cubes.get(cube_of.get(tiles["f", 0, 0], ""), {}) if tiles else {}
            tiles = max(tiles, finest, key=len)
            if not tiles and panorama is None:
                tiles, panorama = _alike(scene, capture, file, cubes=cubes, by_last_part=by_last_part)
                elsewhere += [scene.title or scene.key] if tiles or panorama is not None else []
            pictures = set(tiles.values()) if panorama is None else {panorama}
            if not pictures:
                missing.append(scene.title or scene.key)
            elif taken.isdisjoint(pictures):
                taken |= pictures
                scenes.append((file, scene, tiles, panorama))
    if not scenes:
        if missing:
            notes.append(
                f"titles and links of {len(missing)} scenes are not used, since the paths in their configuration lead "
                f"to no pictures here: {shortened_list(missing)}"
            )
        return
    if elsewhere:
        notes.append(
            f"{len(elsewhere)} scenes have other paths or sizes in their configuration, and were found by the names of "
            f"their folders or files: {shortened_list(elsewhere)}"
        )
    if missing:
        notes.append(f"{len(missing)} scenes have no complete cube here and are skipped: {shortened_list(missing)}")
    unnamed = {name: tiles for name, tiles in cubes.items() if taken.isdisjoint(tiles.values())}
    if unnamed:
        notes.append(f"{len(unnamed)} cubes that no configuration names are used, too: {shortened_list(unnamed)}")
    for name in sorted(unnamed, key=natural_key):
        stated_by_path = StatedScene(name, PurePosixPath(name).name, ())
        scenes.append((capture.folder, stated_by_path, unnamed[name], None))
    names = _names([scene for _, scene, _, _ in scenes])
    by_key = {scene.key: name for (_, scene, _, _), name in zip(reversed(scenes), reversed(names), strict=True)}
    by_file = {(file, scene.key): name for (file, scene, _, _), name in zip(scenes, names, strict=True)}
    for (file, scene, tiles, panorama), name in zip(scenes, names, strict=True):
        links: dict[str, SceneLink] = {}
        for link in scene.links:
            target = by_file.get((file, link.target)) or by_key.get(link.target)
            if target and target != name and (target not in links or links[target].direction_deg is None):
                links[target] = SceneLink(target, link.direction_deg)
        yield TourScene(name, tiles, tuple(links.values()), panorama)


def _pictures_of(scene: StatedScene, capture: _Capture, file: Path) -> tuple[Tiles, Path | None]:
    """Return the pictures of a scene: those of its finest complete cube, or its equirectangular image.

    Paths count from the folder of the configuration, or from one above it, in which its page lies.
    """
    places = [place.as_posix() for place in PurePosixPath(file.relative_to(capture.folder).as_posix()).parents]
    for grid, place in product(scene.grids, places):
        if tiles := capture.tiles(grid, place):
            return tiles, None
    panoramas = (capture.picture(scene.panorama, place) for place in places if scene.panorama)
    return {}, next((path for path in panoramas if path is not None), None)


def _alike(
    scene: StatedScene,
    capture: _Capture,
    file: Path,
    *,
    cubes: Mapping[str, Tiles],
    by_last_part: Mapping[str, list[str]],
) -> tuple[Tiles, Path | None]:
    """Return the pictures of a scene whose stated paths do not exist: those with the most similar paths.

    A tour is configured for the place from which it was published, and may state other levels than its tiles have.
    """
    place = PurePosixPath(file.relative_to(capture.folder).as_posix()).parent.as_posix()
    paths = [normpath(join(place, unquote(grid.url("f", 0, 0).partition("?")[0]).lstrip("/"))) for grid in scene.grids]
    matches = (layout.fullmatch(_stem(path)) for path in paths for layout in _TILES)
    for stated in dict.fromkeys(match["scene"] for match in matches if match):
        if found := _closest(stated, by_last_part):
            return cubes[found], None
    urls = {face: grid.url(face, 0, 0) for grid in scene.grids if grid.side == 1 for face in FACES}
    files = {(face, 0, 0): path for face, url in urls.items() if (path := capture.alike(url)) is not None}
    if len(set(files.values())) == len(FACES):
        return files, None
    return {}, capture.alike(scene.panorama) if scene.panorama else None


def _by_last_part(names: Iterable[str]) -> dict[str, list[str]]:
    found: dict[str, list[str]] = {}
    for name in names:
        found.setdefault(_last_part(name), []).append(name)
    return found


def _closest(name: str, by_last_part: Mapping[str, list[str]]) -> str | None:
    """Return the name that has the same last part and shares most folders, or None if there is none or two do."""
    return match_image_names([name], by_last_part.get(_last_part(name), [])).get(name)


def _last_part(name: str) -> str:
    return PurePosixPath(without_extension(name)).name.casefold()


def _names(scenes: Sequence[StatedScene]) -> list[str]:
    """Return a name for each scene: its title, with its key if several have this title."""
    titles = [plain_title(scene.title) or plain_title(scene.key) or "scene" for scene in scenes]
    counts, names = Counter(title.casefold() for title in titles), list[str]()
    for title, scene in zip(titles, scenes, strict=True):
        name = title if counts[title.casefold()] == 1 else f"{title} ({plain_title(scene.key)})"
        name = name if not item_problem(f"{name}.png") else "scene"
        number = 2
        base, known = name, {other.casefold() for other in names}
        while name.casefold() in known:
            name, number = f"{base} {number}", number + 1
        names.append(name)
    return names


def _scenes(capture: _Capture, layouts: Iterable[re.Pattern[str]]) -> dict[str, dict[int, Tiles]]:
    """Return the tiles of each scene by level, then by face, row and column."""
    found: dict[str, dict[int, Tiles]] = {}
    for name, path in capture.pictures.items():
        place = _stem(name)
        match = next((match for layout in layouts if (match := layout.fullmatch(place))), None)
        if match is None:
            continue
        groups = match.groupdict()
        face = groups["face"].lower()
        tile = (NAMES | _SKYBOX).get(face, face), int(groups.get("row") or 0), int(groups.get("column") or 0)
        found.setdefault(groups["scene"], {}).setdefault(int(groups.get("level") or 0), {})[tile] = path
    return found


def _below(name: str, shared: str) -> str:
    return PurePosixPath(name).relative_to(shared).as_posix() if name else ""


def _finest(levels: Mapping[int, Tiles]) -> Tiles:
    """Return the tiles of the finest level in which all faces have the same rows and columns without a gap."""
    for level in sorted(levels, reverse=True):
        tiles = levels[level]
        rows, columns = sorted({row for _, row, _ in tiles}), sorted({column for _, _, column in tiles})
        expected = {(face, row, column) for face in FACES for row in rows for column in columns}
        gapless = all(places == list(range(places[0], places[-1] + 1)) and places[0] <= 1 for places in (rows, columns))
        if gapless and len(rows) == len(columns) and expected == set(tiles):
            return {(face, row - rows[0], column - columns[0]): path for (face, row, column), path in tiles.items()}
    return {}
