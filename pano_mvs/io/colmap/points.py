"""The points of a COLMAP model with their tracks, which are collected image by image."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from pano_mvs.scene import Poses

ModelForm = Literal["bin", "txt", "both"]


class ModelPoints:
    """Collect the observations of images in tracks, and add the points to a pycolmap model.

    Args:
        poses: poses with points and tracks.
    """

    def __init__(self, poses: Poses) -> None:
        """Create empty tracks."""
        import pycolmap

        self._poses = poses
        self._tracks: list[Any] = [pycolmap.Track() for _ in range(len(poses.points_in_world))]
        self._pixels_per_rad = np.zeros(len(self._tracks))
        order = np.argsort(poses.track_image_idx, kind="stable")
        ends = np.searchsorted(poses.track_image_idx[order], np.arange(len(poses.names) + 1))
        self._of_image = [order[first:end] for first, end in pairwise(ends)]

    def observations(self, image_idx: int) -> NDArray[np.intp]:
        """Return the indices of the track entries in one image of the poses, in order."""
        return self._of_image[image_idx]

    def observe(self, image_id: int, observed: NDArray[np.intp], *, pixels_per_rad: float) -> None:
        """Add observations: key points 0, 1, … of the model's image observe these track entries."""
        for point2d_idx, point_idx in enumerate(self._poses.track_point_idx[observed].tolist()):
            self._tracks[point_idx].add_element(image_id, point2d_idx)
            self._pixels_per_rad[point_idx] += pixels_per_rad

    def add_to(self, model: Any, *, only_seen: bool = False) -> int:
        """Add the points and return their number; with `only_seen`, only those that an image observes.

        The error of a point is its angle in pixels, averaged over the images that observe it.
        """
        poses, added = self._poses, 0
        for idx, track in enumerate(self._tracks):
            if only_seen and not track.length():
                continue
            point_id = model.add_point3D(poses.points_in_world[idx], track, poses.point_colors_rgb[idx])
            per_rad = self._pixels_per_rad[idx] / max(track.length(), 1)
            model.points3D[point_id].error = float(poses.point_errors_rad[idx] * per_rad)
            added += 1
        return added


def write_model(model: Any, folder: Path, form: ModelForm) -> None:
    """Write a pycolmap model as "bin", "txt" or "both"; the folder is created if necessary."""
    folder.mkdir(parents=True, exist_ok=True)
    if form in ("bin", "both"):
        model.write_binary(str(folder))
    if form in ("txt", "both"):
        model.write_text(str(folder))
