"""What the sweep is measured against: the floor of sampling, and the same work by cv2.remap."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from pano_mvs.algorithms.sweep.numba.arguments import pack_colors
from pano_mvs.algorithms.sweep.numba.x86.kernels_vector import HAS_VECTOR, PIXELS, sample_rgb_block
from pano_mvs.geometry import Rigid3, pixel_from_ray, ray_grid

_U = np.uint64
_FLOOR_HW = (192, 384)  # 0.6 MB packed: more than L1, less than L2
_FLOOR_SAMPLES = 1 << 14


def cpu_seconds(work: Callable[[], object]) -> float:
    """Return the CPU time of this process for one call."""
    start = time.process_time()
    work()
    return time.process_time() - start


@njit(nogil=True, error_model="numpy")
def _split(
    x: NDArray[np.float32],
    y: NDArray[np.float32],
    stride: int,
    index: NDArray[np.int32],
    weight_x: NDArray[np.int32],
    weight_y: NDArray[np.int32],
) -> None:
    for i in range(_U(index.shape[0])):
        column, row = np.int32(x[i]), np.int32(y[i])
        index[i] = np.int32(row * np.int32(stride) + column)
        across = np.int32((x[i] - np.float32(column)) * np.float32(16384) + np.float32(0.5))
        down = np.int32((y[i] - np.float32(row)) * np.float32(16384) + np.float32(0.5))
        weight_x[i] = np.int32(np.int32(16384) + across * np.int32(65535))
        weight_y[i] = np.int32(np.int32(16384) + down * np.int32(65535))


@njit(nogil=True, error_model="numpy")
def _sample(
    packed: NDArray[np.uint32],
    x: NDArray[np.float32],
    y: NDArray[np.float32],
    stride: int,
    convert: bool,
    index: NDArray[np.int32],
    weight_x: NDArray[np.int32],
    weight_y: NDArray[np.int32],
    out: NDArray[Any],
) -> None:
    if convert:
        _split(x, y, stride, index, weight_x, weight_y)
    for i in range(0, index.shape[0], PIXELS):
        sample_rgb_block(packed, _U(0), index, weight_y, weight_x, _U(i), out, _U(i), _U(index.shape[0]))


def floors() -> dict[str, Callable[[], object]]:
    """Return works of 64 × 16384 RGB bilinear samples from L2; empty where there are no vector instructions.

    One starts from float coordinates, the other from indices and fixed-point weights, as cv2's fixed-point maps are.
    """
    if not HAS_VECTOR:
        return {}
    height, width = _FLOOR_HW
    packed = pack_colors(np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8)).ravel()
    k = np.arange(_FLOOR_SAMPLES)
    x = (20.3 + k % 256 * 1.1).astype(np.float32)
    y = (15.1 + k // 256 * 1.3 + k % 256 * 0.2).astype(np.float32)
    index, weight_x, weight_y = np.zeros((3, _FLOOR_SAMPLES), np.int32)
    out = np.zeros(3 * _FLOOR_SAMPLES, np.uint8)

    def work(convert: bool) -> None:
        for _ in range(64):
            _sample(packed, x, y, width + 2, convert, index, weight_x, weight_y, out)

    return {"floor, float coordinates": lambda: work(True), "floor, fixed-point coordinates": lambda: work(False)}


FLOOR_WORK = 64 * _FLOOR_SAMPLES


def remap_pipeline(pictures: list[np.ndarray], poses: list[Rigid3], ranges: np.ndarray) -> float:
    """Return the CPU seconds of SAD 7×7 with winner by cv2.remap, without those of its fixed-point maps."""
    reference, sources = pictures[0], pictures[1:]
    height, width = reference.shape[:2]
    rays = ray_grid((height, width))
    best, winner = np.full((height, width), np.inf, np.float32), np.zeros((height, width), np.int32)
    padded = [cv2.copyMakeBorder(source, 1, 1, 1, 1, cv2.BORDER_WRAP) for source in sources]
    seconds = 0.0
    for plane, distance in enumerate(ranges):
        pixels = [pixel_from_ray(pose.apply(rays * distance), (height, width)) for pose in poses]
        maps = [cv2.convertMaps((p + 0.5).astype(np.float32), None, cv2.CV_16SC2) for p in pixels]
        start = time.process_time()
        total = np.zeros((height, width), np.float32)
        for source, (whole, fraction) in zip(padded, maps, strict=True):
            difference = cv2.absdiff(reference, cv2.remap(source, whole, fraction, cv2.INTER_LINEAR))
            total += cv2.transform(difference, np.ones((1, 3), np.float32)).astype(np.float32)
        cost = cv2.blur(total, (7, 7))
        cheaper = cost < best
        winner[cheaper] = plane
        best = np.minimum(best, cost)
        seconds += time.process_time() - start
    return seconds
