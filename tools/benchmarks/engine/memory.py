"""How much memory a sweep takes.

The peak of the resident memory of a fresh process for each configuration, less that of one that has made the pictures
and loaded the kernels but swept nothing larger than 16 × 32. With --large: all that a process takes in which a panorama
of 8192 × 4096 pixels is swept against two others, pictures and limits included.
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
from collections.abc import Iterator
from typing import Literal

import numba
import numpy as np

from pano_mvs.algorithms.sweep.limits import limits_by_sweeping
from pano_mvs.algorithms.sweep.sweep import SweepSettings, sweep_range
from pano_mvs.geometry import Rigid3
from tools.benchmarks.sweep import FAR, NEAR, pictures
from tools.benchmarks.table import print_table


def peak_mb(rows: int, planes: int, sources: int, aggregation: str, threads: int) -> float:
    """Return what a sweep adds to the peak of this process, in MB; to be called once in a process."""
    numba.set_num_threads(threads)
    settings = SweepSettings(planes=planes, cost="sad", exposure=False).replace(aggregation=aggregation)
    small, poses = pictures(16, sources)
    images, _ = pictures(rows, sources)
    sweep_range(small[0], small[1:], poses, near=NEAR, far=FAR, settings=settings.replace(planes=3))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    sweep_range(images[0], images[1:], poses, near=NEAR, far=FAR, settings=settings)
    return (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024


def large_peak_mb(rows: int, planes: int, aggregation: Literal["box", "sgm"], threads: int) -> float:
    """Return the peak of a process, in MB, that runs the stage on three panoramas; to be called once in a process."""
    numba.set_num_threads(threads)
    images, poses = pictures(rows, 2)
    cams = [Rigid3(np.eye(3), np.zeros(3)), *poses]
    masks = [np.ones(image.shape[:2], np.bool_) for image in images]
    near, far = limits_by_sweeping(images, cams, masks=masks)
    settings = SweepSettings(planes=planes, aggregation=aggregation)
    sweep_range(
        images[0],
        images[1:],
        poses,
        near=near,
        far=far,
        settings=settings,
        reference_mask=masks[0],
        source_masks=masks[1:],
    )
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def fresh_peak_mb(*configuration: object) -> float:
    """Return `peak_mb`, or of four values `large_peak_mb`, of a fresh process."""
    command = [sys.executable, "-m", "tools", "benchmarks", "engine.memory", "--one", json.dumps(configuration)]
    return float(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def main(large: bool = False, one: str = "", rows: int = 512, planes: int = 128, sources: int = 3) -> None:
    """Print the table, or the one figure that a fresh process is asked for; `large` is for 8192 × 4096 pixels."""
    if one:
        configuration = json.loads(one)
        print(peak_mb(*configuration) if len(configuration) == 5 else large_peak_mb(*configuration))
        return
    if large:
        sizes = ((4096, 32, "box", 2), (4096, 128, "sgm", 2))
        measured = ([*size, f"{fresh_peak_mb(*size):.0f}"] for size in sizes)
        print_table(["rows", "planes", "aggregation", "threads", "peak, MB"], measured)
        return
    configurations = [
        (rows, planes // 4, sources, "box", 1),
        (rows, planes, sources, "box", 1),
        (rows, planes, sources, "box", 2),
        (rows, planes // 4, 2 * sources, "box", 1),
        (2 * rows, planes // 4, sources, "box", 1),
        (rows, planes // 4, sources, "sgm", 1),
        (rows, planes, sources, "sgm", 1),
    ]
    peaks: list[float] = []

    def measure() -> Iterator[list[object]]:
        for configuration in configurations:
            peaks.append(fresh_peak_mb(*configuration))
            yield [*configuration, f"{peaks[-1]:.0f}"]

    print_table(["rows", "planes", "sources", "aggregation", "threads", "peak, MB"], measure())
    more = planes - planes // 4
    slope, per_voxel = (peaks[1] - peaks[0]) / more * 1024, (peaks[6] - peaks[5]) * 2**20 / (more * 2 * rows * rows)
    print(f"\nbox: {slope:.1f} KB for each further plane; sgm: {per_voxel:.2f} bytes for each pixel and further plane")
