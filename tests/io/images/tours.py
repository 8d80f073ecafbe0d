"""Virtual tours of a synthetic room, in the layouts of several programs."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

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


def write(path: Path, picture: NDArray[np.uint8]) -> None:
    """Write an RGB picture, and make its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), picture[..., ::-1])


def tiny_tour() -> Path:
    """A tour of two scenes that goes when the process ends."""
    _folders.append(TemporaryDirectory(prefix="pano-mvs-tour-"))
    return write_tour(Path(_folders[-1].name), "Marzipano")
