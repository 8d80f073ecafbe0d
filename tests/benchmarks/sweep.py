"""How long the sweep takes: `python -m tests.benchmarks.sweep [--small] [--rows 512] [--planes 128] [--sources 3]`.

CPU time of one process, so that other work on the machine counts less; each work in turn, several rounds, the best.
Pictures are noise: the sweep's work does not depend on what is in them. The floor is RGB bilinear sampling from L2 with
the coordinates known; "cv2.remap" does the work of SAD + box with maps that are there already. All run in one thread.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from functools import partial
from unittest.mock import patch

import cv2
import numba
import numpy as np

from pano_mvs.algorithms.sweep.hypotheses import virtual_ranges
from pano_mvs.algorithms.sweep.numba import arguments
from pano_mvs.algorithms.sweep.sweep import SweepSettings, sweep_range
from pano_mvs.geometry import Rigid3, rotation_from_rotvec
from tests.benchmarks.sampling import FLOOR_WORK, cpu_seconds, floors, remap_pipeline

NEAR, FAR = 0.3, 10.0
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


def table(found: dict[str, float], samples: int) -> str:
    """Return the ratios and times as markdown."""
    floor = found.get("floor, float coordinates", np.nan)
    lines = ["| work | × floor | cv2.remap takes × as long | ns/sample | CPU-s |", "|---|---|---|---|---|"]
    for name, ns in found.items():
        seconds = "" if name.startswith("floor") else f"{ns * samples / 1e9:.2f}"
        lines.append(f"| {name} | {ns / floor:.1f} | {found[REMAP] / ns:.2f} | {ns:.2f} | {seconds} |")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--small", action="store_true", help="128 rows, 16 planes, one round")
    parser.add_argument("--rows", type=int, default=512)
    parser.add_argument("--planes", type=int, default=128)
    parser.add_argument("--sources", type=int, default=3)
    parser.add_argument("--rounds", type=int, default=3)
    options = parser.parse_args(arguments)
    if options.small:
        options.rows, options.planes, options.rounds = 128, 16, 1
    numba.set_num_threads(1)
    cv2.setNumThreads(1)
    shared = {"rows": options.rows, "planes": options.planes, "sources": options.sources}
    found = measure(**shared, rounds=options.rounds)
    print(f"{options.rows}×{2 * options.rows}, {options.sources} sources, {options.planes} planes, one thread\n")
    print(table(found, 2 * options.rows**2 * options.planes * options.sources))


if __name__ == "__main__":
    main()
