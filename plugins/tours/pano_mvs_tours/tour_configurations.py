"""The scenes that the configuration of a virtual tour states, with their names, links and pictures.

Marzipano's editor writes `data.js` (`var APP_DATA = {…}`), with tiles in
`tiles/<id>/<level>/<face>/<row>/<column>.jpg`; our own export for it names a `panorama` instead.
Pannellum reads a JSON file, or takes the same object in a call of `pannellum.viewer` (its "JSON configuration file
options"). krpano reads XML files (its XML reference: `scene`, `image`, `hotspot`).

What a configuration states is not trusted: a path is only a text, which `tours` compares with the files that exist.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

from pano_mvs.core.text import xml_root

FACES = "frblud"
NAMES = {"front": "f", "right": "r", "back": "b", "left": "l", "up": "u", "top": "u", "down": "d", "bottom": "d"}
"""Faces of a cube by their names in files of others."""

_MAX_LEVELS = 24  # of 512 px tiles, this is more than 10^9 px along an edge


class StatedLink(NamedTuple):
    """A link to another scene."""

    target: str  # key of the scene
    # where it stands in the picture, in degrees to the right of its middle and above the horizon; None if not stated
    direction_deg: tuple[float, float] | None = None


class Grid(NamedTuple):
    """A cube in one resolution."""

    side: int  # number of tiles along an edge of a face
    # returns the path of a tile, by face, row and column, which count from 0
    url: Callable[[str, int, int], str]


@dataclass(frozen=True)
class StatedScene:
    """A scene of a configuration."""

    key: str  # its identifier, to which links refer
    title: str  # its name for people; may be empty
    links: tuple[StatedLink, ...]
    grids: tuple[Grid, ...] = ()  # resolutions of its cube, the finest first
    panorama: str = ""  # path of an equirectangular image, or ""


def stated_scenes(file: Path) -> list[StatedScene]:
    """Return the scenes that a file states; none if it is not the configuration of a tour.

    Raises:
        OSError: if it cannot be read.
        ValueError: if it seems to be a configuration, but cannot be parsed.
    """
    suffix = file.suffix.lower()
    if suffix not in {".js", ".json", ".xml", ".html", ".htm"} or file.stat().st_size > 8 << 20:
        return []
    data = file.read_bytes()
    try:
        if suffix == ".xml":
            return list(_krpano(xml_root(data))) if b"<krpano" in data and b"<scene" in data else []
        text = data.decode("utf-8-sig", errors="replace")
        if suffix == ".json":
            return list(_pannellum(json.loads(text))) if '"scenes"' in text else []
        if start := re.search(r"\bAPP_DATA\s*=\s*(?=\{)", text):
            return list(_marzipano(javascript_object(text[start.end() :])))
        calls = re.finditer(r"\bpannellum\.viewer\s*\([^{}]{1,200}?(?=\{)", text)
        return [scene for call in calls for scene in _pannellum(javascript_object(text[call.end() :]))]
    except RecursionError as error:
        raise ValueError("nested too deeply") from error


_TOKEN = re.compile(
    r"""(?P<gap>\s+|//[^\n]*|/\*.*?\*/)|(?P<text>"(?:[^"\\\n]|\\.)*"|'(?:[^'\\\n]|\\.)*')|"""
    r"(?P<word>[A-Za-z_$][\w$.]*)|(?P<number>-?[\d.][\w.+-]*)|(?P<sign>.)",
    re.DOTALL,
)


def javascript_object(text: str) -> Any:
    """Return the value of an object literal at the start of a text; variables in it are None.

    Raises:
        ValueError: if it has more than JSON with comments, unquoted keys, single quotes and commas at the end.
    """
    try:
        return json.JSONDecoder().raw_decode(text)[0]
    except ValueError:
        pass
    tokens, depth = list[str](), 0
    for match in _TOKEN.finditer(text):
        kind, found = match.lastgroup, match[0]
        if kind == "gap":
            continue
        if kind == "text" and found[0] == "'":
            found = '"' + re.sub(r'(?<!\\)"', r"\"", found[1:-1].replace(r"\'", "'")) + '"'
        elif found == ":" and tokens and tokens[-1].isidentifier():
            tokens[-1] = json.dumps(tokens[-1])
        elif found in "}]" and tokens and tokens[-1] == ",":
            tokens.pop()
        tokens.append(found)
        depth += (found in ("{", "[")) - (found in ("}", "]"))
        if depth == 0:
            break
    words = {"true", "false", "null"}
    return json.loads("".join("null" if _is_word(found) and found not in words else found for found in tokens))


def _is_word(text: str) -> bool:
    return text[0].isalpha() or text[0] in "_$"


def _marzipano(data: Any) -> Iterator[StatedScene]:
    for scene in _objects(_get(data, "scenes")):
        key = _text(scene, "id")
        grids = []
        # Without sizes, the path of its tiles is known all the same.
        levels = list(_objects(scene.get("levels"))) or [{}]
        for number, level in list(enumerate(levels))[: -_MAX_LEVELS - 1 : -1]:
            if not level.get("fallbackOnly"):
                side = _tiles(_number(level, "size"), _number(level, "tileSize"))
                grids.append(Grid(side, _expanded(f"tiles/{key}/%l/%s/%y/%x.jpg", level=number, first=0)))
        links = [
            StatedLink(_text(link, "target"), _direction(link, "yaw", "pitch", unit_deg=math.degrees(1), up=-1))
            for link in _objects(scene.get("linkHotspots"))
        ]
        yield StatedScene(key, _text(scene, "name"), tuple(links), tuple(grids), _text(scene, "panorama"))


def _pannellum(config: Any) -> Iterator[StatedScene]:
    scenes, default = _get(config, "scenes"), _get(config, "default")
    for key, stated in (scenes if isinstance(scenes, dict) else {}).items():
        scene = (default if isinstance(default, dict) else {}) | (stated if isinstance(stated, dict) else {})
        links = tuple(
            StatedLink(_text(spot, "sceneId"), _direction(spot, "yaw", "pitch"))
            for spot in _objects(scene.get("hotSpots"))
        )
        base, kind, grids, panorama = _text(scene, "basePath"), _text(scene, "type"), list[Grid](), ""
        if kind == "multires" and isinstance(tiles := scene.get("multiRes"), dict):
            path = _text(tiles, "basePath")
            path = f"{'' if '://' in path else base}{path}{_text(tiles, 'path')}.{_text(tiles, 'extension') or 'jpg'}"
            finest = int(_number(tiles, "maxLevel")) or 1
            for level in range(finest, max(0, finest - _MAX_LEVELS), -1):
                pixels = _number(tiles, "cubeResolution") / 2 ** (finest - level)
                side = _tiles(pixels, _number(tiles, "tileResolution") or 512)
                grids.append(Grid(side, _expanded(path, level=level, first=0)))
        elif kind == "cubemap" and isinstance(files := scene.get("cubeMap"), list) and len(files) == 6:
            grids.append(_six_files({face: f"{base}{file}" for face, file in zip("frblud", files, strict=True)}))
        elif kind in ("", "equirectangular") and (file := _text(scene, "panorama")):
            panorama = base + file
        yield StatedScene(key, _text(scene, "title"), links, tuple(grids), panorama)


def _krpano(root: ElementTree.Element) -> Iterator[StatedScene]:
    """Yield the scenes; their names are compared without regard to case."""
    for scene in root.iter("scene"):
        grids, panorama = list[Grid](), ""
        for image in scene.iter("image"):
            grids += _krpano_grids(image)
            panorama = panorama or next((url for sphere in image.iter("sphere") if (url := sphere.get("url"))), "")
        name = scene.get("name") or ""
        links = tuple(
            StatedLink((spot.get("linkedscene") or "").casefold(), _direction(spot.attrib, "ath", "atv", up=-1))
            for spot in scene.iter("hotspot")
        )
        # A cube of six files has no stated size, and stands beside a finer one of tiles, for devices with less memory.
        grids.sort(key=lambda grid: grid.side, reverse=True)
        yield StatedScene(name.casefold(), scene.get("title") or name, links, tuple(grids), panorama)


def _krpano_grids(image: ElementTree.Element) -> Iterator[Grid]:
    first = int(_number(image.attrib, "baseindex") if "baseindex" in image.attrib else 1)
    levels = list(image.iter("level"))
    for number, level in list(enumerate(levels, 1))[: -_MAX_LEVELS - 1 : -1]:
        side = _tiles(_number(level.attrib, "tiledimagewidth"), _number(image.attrib, "tilesize"))
        yield from (Grid(side, _by_face(urls, level=number, first=first)) for urls in _krpano_urls(level))
    for part in [] if levels else [image]:
        for urls in _krpano_urls(part):
            cube = part.find("cube")
            sizes = "" if cube is None else cube.get("multires") or ""
            tile, *pixels = [float(word) for word in re.findall(r"\d+", sizes)][: _MAX_LEVELS + 1] or [0.0]
            for number, width in list(enumerate(pixels, 1))[::-1]:
                yield Grid(_tiles(width, tile), _by_face(urls, level=number, first=first))
            if not pixels:
                yield _six_files({face: _expanded(url, level=1, first=first)(face, 0, 0) for face, url in urls.items()})


def _krpano_urls(element: ElementTree.Element) -> Iterator[dict[str, str]]:
    """Yield the pattern of each face's path, of a cube element or of an element for each face."""
    for cube in element.findall("cube"):
        if url := cube.get("url"):
            yield dict.fromkeys(FACES, url)
    urls = {NAMES[part.tag]: part.get("url") or "" for part in element if part.tag in NAMES}
    if set(urls) == set(FACES):
        yield urls


def _by_face(urls: Mapping[str, str], *, level: int, first: int) -> Callable[[str, int, int], str]:
    paths = {face: _expanded(url, level=level, first=first) for face, url in urls.items()}
    return lambda face, row, column: paths[face](face, row, column)


def _six_files(urls: Mapping[str, str]) -> Grid:
    return Grid(1, lambda face, *_: urls[face])


def _expanded(pattern: str, *, level: int, first: int) -> Callable[[str, int, int], str]:
    """Return a function that puts face, level, row and column into a pattern; rows and columns begin with `first`."""
    plain = re.sub(r"%(?:SWFPATH|FIRSTXML|CURRENTXML|HTMLPATH|ROOT|BASEDIR)%/?", "", pattern)

    def path(face: str, row: int, column: int) -> str:
        values = {"s": face, "l": level, **dict.fromkeys("vry", row + first), **dict.fromkeys("hcx", column + first)}
        return re.sub(r"%(0{0,4})([slvryhcx])", lambda at: str(values[at[2]]).zfill(len(at[1]) + 1), plain)

    return path


def _tiles(pixels: float, tile_px: float) -> int:
    """Return the number of tiles along an edge, or 0 if the numbers make no sense."""
    return int(-(-pixels // tile_px)) if 0 < tile_px < 1e6 and 0 < pixels < 1e7 else 0


def _get(value: Any, key: str) -> Any:
    return value.get(key) if isinstance(value, dict) else None


def _objects(value: Any) -> Iterable[dict[str, Any]]:
    return (item for item in value if isinstance(item, dict)) if isinstance(value, list) else ()


def _text(value: Mapping[str, Any], key: str) -> str:
    found = value.get(key)
    return str(found) if isinstance(found, (str, int)) else ""


def _direction(
    value: Mapping[str, Any], right: str, up_or_down: str, *, unit_deg: float = 1.0, up: int = 1
) -> tuple[float, float] | None:
    """Return a direction in degrees, from -180 to 180 to the right and upwards; None if it is not stated.

    Args:
        value: has both angles.
        right: key of the angle to the right.
        up_or_down: key of the angle above or below the horizon.
        unit_deg: unit of the angles.
        up: 1 if angles above the horizon are positive, -1 if those below it are.
    """
    try:
        yaw, pitch = (float(value[key]) * unit_deg for key in (right, up_or_down))
    except (KeyError, TypeError, ValueError, OverflowError):
        return None
    if not (abs(yaw) < 1e6 and abs(pitch) <= 90):
        return None
    return (yaw + 180) % 360 - 180, up * pitch


def _number(value: Mapping[str, Any], key: str) -> float:
    """Return a number between 0 and 10^9, or 0 if there is none."""
    try:
        found = float(value.get(key) or 0)
    except (TypeError, ValueError, OverflowError):
        return 0.0
    return found if 0 <= found < 1e9 else 0.0
