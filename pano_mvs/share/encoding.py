"""Arrays as the short texts that the page decodes."""

from __future__ import annotations

import base64
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from pano_mvs.scene import PointCloud
from pano_mvs.share.octree import OctreeNode

_LEVELS = 65535


@dataclass(frozen=True, eq=False)
class LogSteps:
    """Positive values as whole steps of their logarithm.

    Attributes:
        steps: of the shape of the values; 0 where there is none, 1 for `low`, the largest step for `high`.
        low: the smallest value.
        high: the largest value, always more than `low`.
    """

    steps: NDArray[np.unsignedinteger]
    low: float
    high: float


def log_steps(values: ArrayLike, dtype: type[np.uint8 | np.uint16]) -> LogSteps:
    """Return values in logarithmic steps; values that are not finite and positive become step 0.

    Args:
        values: of any shape.
        dtype: of the steps; its largest number is the last step.
    """
    given = np.asarray(values, np.float64)
    steps = np.zeros(given.shape, dtype)
    valid = np.isfinite(given) & (given > 0)
    if not valid.any():
        return LogSteps(steps, 1.0, 2.0)
    low, high = float(given[valid].min()), float(given[valid].max()) * (1 + 1e-6)
    position = np.log(given[valid] / low) / np.log(high / low)
    steps[valid] = 1 + np.rint(position * (np.iinfo(dtype).max - 1)).astype(dtype)
    return LogSteps(steps, low, high)


def encode_points(node: OctreeNode, cloud: PointCloud, sigma_steps: NDArray[np.unsignedinteger]) -> str:
    """Return the points of a node as base64, one array after the other.

    The arrays are places within the cube (K, 3) uint16, colours (K, 3) uint8, view counts (K,) uint8, normals
    (K, 3) int8, and steps of the standard deviation (K,) uint8.

    Args:
        node: of the octree.
        cloud: the whole cloud, in the frame of the octree.
        sigma_steps: (N,) uint8 for all points of the cloud; 0 where the standard deviation is unknown.
    """
    chosen = node.chosen
    places = quantised(cloud.points_in_world[chosen], node.lower, node.size)
    normals = np.rint(cloud.normals_in_world[chosen] * 127).clip(-127, 127).astype(np.int8)
    return encode_arrays(places, cloud.colors_rgb[chosen], cloud.view_counts[chosen], normals, sigma_steps[chosen])


def quantised(points: NDArray[np.float32], lower: NDArray[np.float64], size: float) -> NDArray[np.uint16]:
    """Return places within a cube, (K, 3), where 65535 stands for its far side."""
    return np.rint((points - lower) / size * _LEVELS).clip(0, _LEVELS).astype("<u2")


def encode_arrays(*parts: NDArray[np.generic]) -> str:
    """Return arrays, one after the other, as base64."""
    return base64.b64encode(b"".join(np.ascontiguousarray(part).tobytes() for part in parts)).decode("ascii")


def encode_ranges(ranges: NDArray[np.float32]) -> tuple[str, float, float]:
    """Return ranges as base64 of uint16 in logarithmic steps, and the smallest and the largest range.

    Step 0 stands for no range. The steps are below 0.01 % of the range for ranges that differ by a factor of up to 500.

    Args:
        ranges: (H, W) float32; NaN where there is none.
    """
    encoded = log_steps(ranges, np.uint16)
    return encode_arrays(encoded.steps.astype("<u2")), encoded.low, encoded.high


def encode_jpeg(image: NDArray[np.uint8], quality: int) -> str:
    """Return an RGB image as the base64 of a JPEG file."""
    data = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    return base64.b64encode(data.tobytes()).decode("ascii")


def encode_png(image: NDArray[np.uint8]) -> str:
    """Return an RGB or RGBA image as the base64 of a PNG file."""
    swapped = cv2.COLOR_RGB2BGR if image.shape[2] == 3 else cv2.COLOR_RGBA2BGRA
    data = cv2.imencode(".png", cv2.cvtColor(image, swapped))[1]
    return base64.b64encode(data.tobytes()).decode("ascii")
