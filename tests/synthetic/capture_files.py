"""Write synthetic captures with their ground truth."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.geometry import Rigid3
from pano_mvs.testing.room import Room, render


def write_capture(folder: Path, room: Room, poses: Sequence[Rigid3], *, size_hw: tuple[int, int]) -> None:
    """Write a capture of the room: images/000.png …, truth/poses.json and truth/depth.npz.

    `pano_mvs.io.truth.read_truth` reads the ground truth: poses are cam_from_world, ranges are float32
    with inf where there is no surface, and each view has the SHA-256 of its image.
    """
    write_views(folder, (render(room, pose, size_hw) for pose in poses), poses)


def write_views(
    folder: Path, pictures: Iterable[tuple[NDArray[np.uint8], NDArray[np.float32]]], poses: Sequence[Rigid3]
) -> None:
    """Write views, each an image and its true ranges as returned by `render`, in the format of `write_capture`."""
    (folder / "images").mkdir(parents=True, exist_ok=True)
    (folder / "truth").mkdir(exist_ok=True)
    views: list[dict[str, object]] = []
    ranges: dict[str, NDArray[np.float32]] = {}
    size_hw = (0, 0)
    for number, ((image, range_map), pose) in enumerate(zip(pictures, poses, strict=True)):
        size_hw = range_map.shape[0], range_map.shape[1]
        name = f"{number:03d}"
        data = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))[1].tobytes()
        (folder / "images" / f"{name}.png").write_bytes(data)
        ranges[name] = np.where(np.isfinite(range_map), range_map, np.float32(np.inf))
        digest = hashlib.sha256(data).hexdigest()
        view = {"id": number, "image": f"images/{name}.png", "sha256": digest}
        views.append(view | {"R": pose.rotation.tolist(), "t": pose.translation.tolist()})
    text = json.dumps({"width": size_hw[1], "height": size_hw[0], "metric": True, "views": views}, indent=1)
    (folder / "truth" / "poses.json").write_text(text, encoding="utf-8")
    np.savez_compressed(folder / "truth" / "depth.npz", **ranges)  # type: ignore[arg-type]  # names are ours
