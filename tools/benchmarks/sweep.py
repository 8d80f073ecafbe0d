"""How long the sweep and semi-global matching take.

CPU time of one process, so that other work on the machine counts less; each work in turn, several rounds, the best.
Pictures are noise: the sweep's work does not depend on what is in them. The floor is RGB bilinear sampling from L2 with
the coordinates known; "cv2.remap" does the work of SAD + box with maps that are there already. All run in one thread.
Semi-global matching is measured alone, too, beside the sum of the same volume by numpy.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any
from unittest.mock import patch

import cv2
import numba
import numpy as np
from numba import njit
from numpy.typing import NDArray

from pano_mvs.algorithms.sweep.backends.numba_backend import winners_by_paths
from pano_mvs.algorithms.sweep.hypotheses import virtual_ranges
from pano_mvs.algorithms.sweep.numba import arguments
from pano_mvs.algorithms.sweep.numba.arguments import pack_colors
from pano_mvs.algorithms.sweep.numba.x86.kernels_vector import HAS_VECTOR, PIXELS, sample_rgb_block
from pano_mvs.algorithms.sweep.preparation import SweepInput
from pano_mvs.algorithms.sweep.sweep import SweepSettings, sweep_range
from pano_mvs.geometry import Rigid3, pixel_from_ray, ray_grid, rotation_from_rotvec
from tools.benchmarks.table import print_table

NEAR, FAR = 0.3, 10.0
_U = np.uint64
_FLOOR_HW = (192, 384)  # 0.6 MB packed: more than L1, less than L2
_FLOOR_SAMPLES = 1 << 14
FLOOR_WORK = 64 * _FLOOR_SAMPLES
SAD_BOX = "numba, SAD + box 7×7, sum (the paper)"
LOOPS = "numba, the same by portable loops"
REMAP = "cv2.remap, the same, maps there"


def pictures(rows: int, sources: int) -> tuple[list[np.ndarray], list[Rigid3]]:
    """Return smooth noise, and poses with any rotation and a baseline of 0.3."""
    rng = np.random.default_rng(0)
    noise = [
        cv2.GaussianBlur(rng.integers(0, 256, (rows, 2 * rows, 3), np.uint8), (0, 0), 1) for _ in range(sources + 1)
    ]
    directions = rng.normal(size=(sources, 3))
    directions *= 0.3 / np.linalg.norm(directions, axis=1, keepdims=True)
    return noise, [Rigid3(rotation_from_rotvec(rng.normal(size=3)), direction) for direction in directions]


def measure(*, rows: int, planes: int, sources: int, rounds: int) -> dict[str, float]:
    """Return the least nanoseconds a sample of each work, the floors' among them."""
    images, poses = pictures(rows, sources)
    sad = SweepSettings(planes=planes, cost="sad", aggregation="box", combination="sum", exposure=False)
    configurations = {
        SAD_BOX: sad,
        "numba, SAD + box, best half": sad.replace(combination="best_half"),
        "numba, census + box": SweepSettings(planes=planes, aggregation="box"),
        "numba, census + SGM": SweepSettings(planes=planes),
    }

    def sweep(settings: SweepSettings) -> float:
        work = partial(sweep_range, images[0], images[1:], poses, near=NEAR, far=FAR, settings=settings)
        return cpu_seconds(work)

    samples = 2 * rows * rows * planes * sources
    ranges = virtual_ranges(NEAR, FAR, planes=planes, spacing="inverse")
    found: dict[str, list[float]] = {}
    for turn in range(rounds + 1):
        times = {name: cpu_seconds(work) / FLOOR_WORK for name, work in floors().items()}
        times |= {name: sweep(settings) / samples for name, settings in configurations.items()}
        with patch.object(arguments, "HAS_VECTOR", False):
            times[LOOPS] = sweep(sad) / samples
        times[REMAP] = remap_pipeline(images, poses, ranges) / samples if turn else np.nan
        for name, seconds in times.items() if turn else ():  # the first turn compiles
            found.setdefault(name, []).append(1e9 * seconds)
    return {name: min(values) for name, values in found.items()}


def sweep_rows(found: dict[str, float], samples: int) -> Iterator[list[str]]:
    """Yield the ratios and times of each work."""
    floor = found.get("floor, float coordinates", np.nan)
    for name, ns in found.items():
        seconds = "" if name.startswith("floor") else f"{ns * samples / 1e9:.2f}"
        yield [name, f"{ns / floor:.1f}", f"{found[REMAP] / ns:.2f}", f"{ns:.2f}", seconds]


def sgm_row(rows: int, planes: int, rounds: int) -> list[str]:
    """Return the time of semi-global matching on a volume of noise, and of the sum of the volume."""
    rng = np.random.default_rng(0)
    volume = rng.integers(0, 256, (rows, planes, 2 * rows), dtype=np.uint8)
    picture = rng.integers(0, 256, (rows, 2 * rows, 1), dtype=np.uint8)
    work = SweepInput(picture, (), (), None, np.linspace(1, 2, planes), SweepSettings(planes=planes))
    works = (partial(winners_by_paths, work, volume), partial(np.sum, volume, dtype=np.int64))
    times = np.array([[cpu_seconds(each) for each in works] for _ in range(rounds + 1)])
    sgm, control = times[1:].min(axis=0)  # the first call compiles
    return [f"{rows}×{2 * rows}×{planes}", f"{sgm:.3f}", f"{1e9 * sgm / volume.size:.2f}", f"{control:.3f}"]


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


def main(rows: int = 512, planes: int = 128, sources: int = 3, rounds: int = 3) -> None:
    """Print the tables; the second one has the same number of rows and planes."""
    numba.set_num_threads(1)
    cv2.setNumThreads(1)
    found = measure(rows=rows, planes=planes, sources=sources, rounds=rounds)
    print(f"{rows}×{2 * rows}, {sources} sources, {planes} planes, one thread\n")
    columns = ["work", "× floor", "cv2.remap takes × as long", "ns/sample", "CPU-s"]
    print_table(columns, sweep_rows(found, 2 * rows**2 * planes * sources))
    print()
    columns = ["semi-global matching", "CPU-s", "ns a voxel", "sum of the volume by numpy, CPU-s"]
    print_table(columns, [sgm_row(rows, planes, rounds)])
