"""How long large captures take.

Cameras 0.7 apart along a corridor, each finding some hundred key points with noise of 0.03°, a fifth of the matches
wrong; pairs by retrieval among all. Seconds are CPU time of one process; each size runs in a process of its own,
whose peak of memory is what it adds to a process that has loaded the same modules.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np

from pano_mvs.algorithms.matching.pair_selection import retrieval_pairs
from pano_mvs.algorithms.matching.vlad import vlad_descriptor
from pano_mvs.algorithms.poses.adjustment.refine import refine_poses
from pano_mvs.algorithms.poses.scaled_translation import solve_scaled_translation
from pano_mvs.geometry import similarity_from_points
from tests.algorithms.poses.synthetic_path import path_capture, path_two_views

Result = TypeVar("Result")

NEIGHBOURS = 8
COLUMNS = {
    "cameras": "{:.0f}",
    "registered": "{:.0f}",
    "pairs": "{:.0f}",
    "points": "{:.0f}",
    "observations": "{:.0f}",
    "select_s": "{:.2f}",
    "solve_s": "{:.1f}",
    "refine_s": "{:.1f}",
    "peak_mb": "{:.0f}",
    "drift_percent": "{:.4f}",
    "deviation_percent": "{:.4f}",
}


def measure(cameras: int, keypoints: int) -> dict[str, float]:
    """Return seconds, megabytes and drift of one size."""
    rng = np.random.default_rng(cameras)
    capture = path_capture(rng, cameras, keypoints=keypoints, described=True)
    names = list(capture.poses)
    views = path_two_views(rng, capture)
    base_mb = _peak_mb()
    _warm_up()
    select_s, _ = _timed(
        lambda: retrieval_pairs(
            names, {name: vlad_descriptor(capture.features[name]) for name in names}, neighbours=NEIGHBOURS
        )
    )
    solve_s, poses = _timed(lambda: solve_scaled_translation(capture.features, views, rng=rng))
    refine_s, refined = _timed(lambda: refine_poses(poses))
    truth = np.array([capture.poses[name].center for name in refined.names])
    laid = similarity_from_points(refined.centers, truth)
    last = np.linalg.norm(laid.apply(refined.centers) - truth, axis=1)[-1]
    assert refined.center_stds is not None
    return {
        "cameras": cameras,
        "registered": len(refined.names),
        "pairs": len(views),
        "points": len(refined.points_in_world),
        "observations": len(refined.track_point_idx),
        "select_s": select_s,
        "solve_s": solve_s,
        "refine_s": refine_s,
        "peak_mb": _peak_mb() - base_mb,
        "drift_percent": 100 * last / capture.length,
        "deviation_percent": 100 * laid.scale * float(refined.center_stds[-1]) / capture.length,
    }


def print_table(rows: Sequence[dict[str, float]]) -> None:
    """Print the figures as a Markdown table."""
    print("| " + " | ".join(name.replace("_", " ") for name in COLUMNS) + " |")
    print("|" + "---|" * len(COLUMNS))
    for row in rows:
        print("| " + " | ".join(form.format(row[name]) for name, form in COLUMNS.items()) + " |")


def plot(rows: Sequence[dict[str, float]], path: Path) -> None:
    """Draw seconds and megabytes against the number of pairs."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 3), layout="constrained")
    FigureCanvasAgg(figure)
    seconds, memory = figure.subplots(1, 2)
    pairs = [row["pairs"] for row in rows]
    for name, label in (("solve_s", "solve"), ("refine_s", "refine"), ("select_s", "select pairs")):
        seconds.plot(pairs, [row[name] for row in rows], "o-", label=label)
    seconds.set(xlabel="pairs", ylabel="CPU seconds")
    seconds.legend(frameon=False)
    memory.plot(pairs, [row["peak_mb"] for row in rows], "o-", color="tab:gray")
    memory.set(xlabel="pairs", ylabel="MB beyond the input", ylim=(0, None))
    for axes in (seconds, memory):
        axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=80)


def _timed(work: Callable[[], Result]) -> tuple[float, Result]:
    start = time.process_time()
    result = work()
    return time.process_time() - start, result


def _warm_up() -> None:
    """Load the compiled kernels."""
    rng = np.random.default_rng(0)
    capture = path_capture(rng, 3, keypoints=150)
    solve_scaled_translation(capture.features, path_two_views(rng, capture), rng=rng)


def _peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def main() -> None:
    """Measure every size in a process of its own, and print and plot."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cameras", type=int, nargs="+", default=[30, 60, 100, 300])
    parser.add_argument("--keypoints", type=int, default=300)
    parser.add_argument("--plot", type=Path)
    parser.add_argument("--one", type=int, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.one:
        print(json.dumps(measure(arguments.one, arguments.keypoints)))
        return
    rows = []
    for cameras in arguments.cameras:
        command = [sys.executable, "-m", "tools", "benchmarks", "poses.large", "--one", str(cameras)]
        output = subprocess.run([*command, "--keypoints", str(arguments.keypoints)], check=True, capture_output=True)
        rows.append(json.loads(output.stdout))
    print_table(rows)
    if arguments.plot:
        plot(rows, arguments.plot)
