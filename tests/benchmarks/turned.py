"""The same capture with its cameras turned on the spot: rolled, rendered afresh, or resampled from larger pictures."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.geometry import Rigid3, pad_panorama, pixel_from_ray, ray_grid, roll_panorama
from pano_mvs.scene import FilePart, Panorama
from pano_mvs.testing.scenes import Scene
from tests.benchmarks.captures import Capture, read_capture, scene_capture

Turns = Mapping[str, NDArray[np.float64]]
_MARGIN_PX = 8
_RAYS_PER_PIXEL = 3


class Place(Protocol):
    """Where pictures come from, whichever way the cameras are turned."""

    @property
    def capture(self) -> Capture:
        """The capture as it is."""
        ...

    def turned(self, turns: Turns, folder: Path) -> Capture:
        """Return the capture with some cameras, by name, turned by new_from_old (3, 3); pictures go to the folder."""
        ...


@dataclass(frozen=True)
class ScenePlace:
    """A synthetic scene, rendered afresh for every turn, so that no resampling blurs anything.

    Sensor noise is left out: two draws of it are no question of equivariance.
    """

    scene: Scene
    folder: Path
    width: int

    @property
    def capture(self) -> Capture:
        """The scene as it is."""
        return scene_capture(self._still, self.folder / "as-is", width=self.width)

    @property
    def _still(self) -> Scene:
        return dataclasses.replace(self.scene, noise=0.0)

    def turned(self, turns: Turns, folder: Path) -> Capture:
        """Return the scene with some cameras turned."""
        named = {f"{idx:03d}.png": pose for idx, pose in enumerate(self.scene.poses)}
        poses = tuple(_turn(pose, turns.get(name)) for name, pose in named.items())
        return scene_capture(dataclasses.replace(self._still, poses=poses), folder, width=self.width)


@dataclass(frozen=True)
class FolderPlace:
    """A rendered capture on disk; turned pictures are averages of nine Lanczos samples of the file's own pixels.

    At the file's own resolution some blur remains, at half of it next to none.
    """

    source: Path
    width: int
    views: int

    @property
    def capture(self) -> Capture:
        """The capture as it is."""
        return read_capture(self.source, width=self.width).first(self.views)

    def turned(self, turns: Turns, folder: Path) -> Capture:
        """Return the capture with some cameras turned."""
        whole, capture = read_capture(self.source).first(self.views), self.capture
        panoramas, ranges = dict(capture.panoramas), dict(capture.ranges)
        for name, turn in turns.items():
            picture = turned_picture(whole.panoramas[name].load(), turn, capture.panoramas[name].size_hw)
            panoramas[name] = written(picture, folder / name)
            ranges[name] = _nearest(whole.ranges[name], turn, picture.shape[:2])
        poses = {name: _turn(pose, turns.get(name)) for name, pose in capture.poses.items()}
        return dataclasses.replace(capture, panoramas=panoramas, poses=poses, ranges=ranges)


def rolled(capture: Capture, columns: Mapping[str, int], folder: Path) -> Capture:
    """Return the capture with each picture rolled to the right by its own number of columns, exactly."""
    panoramas, poses, ranges = {}, {}, {}
    for name, panorama in capture.panoramas.items():
        picture, turn = roll_panorama(panorama.load(), columns[name])
        panoramas[name] = written(picture, folder / name)
        poses[name] = _turn(capture.poses[name], turn)
        ranges[name] = np.roll(capture.ranges[name], columns[name], axis=1)
    return dataclasses.replace(capture, panoramas=panoramas, poses=poses, ranges=ranges)


def turned_picture(
    picture: NDArray[np.uint8], new_from_old: NDArray[np.float64], size_hw: tuple[int, int]
) -> NDArray[np.uint8]:
    """Return what a turned camera sees, (h, w, 3), of a larger or equally large panorama (H, W, 3)."""
    total = np.zeros((*size_hw, 3))
    for part in np.ndindex(_RAYS_PER_PIXEL, _RAYS_PER_PIXEL):
        fine = (_RAYS_PER_PIXEL * size_hw[0], _RAYS_PER_PIXEL * size_hw[1])
        rays = ray_grid(fine)[part[0] :: _RAYS_PER_PIXEL, part[1] :: _RAYS_PER_PIXEL] @ new_from_old
        x, y = np.moveaxis(pixel_from_ray(rays, picture.shape[:2]) + _MARGIN_PX - 0.5, -1, 0).astype(np.float32)
        padded = pad_panorama(picture, _MARGIN_PX)
        total += cv2.remap(padded, x, y, cv2.INTER_LANCZOS4).astype(np.float64)
    return np.asarray(np.rint(total / _RAYS_PER_PIXEL**2), dtype=np.uint8)


def written(picture: NDArray[np.uint8], path: Path) -> Panorama:
    """Write an RGB picture without loss and return it as a panorama."""
    path.parent.mkdir(parents=True, exist_ok=True)
    lossless = path.with_suffix(".png")
    cv2.imwrite(str(lossless), picture[..., ::-1])
    size = picture.shape[0], picture.shape[1]
    return Panorama(FilePart(lossless), size, size)


def _turn(pose: Rigid3, new_from_old: NDArray[np.float64] | None) -> Rigid3:
    return pose if new_from_old is None else Rigid3(new_from_old, np.zeros(3)) @ pose


def _nearest(
    ranges: NDArray[np.float32], new_from_old: NDArray[np.float64], size_hw: tuple[int, int]
) -> NDArray[np.float32]:
    """Return the ranges of the pixels in which a turned camera's rays arrive, (h, w)."""
    height, width = ranges.shape
    column, row = np.moveaxis(np.floor(pixel_from_ray(ray_grid(size_hw) @ new_from_old, (height, width))), -1, 0)
    result: NDArray[np.float32] = ranges[np.clip(row, 0, height - 1).astype(int), np.mod(column, width).astype(int)]
    return result
