"""Coarse to fine against the plain sweep: `python -m tests.benchmarks.coarse_to_fine [--rows 512] [--planes 128]`.

CPU time, both in turn in one process, medians; the share of pixels more than 5 % off the truth; the share of the
scene's thin rods that is within 5 %. With --capture DIR (images/, poses.json and depth.npz as `write_capture` writes
them) that capture instead of the synthetic scenes.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import statistics
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np

from pano_mvs.algorithms.sweep.limits import limits_by_sweeping
from pano_mvs.algorithms.sweep.sweep import SweepSettings, sweep_range
from pano_mvs.geometry import Rigid3
from pano_mvs.testing.room import default_room, render
from pano_mvs.testing.scenes import SCENES, Scene
from tests.stored import read_picture

Case = tuple[str, list[np.ndarray], list[Rigid3], np.ndarray, np.ndarray | None]


def scene_cases(rows: int, sources: int) -> Iterator[Case]:
    """Yield each synthetic scene: name, pictures, poses, the truth of view 0 and where its thin rods are."""
    for name, make in SCENES.items():
        scene = make(seed=3)
        views = [scene.view(idx, (rows, 2 * rows), supersample=1) for idx in range(sources + 1)]
        thin = _thin(scene, views[0][1]) if name == "poles" else None
        yield name, [view[0] for view in views], list(scene.poses[: sources + 1]), views[0][1], thin


def _thin(scene: Scene, truth: np.ndarray) -> np.ndarray:
    count = len(default_room().surfaces)
    empty = dataclasses.replace(scene.room, surfaces=scene.room.surfaces[:count], textures=scene.room.textures[:count])
    behind = render(empty, scene.poses[0], truth.shape, supersample=1)[1]
    result: np.ndarray = np.abs(behind - truth) > 0.05 * truth
    return result


def measure(case: Case, settings: SweepSettings, *, levels: Sequence[int], rounds: int) -> None:
    """Print one line for each number of levels."""
    name, pictures, poses, truth, thin = case
    near, far = limits_by_sweeping(pictures, poses, masks=[np.ones(p.shape[:2], np.bool_) for p in pictures])
    relative = [pose @ poses[0].inverse() for pose in poses[1:]]
    seconds: dict[int, list[float]] = {level: [] for level in levels}
    found = {}
    for turn in range(rounds + 1):
        for level in levels:
            start = time.process_time()
            found[level] = sweep_range(
                pictures[0], pictures[1:], relative, near=near, far=far, settings=settings.replace(levels=level)
            ).range
            if turn:
                seconds[level].append(time.process_time() - start)
    base = statistics.median(seconds[levels[0]])
    known = np.isfinite(truth)
    for level in levels:
        with np.errstate(invalid="ignore"):
            good = np.abs(found[level] - truth) <= 0.05 * truth
        took = statistics.median(seconds[level])
        rods = "" if thin is None else f"  rods {good[thin].mean():.3f}"
        bad = 100 * (~good[known]).mean()
        print(f"{name:12} levels {level}: {took:6.2f} CPU-s  {base / took:5.2f}×  bad-5 {bad:6.2f} %{rods}")


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rows", type=int, default=512)
    parser.add_argument("--planes", type=int, default=128)
    parser.add_argument("--sources", type=int, default=3)
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--levels", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--aggregation", choices=["sgm", "box"], default="sgm")
    parser.add_argument("--cost", default="census")
    parser.add_argument("--capture", type=Path, help="folder of a capture with truth")
    options = parser.parse_args(arguments)
    settings = SweepSettings(planes=options.planes, aggregation=options.aggregation, cost=options.cost, no_match="keep")
    cases = (
        scene_cases(options.rows, options.sources)
        if options.capture is None
        else [_capture(options.capture, options.rows, options.sources)]
    )
    for case in cases:
        measure(case, settings, levels=options.levels, rounds=options.rounds)


def _capture(folder: Path, rows: int, sources: int) -> Case:
    """Return the first views of a capture with truth."""
    listed = json.loads(next(folder.rglob("poses.json")).read_text())["views"][: sources + 1]
    truth = np.load(next(folder.rglob("depth.npz")))
    pictures, poses = [], []
    for view in listed:
        picture = cv2.cvtColor(read_picture(next(folder.rglob(Path(view["image"]).name))), cv2.COLOR_BGR2RGB)
        pictures.append(cv2.resize(picture, (2 * rows, rows), interpolation=cv2.INTER_AREA))
        poses.append(Rigid3(np.array(view["R"], float), np.array(view["t"], float)))
    first = truth[Path(listed[0]["image"]).stem]
    return folder.name, pictures, poses, cv2.resize(first, (2 * rows, rows), interpolation=cv2.INTER_NEAREST), None


if __name__ == "__main__":
    main()
