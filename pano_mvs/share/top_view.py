"""The map of the page: the cloud from above, cut at the height of the cameras, and how many views confirm it."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from pano_mvs.scene import PointCloud

MAP_PIXELS = 512
"""Length of the longer side of a map."""

_MARGIN = 0.04
# Red, yellow and green at one, three and a half, and six views, as in the page's view of the coverage.
_RAMP_VIEWS = (1.0, 3.5, 6.0)
_RAMP_RGB = np.array([(199, 38, 74), (250, 204, 77), (26, 153, 115)], np.float64)


@dataclass(frozen=True, eq=False)
class TopView:
    """Pictures of a scene from above, x to the right and z downwards, in the frame of the page.

    Attributes:
        lower: (2,) x and z of the upper-left corner.
        upper: (2,) x and z of the lower-right corner.
        colors: (H, W, 4) uint8 RGBA; transparent where there is nothing.
        coverage: (H, W, 4) uint8 RGBA, coloured by the number of views that confirm a place; None if unknown.
    """

    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    colors: NDArray[np.uint8]
    coverage: NDArray[np.uint8] | None


def top_view(cloud: PointCloud, centers: ArrayLike) -> TopView:
    """Return the pictures of a cloud from above, without what lies above the cameras.

    Args:
        cloud: in the frame of the page, with y up; at least one point.
        centers: (N, 3) of the cameras, in the same frame; all points are shown if there are none.
    """
    places = np.asarray(centers, np.float64).reshape(-1, 3)
    points = cloud.points_in_world.astype(np.float64)
    inner = np.percentile(points, [1, 99], axis=0)
    if len(places):
        cut = float(np.median(places[:, 1])) + 0.02 * float(np.linalg.norm(inner[1] - inner[0]))
        inner = np.stack([np.minimum(inner[0], places.min(axis=0)), np.maximum(inner[1], places.max(axis=0))])
    else:
        cut = np.inf
    extent = np.maximum((inner[1] - inner[0])[[0, 2]], 1e-6)
    lower, upper = inner[0][[0, 2]] - _MARGIN * extent.max(), inner[1][[0, 2]] + _MARGIN * extent.max()
    per_pixel = (upper - lower).max() / MAP_PIXELS
    width, height = np.maximum(np.rint((upper - lower) / per_pixel), 1).astype(int)
    pixels = np.floor((points[:, [0, 2]] - lower) / per_pixel).astype(int)
    shown = (pixels >= 0).all(axis=1) & (pixels < (width, height)).all(axis=1) & (points[:, 1] <= cut)
    order = np.flatnonzero(shown)[np.argsort(points[shown, 1], kind="stable")]
    columns, rows = pixels[order].T
    # Among points of one pixel the highest is assigned last.
    colors, views = np.zeros((height, width, 4), np.uint8), np.zeros((height, width), np.uint8)
    colors[rows, columns, :3], colors[rows, columns, 3] = cloud.colors_rgb[order], 255
    np.maximum.at(views, (rows, columns), cloud.view_counts[order])
    return TopView(lower, upper, _closed(colors), _closed(coverage_colors(views)) if views.any() else None)


def coverage_colors(views: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the colours of view counts, (..., 4) RGBA: red for one, yellow for three or four, green for six and more.

    Args:
        views: (...) uint8; 0 becomes transparent.
    """
    channels = [np.interp(views, _RAMP_VIEWS, _RAMP_RGB[:, idx]) for idx in range(3)]
    return np.stack([*channels, np.where(views > 0, 255, 0)], axis=-1).astype(np.uint8)


def _closed(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return an image whose small gaps have the mean colour of the pixels around them."""
    alpha = (image[..., 3:] > 0).astype(np.float32)
    color = image[..., :3].astype(np.float32) * alpha
    for _ in range(2):
        weight = cv2.blur(alpha, (3, 3)).reshape(alpha.shape)
        mean = cv2.blur(color, (3, 3)) / np.maximum(weight, 1e-6)
        gap = (alpha == 0) & (weight > 0.3)
        color, alpha = np.where(gap, mean, color), np.where(gap, np.float32(1), alpha)
    return np.concatenate([np.rint(color), alpha * 255], axis=-1).clip(0, 255).astype(np.uint8)
