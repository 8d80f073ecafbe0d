"""How long a whole sweep takes by the clock, by backend and device.

The pictures show a synthetic room. Every backend takes all cores, or the device that is named; the first sweep of each,
which compiles or loads, is not counted. PyTorch's backend comes with `plugins/pano_mvs_torch`.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from importlib.metadata import entry_points

import numpy as np

from pano_mvs.algorithms.sweep.settings import SweepSettings
from pano_mvs.algorithms.sweep.sweep import sweep_range
from pano_mvs.scene import RangeMap
from pano_mvs.testing.room import capture_poses, default_room, render
from pano_mvs.testing.sweep_backends import FAR, NEAR
from tools.benchmarks.table import print_table


def rows_of(rows: int, *, planes: int, sources: int, rounds: int, devices: list[str]) -> Iterator[list[str]]:
    """Yield for each configuration the seconds of a sweep on each device, and how much of the range maps is equal."""
    world = capture_poses(sources + 1, seed=1, spread=0.4)
    images = [render(default_room(1), pose, (rows, 2 * rows))[0] for pose in world]
    poses = [pose @ world[0].inverse() for pose in world[1:]]
    sgm = SweepSettings(planes=planes, cost="census_gradient")
    configurations = {
        "SAD + box": sgm.replace(cost="sad", aggregation="box", combination="sum", exposure=False),
        "census_gradient + box": sgm.replace(aggregation="box"),
        "census_gradient + SGM": sgm.replace(edge_support=1),
        "… averaged along edges": sgm,
    }
    for name, settings in configurations.items():
        found: list[RangeMap] = []
        seconds: list[str] = []
        for device in devices:
            backend, _, place = device.partition(":")
            times = []
            for _ in range(rounds + 1):
                start = time.perf_counter()
                result = sweep_range(
                    images[0],
                    images[1:],
                    poses,
                    near=NEAR,
                    far=FAR,
                    settings=settings,
                    backend=backend,
                    device=place or "auto",
                )
                times.append(time.perf_counter() - start)
            found.append(result)
            seconds.append(f"{min(times[1:]):.3f}")
        with np.errstate(invalid="ignore"):
            alike = [np.mean(np.abs(each.range / found[0].range - 1) < 1e-3) for each in found[1:]]
        yield [f"{rows}×{2 * rows}", name, *seconds, *(f"{100 * share:.2f}" for share in alike)]


def main(
    rows: int = 512, planes: int = 128, sources: int = 3, rounds: int = 3, devices: str = "numba torch:cuda"
) -> None:
    """Print the table; devices are BACKEND or BACKEND:DEVICE, separated by spaces."""
    for entry in entry_points(group="pano_mvs.plugins"):
        entry.load()
    names = devices.split()
    columns = ["size", "work", *(f"{name}, s" for name in names), *(f"{name}: same range, %" for name in names[1:])]
    print(f"{planes} planes, {sources} sources\n")
    print_table(columns, rows_of(rows, planes=planes, sources=sources, rounds=rounds, devices=names))
