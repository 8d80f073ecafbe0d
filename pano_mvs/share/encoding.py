"""Arrays as the short texts that the page decodes."""

from __future__ import annotations

import base64

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.scene import PointCloud
from pano_mvs.share.octree import OctreeNode

_LEVELS = 65535


def encode_points(node: OctreeNode, cloud: PointCloud) -> str:
    """Return the points of a node as base64, one array after the other.

    The arrays are places within the cube (K, 3) uint16, colours (K, 3) uint8, view counts (K,) uint8, and normals
    (K, 3) int8.

    Args:
        node: of the octree.
        cloud: the whole cloud, in the frame of the octree.
    """
    chosen = node.chosen
    places = np.rint((cloud.points_in_world[chosen] - node.lower) / node.size * _LEVELS).clip(0, _LEVELS)
    normals = np.rint(cloud.normals_in_world[chosen] * 127).clip(-127, 127)
    parts = (places.astype("<u2"), cloud.colors_rgb[chosen], cloud.view_counts[chosen], normals.astype(np.int8))
    return base64.b64encode(b"".join(np.ascontiguousarray(part).tobytes() for part in parts)).decode("ascii")


def encode_ranges(ranges: NDArray[np.float32]) -> tuple[str, float, float]:
    """Return ranges as base64 of uint16 in logarithmic steps, and the smallest and the largest range.

    Step 0 stands for no range. The steps are below 0.01 % of the range for ranges that differ by a factor of up to 500.

    Args:
        ranges: (H, W) float32; NaN where there is none.
    """
    valid = np.isfinite(ranges) & (ranges > 0)
    if not valid.any():
        return base64.b64encode(np.zeros(ranges.shape, "<u2").tobytes()).decode("ascii"), 1.0, 2.0
    low, high = float(ranges[valid].min()), float(ranges[valid].max()) * (1 + 1e-6)
    steps = np.zeros(ranges.shape, "<u2")
    position = np.log(ranges[valid].astype(np.float64) / low) / np.log(high / low)
    steps[valid] = 1 + np.rint(position * (_LEVELS - 1)).astype(np.uint16)
    return base64.b64encode(steps.tobytes()).decode("ascii"), low, high


def encode_jpeg(image: NDArray[np.uint8], quality: int) -> str:
    """Return an RGB image as the base64 of a JPEG file."""
    data = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    return base64.b64encode(data.tobytes()).decode("ascii")
