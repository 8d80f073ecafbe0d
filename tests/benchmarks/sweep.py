"""How long the sweep takes: `python -m tests.benchmarks.sweep [--rows 512] [--planes 128] [--sources 3]`.

CPU time of this process, so that other work on the machine counts less; each configuration in turn, several rounds,
the median of them. Pictures are noise: the sweep's work does not depend on what is in them.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Sequence

import cv2
import numpy as np

from pano_mvs.algorithms.sweep.sweep import SweepSettings, sweep_range
from pano_mvs.geometry import Rigid3, rotation_from_rotvec

CENSUS_SGM = "numba census + SGM"
SAD_BOX = "numba SAD + box (the paper)"
NUMPY = "numpy census + SGM"


def pictures(rows: int, sources: int) -> tuple[list[np.ndarray], list[Rigid3]]:
    """Return smooth noise, and poses with any rotation and a baseline of 0.3."""
    rng = np.random.default_rng(0)
    noise = [
        cv2.GaussianBlur(rng.integers(0, 256, (rows, 2 * rows, 3), np.uint8), (0, 0), 1) for _ in range(sources + 1)
    ]
    directions = rng.normal(size=(sources, 3))
    directions *= 0.3 / np.linalg.norm(directions, axis=1, keepdims=True)
    return noise, [Rigid3(rotation_from_rotvec(rng.normal(size=3)), direction) for direction in directions]


def measure(*, rows: int, planes: int, sources: int, rounds: int, with_numpy: bool) -> dict[str, tuple[float, float]]:
    """Return the first call's and the median later call's CPU seconds of each configuration."""
    census = SweepSettings(planes=planes)
    sad = SweepSettings(planes=planes, cost="sad", aggregation="box", exposure=False)
    work = {CENSUS_SGM: (census, "numba"), SAD_BOX: (sad, "numba")}
    if with_numpy:
        work[NUMPY] = (census, "numpy")
    images, poses = pictures(rows, sources)
    seconds: dict[str, list[float]] = {name: [] for name in work}
    for turn in range(rounds + 1):
        for name, (settings, backend) in work.items():
            if backend == "numpy" and turn > 1:
                continue
            start = time.process_time()
            sweep_range(images[0], images[1:], poses, near=0.3, far=10.0, settings=settings, backend=backend)
            seconds[name].append(time.process_time() - start)
    return {name: (times[0], statistics.median(times[1:])) for name, times in seconds.items()}


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rows", type=int, default=512)
    parser.add_argument("--planes", type=int, default=128)
    parser.add_argument("--sources", type=int, default=3)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument(
        "--numpy-rows", type=int, default=128, help="picture size for the numpy backend; 0 leaves it out"
    )
    options = parser.parse_args(arguments)
    shared = {"planes": options.planes, "sources": options.sources, "rounds": options.rounds}
    _print(options.rows, shared, measure(rows=options.rows, with_numpy=False, **shared))
    if options.numpy_rows:
        _print(options.numpy_rows, shared, measure(rows=options.numpy_rows, with_numpy=True, **shared))


def _print(rows: int, shared: dict[str, int], results: dict[str, tuple[float, float]]) -> None:
    samples = rows * 2 * rows * shared["planes"] * shared["sources"]
    base = results[CENSUS_SGM][1]
    print(f"{rows}×{2 * rows}, {shared['sources']} sources, {shared['planes']} planes, {cv2.getNumThreads()} cores")
    print(f"{'':28}  first CPU-s  later CPU-s  ns/sample  ratio")
    for name, (first, later) in results.items():
        print(f"{name:28}  {first:11.2f}  {later:11.2f}  {later / samples * 1e9:9.2f}  {later / base:5.1f}")


if __name__ == "__main__":
    main()
