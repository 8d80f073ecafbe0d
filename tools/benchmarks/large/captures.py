"""Captures of hundreds of panoramas, from images to the cloud.

A city that a car drives through, or a building of rooms that somebody walks through (`places`), is drawn once, and its
first images are run with a preset, first to the poses, then to the end, then again. Printed are, for each number of
images: CPU seconds for each, the peak memory of a process, the files and the size of the cache, the cameras that are
placed, those that are doubted, and the errors of positions after alignment with the truth. The last line has the
exponents, the slopes of the logarithms against the number of images.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from pano_mvs.geometry import Rigid3, similarity_from_points
from pano_mvs.results.summary import RunSummary
from tools.benchmarks.large.places import PLACES
from tools.benchmarks.table import print_table

Row = dict[str, float]


def main(
    folder: Path,
    place: str = "city",
    views: Annotated[list[int] | None, typer.Option()] = None,
    most: int = 2000,
    width: int = 2048,
    workflow: str = "fast",
    poses: str = "levelled",
    full: bool = True,
) -> None:
    """Draw, run and print.

    Args:
        folder: where images, caches and results are kept.
        place: city or building.
        views: numbers of images; default 200, 500, 1000 and 2000.
        most: number of images for which the place is made; the others are the first of these.
        width: columns of the images.
        workflow: preset or file.
        poses: its stage with the poses.
        full: whether it is run to its end, too.
    """
    truth = PLACES[place](most).write(folder / f"{place}_{most}_{width}", width=width, views=max(views or [2000]))
    found: list[Row] = []
    columns: list[str] = []
    for count in views or (200, 500, 1000, 2000):
        names = list(truth)[:count]
        images = folder / f"{place}_{most}_{width}_first_{count}"
        _link(folder / f"{place}_{most}_{width}", images, names)
        run = [workflow, "--images", str(images), "--cache", str(folder / f"{images.name}_cache")]
        row = _measured(run, images.with_name(f"{images.name}_out"), poses, full=full)
        out = RunSummary.read(images.with_name(f"{images.name}_out"))
        found.append({"images": count} | row | errors(out, {name: truth[name] for name in names}))
        columns = list(found[-1])
        print(", ".join(f"{name} {value:.4g}" for name, value in found[-1].items()), flush=True)
    print_table(columns, ([f"{row[name]:.4g}" for name in columns] for row in found))
    if len(found) > 1:
        print_table(columns[1:], [[_exponent(found, name) for name in columns[1:]]])


def _link(images: Path, to: Path, names: list[str]) -> None:
    to.mkdir(exist_ok=True)
    for name in names:
        if not (to / name).exists():
            os.link(images / name, to / name)


def _measured(run: list[str], out: Path, poses: str, *, full: bool) -> Row:
    """Run to the poses, to the end, and again; return what each took."""
    cache = Path(run[-1])
    row = {}
    for name, more in {"poses": ["--until", poses], **({"rest": [], "again": []} if full else {})}.items():
        cpu_s, peak_mb = _command(["run", *run, "--out", str(out), *more])
        row[f"{name}: CPU-s an image"] = cpu_s
        row[f"{name}: MB"] = peak_mb
    files = [path for path in cache.rglob("*") if path.is_file()]
    count = len(list(Path(run[2]).iterdir()))
    row["files an image"] = len(files) / count
    row["cache, MB an image"] = sum(path.stat().st_size for path in files) / count / 1e6
    return {name: value / count if "CPU-s" in name else value for name, value in row.items()}


def _command(arguments: list[str]) -> tuple[float, float]:
    """Return the CPU seconds of a command with its workers, and the largest memory of one of them in MB."""
    process = subprocess.Popen([sys.executable, "-m", "pano_mvs", *arguments], stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode not in (0, 3):
        raise SystemExit(f"{' '.join(arguments)}: exit code {process.returncode}")
    return usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1000


def errors(summary: RunSummary, truth: Mapping[str, Rigid3]) -> Row:
    """Return how many cameras are in the largest group, right and doubted there, and how far they are off.

    A camera is right within 2 % of the extent of the capture, or a fifth of the distance between consecutive cameras,
    whichever is less.
    """
    found = dict(zip(summary.poses.registered, summary.poses.centers, strict=True))
    names = [name for name in summary.poses.groups[0].images if name in found]
    actual = np.array([truth[name].center for name in names])
    centers = np.array([found[name] for name in names])
    offsets = np.linalg.norm(similarity_from_points(centers, actual).apply(centers) - actual, axis=1)
    every = np.array([pose.center for pose in truth.values()])
    step = float(np.median(np.linalg.norm(np.diff(every, axis=0), axis=1)))
    right = offsets < min(0.2 * step, 0.02 * float(np.ptp(every, axis=0).max()))
    doubted = np.array([name in summary.doubts for name in names])
    return {
        "groups": len(summary.poses.groups),
        "placed": len(names),
        "right": int(right.sum()),
        "right, doubted": int((right & doubted).sum()),
        "wrong, not doubted": int((~right & ~doubted).sum()),
        "error, median, % of a step": 100 * float(np.median(offsets)) / step,
        "largest": 100 * float(offsets.max()) / step,
        "pairs": len(summary.poses.links),
    }


def _exponent(rows: list[Row], name: str) -> str:
    counts, values = np.array([row["images"] for row in rows]), np.array([row[name] for row in rows])
    if (values <= 0).any():
        return ""
    slope = float(np.polyfit(np.log(counts), np.log(values), 1)[0])
    return f"{slope + ('an image' in name):.2f}"
