"""Captures with their truth, from a folder or from a synthetic scene, for the benchmarks of depth."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.geometry import Rigid3
from pano_mvs.io.truth import read_truth
from pano_mvs.scene import FilePart, Panorama
from tests.stored import read_picture
from tests.synthetic.scenes import Scene

SCRATCH = Path(tempfile.gettempdir()) / "pano_mvs_benchmarks"
"""Where benchmarks keep what they have rendered."""


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
        return self.only(list(self.panoramas)[:count])

    def only(self, names: Sequence[str]) -> Capture:
        """Return some of the views."""
        return replace(
            self,
            panoramas={name: self.panoramas[name] for name in names},
            poses={name: self.poses[name] for name in names},
            ranges={name: self.ranges[name] for name in names},
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
        ranges[name] = cv2.resize(true, size[::-1], interpolation=cv2.INTER_NEAREST_EXACT).astype(np.float32)
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
