"""Captures with their truth, from a folder or from a synthetic scene, for the benchmarks of depth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.evaluation.inputs import read_truth
from pano_mvs.geometry import Rigid3
from pano_mvs.scene import FilePart, Panorama
from pano_mvs.testing.scenes import SCENES, Scene
from tests.stored import read_picture


@dataclass(frozen=True)
class Capture:
    """Pictures of one place with what is known of it.

    Attributes:
        name: of the place.
        panoramas: by name, in order.
        poses: cam_from_world of each.
        ranges: (H, W) true range of each, NaN where there is no surface.
        outdoor: whether only relative errors say something.
    """

    name: str
    panoramas: Mapping[str, Panorama]
    poses: Mapping[str, Rigid3]
    ranges: Mapping[str, NDArray[np.float32]]
    outdoor: bool = False

    def first(self, count: int) -> Capture:
        """Return the first few views only."""
        names = list(self.panoramas)[:count]
        return Capture(
            self.name,
            {name: self.panoramas[name] for name in names},
            {name: self.poses[name] for name in names},
            {name: self.ranges[name] for name in names},
            self.outdoor,
        )


def read_capture(folder: Path, *, width: int | None = None) -> Capture:
    """Return a rendered capture: its truth lies in `folder` or `folder/truth`, the pictures are those that it names.

    Args:
        folder: of the capture.
        width: of the pictures to work on; the truth is then the nearest pixel's.
    """
    truth = read_truth(folder / "truth" if (folder / "truth").is_dir() else folder)
    panoramas, ranges = {}, {}
    for view in truth.views.values():
        true = truth.range_map(view)
        if true is None:
            continue
        path = next(path for path in (folder / view.name, folder / "rgb" / view.name) if path.is_file())
        height, own_width = read_picture(path).shape[:2]
        size = height * (width or own_width) // own_width, width or own_width
        name = Path(view.name).name
        panoramas[name] = Panorama(FilePart(path), size, (height, own_width))
        ranges[name] = _shrunk(true, size)
    poses = {Path(name).name: pose for name, pose in truth.poses.items()}
    return Capture(folder.resolve().name, panoramas, {name: poses[name] for name in panoramas}, ranges)


def scene_capture(scene: Scene, folder: Path, *, width: int) -> Capture:
    """Render a synthetic scene, or read what was rendered into the folder before."""
    folder.mkdir(parents=True, exist_ok=True)
    size = width // 2, width
    panoramas, ranges, poses = {}, {}, {}
    for idx, pose in enumerate(scene.poses):
        name = f"{idx:03d}.png"
        picture, truth = folder / name, folder / f"{idx:03d}.npy"
        if not truth.is_file():
            image, true = scene.view(idx, size)
            cv2.imwrite(str(picture), image[..., ::-1])
            np.save(truth, true)
        panoramas[name], poses[name] = Panorama(FilePart(picture), size, size), pose
        ranges[name] = np.load(truth)
    return Capture(scene.name, panoramas, poses, ranges, scene.outdoor)


def scene_captures(
    folder: Path, *, names: Sequence[str] = tuple(SCENES), width: int = 512, seed: int = 0, exposure: float = 0.0
) -> list[Capture]:
    """Return the synthetic scenes of these names, rendered into sub-folders of `folder` once."""
    scenes = {name: SCENES[name](seed=seed, exposure=exposure) for name in names}
    return [
        scene_capture(scene, folder / f"{name}-{width}-{seed}-{exposure}", width=width)
        for name, scene in scenes.items()
    ]


def _shrunk(ranges: NDArray[np.float32], size_hw: tuple[int, int]) -> NDArray[np.float32]:
    if ranges.shape == size_hw:
        return ranges
    result: NDArray[np.float32] = cv2.resize(ranges, size_hw[::-1], interpolation=cv2.INTER_NEAREST_EXACT).astype(
        np.float32
    )
    return result
