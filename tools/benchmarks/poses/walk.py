"""Drift and time of a walk with loops.

Panoramas are rendered along a path through a house (`house_walk`) that returns to places which it has seen. They go
through the stages of the preset `walk` up to the poses, one stage per process, so that CPU seconds can be read. Drift
is the error of the camera positions after alignment of all cameras with the truth, relative to the length of the path.
With `--twins`, two pairs of rooms look the same, so that retrieval proposes false loop closures. FOLDER keeps the
images and the cache.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np

from pano_mvs.geometry import Rigid3, similarity_from_points
from pano_mvs.results.summary import RunSummary
from tools.benchmarks.poses.house_walk import walk_poses, write_walk

WORKFLOW = """
pano_mvs: 1
name: walk
stages:
  images:   {{use: source.folder, path: {images}}}
  features: {{use: features.sift_tangent}}
  looks:    {{use: global.vlad}}
  pairs:    {{use: pairs.sequential, window: 4, loop_closure: {closures}}}
  matches:  {{use: matches.brute_force}}
  poses:    {{use: poses.scaled_translation}}
  verified: {{use: poses.verify}}
  refined:  {{use: poses.refine}}
  levelled: {{use: poses.level}}
  colmap:   {{use: export.colmap}}
"""
TIMED = ("features", "pairs", "matches", "poses", "verified", "refined")


def measure(folder: Path, views: int, *, images: Path, closures: int, stages: tuple[str, ...]) -> dict[str, float]:
    """Return CPU seconds of stages, and drift in percent, of the first views of a walk."""
    name = f"{images.name}_{views}_{closures}"
    part = folder / f"{name}_images"
    part.mkdir(exist_ok=True)
    for idx in range(views):
        link = part / f"{idx:03d}.png"
        if not link.exists():
            os.link(images / link.name, link)
    workflow = folder / f"{name}.yaml"
    workflow.write_text(WORKFLOW.format(images=json.dumps(str(part)), closures=closures))
    row: dict[str, float] = {"views": views, "closures": closures}
    command = [
        sys.executable,
        "-m",
        "pano_mvs",
        "run",
        str(workflow),
        "--out",
        str(folder / name),
        "--executor",
        "serial",
    ]
    command += ["--cache", str(folder / "cache")]
    for stage in stages:
        before = _child_seconds()
        subprocess.run([*command, "--until", stage, "--refresh", stage], check=True, capture_output=True)
        row[f"{stage}_s"] = _child_seconds() - before
    subprocess.run(command, check=False, capture_output=True)
    truth = dict(zip((f"{idx:03d}.png" for idx in range(views)), walk_poses(views), strict=True))
    return row | drift(RunSummary.read(folder / name), truth)


def drift(summary: RunSummary, truth: dict[str, Rigid3]) -> dict[str, float]:
    """Return how far the cameras of the largest group are from the truth, in percent of the length of the path."""
    found = dict(zip(summary.poses.registered, summary.poses.centers, strict=True))
    names = [name for name in summary.poses.groups[0].images if name in found]
    every = np.array([pose.center for pose in truth.values()])
    length = float(np.linalg.norm(np.diff(every, axis=0), axis=1).sum())
    centers = np.array([found[name] for name in names])
    actual = np.array([truth[name].center for name in names])
    offsets = np.linalg.norm(similarity_from_points(centers, actual).apply(centers) - actual, axis=1)
    return {
        "registered": len(names),
        "doubts": len(summary.poses.doubts),
        "pairs": len(summary.poses.links),
        "path": length,
        "rms_percent": 100 * float(np.sqrt(np.mean(offsets**2))) / length,
        "max_percent": 100 * float(offsets.max()) / length,
    }


def main() -> None:
    """Render, measure and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--views", type=int, nargs="+", default=[75, 150, 300])
    parser.add_argument("--width", type=int, default=512)
    parser.add_argument("--closures", type=int, nargs="+", default=[4, 0], help="settings of loop_closure")
    parser.add_argument("--twins", action="store_true", help="two pairs of rooms look the same")
    parser.add_argument("--stages", nargs="*", default=list(TIMED), help="stages whose time is measured")
    arguments = parser.parse_args()
    images = arguments.folder / f"{'twins' if arguments.twins else 'walk'}_{arguments.width}"
    write_walk(images, max(arguments.views), width=arguments.width, twins=arguments.twins)
    for views in arguments.views:
        for closures in arguments.closures:
            row = measure(arguments.folder, views, images=images, closures=closures, stages=tuple(arguments.stages))
            print(json.dumps({name: round(value, 4) for name, value in row.items()}), flush=True)


def _child_seconds() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime
