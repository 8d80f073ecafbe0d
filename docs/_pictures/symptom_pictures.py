"""Symptoms for docs/troubleshooting.md: plans and sections of a cloud, as it should be and with an error.

    pano-mvs run quality --images CLASSROOM --out classroom
    python docs/_pictures/symptom_pictures.py classroom

CLASSROOM: nine panoramas of the rendered classroom, as in docs/benchmarks.md. The errors are put into the poses and
ranges of the run; the pixels are the run's own.
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from quickstart_pictures import IMAGES

import pano_mvs
from pano_mvs import RunOutput
from pano_mvs.geometry import Rigid3, ray_grid, rotation_from_rotvec

SIZE = 460
BACKGROUND = (246, 245, 243)
MIN_CONFIDENCE = 128

Picture = NDArray[np.uint8]
FloatArray = NDArray[np.float64]


class Cloud:
    """The confirmed points of all views, in the world and with their view."""

    def __init__(self, run: RunOutput) -> None:
        self.poses = {name: view.cam_from_world for name, view in run.views.items()}
        self.in_cam: dict[str, FloatArray] = {}
        self.colors: dict[str, Picture] = {}
        for name, view in run.views.items():
            ranges = np.asarray(view.range_map)
            keep = np.asarray(view.confidence) >= MIN_CONFIDENCE
            self.in_cam[name] = (ray_grid((ranges.shape[0], ranges.shape[1])) * ranges[..., None])[keep]
            self.colors[name] = np.asarray(view.image)[keep]

    def points(self, poses: dict[str, Rigid3]) -> tuple[FloatArray, Picture]:
        """Return all points with their colours, for given poses."""
        placed = [poses[name].inverse().apply(points) for name, points in self.in_cam.items()]
        return np.concatenate(placed), np.concatenate(list(self.colors.values()))


def drawn(points: FloatArray, colors: Picture, *, axes: tuple[int, int], low: FloatArray, high: FloatArray) -> Picture:
    """Return points drawn parallel to an axis, (SIZE, SIZE, 3) BGR; the smallest third coordinate is in front."""
    scale = (SIZE - 20) / (high - low).max()
    (third,) = {0, 1, 2} - set(axes)
    order = np.argsort(-points[:, third])
    middle = (low + high) / 2
    at = np.rint((points[order][:, axes] - middle) * scale + SIZE / 2).astype(int)
    inside = ((at >= 1) & (at < SIZE - 1)).all(axis=1)
    picture = np.full((SIZE, SIZE, 3), BACKGROUND, np.uint8)
    x, y = at[inside].T
    for dx, dy in ((0, 0), (1, 0), (0, 1)):
        picture[y + dy, x + dx] = colors[order][inside][:, ::-1]
    return picture


def symptoms(run: RunOutput) -> dict[str, Picture]:
    """Return each picture: on the left as it should be, on the right the symptom."""
    cloud = Cloud(run)
    points, colors = cloud.points(cloud.poses)
    low, high = np.quantile(points, 0.002, axis=0), np.quantile(points, 0.998, axis=0)
    plan, side = (0, 2), (2, 1)

    def plan_of(points: FloatArray, colors: Picture) -> Picture:
        band = (points[:, 1] > -0.9) & (points[:, 1] < 0.35)
        flipped = points[band] * (1, 1, -1)
        edges = np.array([low[0], -high[2]]), np.array([high[0], -low[2]])
        return drawn(flipped, colors[band], axes=plan, low=edges[0], high=edges[1])

    def side_of(points: FloatArray, colors: Picture) -> Picture:
        band = (points[:, 0] > -0.6) & (points[:, 0] < 0.6)
        return drawn(points[band], colors[band], axes=side, low=low[[2, 1]], high=high[[2, 1]])

    wrong = dict(cloud.poses)
    for number, name in enumerate(sorted(wrong)[1::3]):
        turn = rotation_from_rotvec(np.radians([0.0, 4.0 - 2.0 * number, 0.0]))
        wrong[name] = Rigid3(turn, np.array([0.25, 0.0, -0.2])) @ wrong[name]
    tilt = rotation_from_rotvec(np.radians([-14.0, 0.0, 0.0]))
    shell = [pose.center + 0.32 * _lower_cap(2500) for pose in cloud.poses.values()]
    with_shells = (
        np.concatenate([points, *shell]),
        np.concatenate([colors, *(np.full((len(each), 3), (40, 42, 46), np.uint8) for each in shell)]),
    )
    return {
        "symptom_layers.jpg": beside(plan_of(points, colors), plan_of(*cloud.points(wrong))),
        "symptom_tilt.jpg": beside(side_of(points, colors), side_of(points @ tilt.T, colors)),
        "symptom_shells.jpg": beside(side_of(points, colors), side_of(*with_shells)),
    }


def _lower_cap(count: int) -> FloatArray:
    """Return directions within 50° of straight down."""
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(20 * count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return directions[directions[:, 1] > np.cos(np.radians(50))][:count]


def beside(left: Picture, right: Picture) -> Picture:
    """Return two pictures beside each other, without empty rows above and below both."""
    rows = np.flatnonzero(((left != BACKGROUND) | (right != BACKGROUND)).any(axis=(1, 2)))
    shown = slice(max(rows[0] - 12, 0), rows[-1] + 13)
    left, right = left[shown], right[shown]
    return np.hstack([left, np.full((left.shape[0], 12, 3), 255, np.uint8), right])


def weak_ceiling(preview: Path) -> Picture:
    """Return the upper part of a preview's panorama above that of its ranges: pale is not confirmed."""
    whole = cv2.imread(str(preview))
    assert whole is not None
    height = whole.shape[1] // 2
    part = height * 2 // 5
    stacked = np.vstack([whole[:part], np.full((8, whole.shape[1], 3), 255, np.uint8), whole[height + 4 :][:part]])
    width = 2 * SIZE + 12
    return cv2.resize(stacked, (width, stacked.shape[0] * width // stacked.shape[1]), interpolation=cv2.INTER_AREA)


if __name__ == "__main__":
    out = Path(sys.argv[1])
    run = pano_mvs.load(out)
    pictures = symptoms(run) | {"symptom_ceiling.jpg": weak_ceiling(out / "preview" / "000.jpg")}
    for name, picture in pictures.items():
        cv2.imwrite(str(IMAGES / name), picture, [cv2.IMWRITE_JPEG_QUALITY, 80])
