"""Virtual tours of a synthetic room, in the layouts of several programs."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from xml.sax.saxutils import quoteattr

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.faces.sampling import CUBE

SIDE = 64
LAYOUTS: dict[str, Callable[[str, str, int, int], str]] = {
    "Marzipano": lambda scene, face, row, column: f"app-files/tiles/{scene}/2/{face}/{row}/{column}.png",
    "Pannellum": lambda scene, face, row, column: f"tour/{scene}/2/{face}{row}_{column}.png",
    "krpano": lambda scene, face, row, column: (
        f"panos/{scene}.tiles/{face}/l2/{row + 1:02d}/l2_{face}_{row + 1:02d}_{column + 1:02d}.png"
    ),
}
"""The path of a tile by scene, face, row and column."""

NAMES = {"f": "front", "r": "right", "b": "back", "l": "left", "u": "up", "d": "down"}
_folders: list[TemporaryDirectory[str]] = []


def color_of(rays: NDArray[np.floating], scene: int = 0) -> NDArray[np.uint8]:
    """Return colours (…, 3) of directions that vary slowly, and differ from scene to scene."""
    return np.asarray(np.rint(127 + 60 * rays + 60 * np.sin(3 * rays[..., [1, 2, 0]] + scene)), np.uint8)


def face_of(name: str, scene: int = 0) -> NDArray[np.uint8]:
    """Return a face of a cube, (SIDE, SIDE, 3) RGB."""
    right, down, forward = (np.array(axis, np.float64) for axis in CUBE[name])
    at = (2 * np.arange(SIDE) + 1) / SIDE - 1
    rays = at[None, :, None] * right + at[:, None, None] * down + forward
    return color_of(rays / np.linalg.norm(rays, axis=-1, keepdims=True), scene)


def write_tour(folder: Path, layout: str, scenes: tuple[str, ...] = ("1-hall", "2-room")) -> Path:
    """Write a tour of tiles, each face in two rows and columns, with a coarser level in a Marzipano tour."""
    half = SIDE // 2
    for number, scene in enumerate(scenes):
        for name in CUBE:
            face = face_of(name, number)
            for row in range(2):
                for column in range(2):
                    tile = face[row * half : (row + 1) * half, column * half : (column + 1) * half]
                    write(folder / LAYOUTS[layout](scene, name, row, column), tile)
            if layout == "Marzipano":
                write(folder / f"app-files/tiles/{scene}/1/{name}/0/0.png", face[::2, ::2])
    return folder


CONFIGURATIONS: dict[str, str] = {"Marzipano": "app-files/data.js", "Pannellum": "tour.json", "krpano": "tour.xml"}
"""Where the configuration of a tour is."""

YAW_DEG, PITCH_DEG = 30.0, -12.0
"""Direction of all links of a configuration."""


def write_configuration(
    folder: Path, program: str, titles: Mapping[str, str], links: Mapping[str, Sequence[str]]
) -> None:
    """Write the configuration of a tour of `write_tour`, with a title and links for each scene."""
    half = SIDE // 2
    if program == "Marzipano":
        place = {"yaw": math.radians(YAW_DEG), "pitch": math.radians(-PITCH_DEG)}
        sizes = [{"tileSize": 256, "size": 256, "fallbackOnly": True}]
        sizes += [{"tileSize": half, "size": half}, {"tileSize": half, "size": SIDE}]
        scenes = [
            {
                "id": key,
                "name": title,
                "levels": sizes,
                "linkHotspots": [{"target": to} | place for to in links.get(key, [])],
            }
            for key, title in titles.items()
        ]
        text = f"var APP_DATA = {json.dumps({'scenes': scenes}, indent=1)};\n"
    elif program == "Pannellum":
        tiles = {"path": "/%l/%s%y_%x", "extension": "png", "tileResolution": half, "maxLevel": 2}
        stated = {
            key: {
                "title": title,
                "type": "multires",
                "multiRes": tiles | {"basePath": f"/{key}", "cubeResolution": SIDE},
                "hotSpots": [
                    {"type": "scene", "sceneId": to, "yaw": YAW_DEG, "pitch": PITCH_DEG} for to in links.get(key, [])
                ],
            }
            for key, title in titles.items()
        }
        text = json.dumps({"default": {"basePath": "./tour"}, "scenes": stated})
    else:
        at = f"ath='{YAW_DEG}' atv='{-PITCH_DEG}'"
        text = "".join(
            f"<scene name={quoteattr(key)} title={quoteattr(title)}><image><cube url="
            f"{quoteattr(f'panos/{key}.tiles/%s/l%l/%0v/l%l_%s_%0v_%0h.png')} multires='{half},{half},{SIDE}'/></image>"
            + "".join(f"<hotspot linkedscene={quoteattr(to.upper())} {at}/>" for to in links.get(key, []))
            + "</scene>"
            for key, title in titles.items()
        )
        text = f"<krpano>{text}</krpano>"
    (folder / CONFIGURATIONS[program]).parent.mkdir(parents=True, exist_ok=True)
    (folder / CONFIGURATIONS[program]).write_text(text, encoding="utf-8")


def write(path: Path, picture: NDArray[np.uint8]) -> None:
    """Write an RGB picture, and make its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), picture[..., ::-1])


def tiny_tour() -> Path:
    """A tour of two scenes that goes when the process ends."""
    _folders.append(TemporaryDirectory(prefix="pano-mvs-tour-"))
    return write_tour(Path(_folders[-1].name), "Marzipano")
