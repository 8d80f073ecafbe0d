"""The map of the page: pictures of the scene from above, and how many views confirm it."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.errors import InputError
from pano_mvs.core.file_names import path_inside
from pano_mvs.geometry import Rigid3
from pano_mvs.results.colors import ramp_rgb
from pano_mvs.results.run_output import RunOutput
from pano_mvs.scene import FilePart, PointCloud
from pano_mvs.scene.image_file import decode_image

MAP_PIXELS = 512  # length of the longer side of a map


@dataclass(frozen=True, eq=False)
class MapPlace:
    """Where a map lies, in x and z of the page."""

    corner: FloatArray  # (2,) its upper-left corner
    right: FloatArray  # (2,) its upper side, from left to right
    down: FloatArray  # (2,) its left side, from top to bottom

    @property
    def size_hw(self) -> tuple[int, int]:
        """The size of a picture of the map in pixels."""
        width, height = float(np.linalg.norm(self.right)), float(np.linalg.norm(self.down))
        scale = MAP_PIXELS / max(width, height, 1e-12)
        return max(1, round(height * scale)), max(1, round(width * scale))

    def fractions(self, points: FloatArray) -> FloatArray:
        """Return the places of points (N, 3) of the page on the map, (N, 2): fractions of its width and height."""
        sides = np.stack([self.right, self.down], axis=-1)
        return np.asarray(np.linalg.solve(sides, (points[:, [0, 2]] - self.corner).T).T, np.float64)


def place_around(points: NDArray[np.float32], centers: ArrayLike) -> MapPlace:
    """Return where a map of all but the outermost percent of the points and of all cameras lies."""
    box = np.percentile(points.astype(np.float64), [1, 99], axis=0)
    shown = np.concatenate([box, np.asarray(centers, np.float64).reshape(-1, 3)])[:, [0, 2]]
    lower, upper = shown.min(axis=0), shown.max(axis=0)
    margin = 0.04 * max(float((upper - lower).max()), 1e-6)
    extent = upper - lower + 2 * margin
    return MapPlace(lower - margin, np.array([extent[0], 0.0]), np.array([0.0, extent[1]]))


def cut_height(points: NDArray[np.float32], centers: ArrayLike) -> float:
    """Return the height above which a map shows nothing: a little above the cameras; infinity without cameras."""
    heights = np.asarray(centers, np.float64).reshape(-1, 3)[:, 1]
    if not len(heights):
        return np.inf
    box = np.percentile(points, [1, 99], axis=0)
    return float(np.median(heights)) + 0.02 * float(np.linalg.norm(box[1] - box[0]))


def top_view(
    cloud: PointCloud, place: MapPlace, heights: tuple[float, float]
) -> tuple[NDArray[np.uint8], NDArray[np.uint8] | None]:
    """Return a cloud from above, and how many views confirm it, both (H, W, 4) uint8 RGBA, transparent where it is not.

    Args:
        cloud: in the frame of the page, with y up.
        place: what the map shows.
        heights: the lowest and the highest y that it shows.

    Returns:
        The colours, and the coverage, which is None if the counts of views are unknown.
    """
    points = cloud.points_in_world.astype(np.float64)
    height, width = place.size_hw
    pixels = np.floor(place.fractions(points) * (width, height)).astype(int)
    inside = (pixels >= 0).all(axis=1) & (pixels < (width, height)).all(axis=1)
    shown = np.flatnonzero(inside & (points[:, 1] >= heights[0]) & (points[:, 1] <= heights[1]))
    order = shown[np.argsort(points[shown, 1], kind="stable")]
    columns, rows = pixels[order].T
    # Among points of one pixel the highest is assigned last.
    colors, views = np.zeros((height, width, 4), np.uint8), np.zeros((height, width), np.uint8)
    colors[rows, columns, :3], colors[rows, columns, 3] = cloud.colors_rgb[order], 255
    np.maximum.at(views, (rows, columns), cloud.view_counts[order])
    return closed(colors), closed(coverage_colors(views)) if views.any() else None


def coverage_colors(views: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the colours of view counts, (..., 4) RGBA: red for one, yellow for three or four, green from six."""
    seen = np.where(views > 0, np.uint8(255), np.uint8(0))
    # Red, yellow and green, as in the page's view of the coverage.
    return np.concatenate([ramp_rgb(views, (1.0, 3.5, 6.0)), seen[..., None]], axis=-1)


def closed(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return an RGBA image whose small gaps have the mean colour of the pixels around them."""
    alpha = (image[..., 3:] > 0).astype(np.float32)
    color = image[..., :3].astype(np.float32) * alpha
    for _ in range(2):
        weight = cv2.blur(alpha, (3, 3)).reshape(alpha.shape)
        mean = cv2.blur(color, (3, 3)) / np.maximum(weight, 1e-6)
        gap = (alpha == 0) & (weight > 0.3)
        color, alpha = np.where(gap, mean, color), np.where(gap, np.float32(1), alpha)
    return np.concatenate([np.rint(color), alpha * 255], axis=-1).clip(0, 255).astype(np.uint8)


PLAN = "floor_plan/floor_plan.json"


@dataclass(frozen=True, eq=False)
class StoreyMap:
    """The plan of one storey."""

    picture: NDArray[np.uint8]  # (H, W, 3) uint8 RGB
    place: MapPlace  # where it lies in the page
    heights: tuple[float, float]  # the y of the page between which it lies


def run_plans(run: RunOutput, page_from_world: Rigid3) -> tuple[list[StoreyMap], str]:
    """Return the floor plans of the largest group of a run, one per storey, and a note, or "".

    Without any room, as outdoors, there are none: the cloud from above shows more.
    """
    if not run.has_file(PLAN):
        return [], ""
    path = run.out / PLAN
    try:
        about = json.loads(FilePart(path).read_bytes())
        file_from_world = np.array(about["file_from_world"], np.float64).reshape(3, 3)
        page_from_file = page_from_world @ Rigid3(file_from_world.T, np.zeros(3))
        storeys = [entry for entry in about["storeys"] if "png" in entry]
        if not any(entry["rooms"] for entry in storeys):
            return [], ""
        plans = [
            _storey(entry, decode_image(path_inside(path.parent, str(entry["png"]))), page_from_file)
            for entry in storeys
        ]
    except (ValueError, KeyError, TypeError, InputError) as error:
        return [], f"{path} was left out: it is not as export.floor_plan writes it ({error})"
    return plans, ""


def _storey(entry: dict[str, Any], picture: NDArray[np.uint8], page_from_file: Rigid3) -> StoreyMap:
    left, top = entry["origin_xy"]
    lower, upper = entry["z_range"]
    width, height = (entry["units_per_pixel"] * count for count in entry["size_px"])
    corners = [(left, top, lower), (left + width, top, lower), (left, top - height, lower), (left, top, upper)]
    corner, right, down, above = page_from_file.apply(np.array(corners, np.float64))
    flat = [0, 2]
    # A drawing needs more pixels than a picture of points.
    shrink = min(1.0, 2 * MAP_PIXELS / max(picture.shape[:2]))
    size = (max(1, round(picture.shape[1] * shrink)), max(1, round(picture.shape[0] * shrink)))
    return StoreyMap(
        np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8),
        MapPlace(corner[flat], (right - corner)[flat], (down - corner)[flat]),
        (float(corner[1]), float(above[1])),
    )
