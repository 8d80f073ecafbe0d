"""How long the Fast Bilateral Solver takes, and where: `python -m tests.benchmarks.fbs [height]`.

Each figure is the median of interleaved runs, in seconds, on the synthetic room with noise, outliers and holes.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np

from pano_mvs.algorithms.filters import bilateral_solver as solver
from pano_mvs.algorithms.filters.bilateral_solver import sphere_cells
from pano_mvs.algorithms.filters.data_term import confidence_weight
from pano_mvs.geometry import Rigid3
from pano_mvs.scene import RangeMap
from pano_mvs.testing.room import default_room, render
from tests.benchmarks.depth_metrics import depth_metrics

RUNS = 7
GOAL_S, LIMIT_S = 0.13, 0.5  # at 512 × 1024


def harmed(ranges: np.ndarray) -> RangeMap:
    """5 % noise, 20 % outliers of low confidence, a tenth missing."""
    rng = np.random.default_rng(0)
    noisy = ranges * (1 + 0.05 * rng.standard_normal(ranges.shape))
    outlier, hole = rng.random(ranges.shape) < 0.2, rng.random(ranges.shape) < 0.1
    noisy[outlier] = rng.uniform(0.5, 6, outlier.sum())
    noisy[hole] = np.nan
    confidence = np.where(np.isnan(noisy), 0, np.where(outlier, 70, 200))
    return RangeMap(noisy.astype(np.float32), confidence.astype(np.uint8))


def main(height: int) -> None:
    """Print the time of the whole, of its parts, and the scores before and after."""
    image, truth = render(default_room(), Rigid3.identity(), (height, 2 * height), supersample=1)
    broken = harmed(truth)
    weight = np.where(broken.valid, confidence_weight(broken.confidence), 0.0)
    target = np.where(broken.valid, 1 / broken.range.astype(np.float64), 0.0)
    cells = sphere_cells(truth.shape, 8.0)
    colors = solver._color_bins(image, 8.0, 8.0)
    works: dict[str, Callable[[], Any]] = {
        "whole": lambda: solver.fast_bilateral_solver(broken, image),
        "cells": lambda: sphere_cells(truth.shape, 8.0),
        "colours": lambda: solver._color_bins(image, 8.0, 8.0),
        "blind guess": lambda: solver._blind_guess(target, weight, cells),
        "system": lambda: solver.build_system(target, weight, colors, cells=cells),
        "guess, system, solve, slice": lambda: solver.solve_bilateral(
            target, weight, colors, cells=cells, smoothness=1.0, iterations=60
        ),
        "control: cv2.bilateralFilter 9": lambda: cv2.bilateralFilter(image, 9, 8, 8),
    }
    seconds: dict[str, list[float]] = {name: [] for name in works}
    for run in range(RUNS + 1):
        for name, work in works.items():
            start = time.perf_counter()
            work()
            if run:  # the first one compiles
                seconds[name].append(time.perf_counter() - start)
    system = solver.build_system(target, weight, colors, cells=cells)
    print(f"{height} × {2 * height}: {len(system.mass)} vertices, {len(system.vertices)} elements")
    for name, values in seconds.items():
        print(f"  {name:32s} {statistics.median(values):.3f} s")
    print(f"  goal {GOAL_S} s, limit {LIMIT_S} s at 512 × 1024")
    for name, ranges in (("before", broken.range), ("after", works["whole"]().range)):
        metrics = depth_metrics(ranges, truth)
        print(f"  {name}: PSNR {metrics.psnr_db:.2f} dB, wMAE {metrics.w_mae:.4f}, wδ<1.05 {metrics.w_delta_105:.3f}")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 512)
