"""Cameras of rooms that hardly see each other.

Run it with `python -m tools benchmarks poses.rooms --seeds 0 1 2`.

The captures are houses whose rooms see each other through doors only (`house_of_rooms`), the same houses with the first
and the last room furnished alike ("twins"), and places with repeated structure (`repeating.places`). Each is
solved and verified. The table has the groups, the cameras that are right within their group (see `placements`), wrong,
doubted, and wrong without being doubted, and CPU-seconds.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np

from pano_mvs.algorithms.poses.scaled_translation import solve_scaled_translation
from pano_mvs.algorithms.poses.verification.confirmation import Picture
from pano_mvs.algorithms.poses.verification.verify_poses import verify_poses
from pano_mvs.geometry import Rigid3
from pano_mvs.scene import Features, Poses, TwoView
from pano_mvs.scene.image_file import decode_image, write_png
from tests.synthetic.scenes import Scene
from tools.benchmarks.poses.captures_with_truth import SEED, Pictures, matched
from tools.benchmarks.poses.house_of_rooms import House
from tools.benchmarks.poses.placements import judge_placements
from tools.benchmarks.repeating.places import REPEATS

Views = dict[tuple[str, str], TwoView]
Truth = dict[str, Rigid3]

KINDS = ("house", "twins", "turned", *REPEATS)


def capture(kind: str, seed: int, width: int, folder: Path) -> tuple[Pictures, Truth]:
    """Return the pictures of a capture and the true cam_from_world; those that a folder has are not rendered again."""
    place = _place(kind, seed)
    poses = place.poses() if isinstance(place, House) else place.poses
    folder = folder / f"{kind}-{seed}-{width}"
    folder.mkdir(parents=True, exist_ok=True)
    pictures, truth = {}, {}
    for idx, pose in enumerate(poses):
        name = f"{idx:02d}.png"
        if not (folder / name).exists():
            size_hw = width // 2, width
            seen = place.view(idx, size_hw) if isinstance(place, House) else place.view(idx, size_hw)[0]
            write_png(folder / "part.png", seen)
            (folder / "part.png").rename(folder / name)
        pictures[name], truth[name] = decode_image(folder / name), pose
    return pictures, truth


def _place(kind: str, seed: int) -> House | Scene:
    if kind in REPEATS:
        return REPEATS[kind](seed=seed, unique=0.6, layout="path", views=6)
    return House(seed=seed, twins=kind == "twins", turned=kind == "turned")


def solved(pictures: Pictures, features: dict[str, Features], views: Views) -> Poses:
    """Return verified poses."""

    def load(name: str) -> Picture:
        return pictures[name], np.ones(pictures[name].shape[:2], np.bool_)

    poses = solve_scaled_translation(features, views, load=load, rng=np.random.default_rng(SEED))
    return verify_poses(poses, load, features=features, two_views=views)


def row(kind: str, seed: int, *, width: int, folder: Path) -> tuple[list[int], float]:
    """Return the numbers of a capture, and the CPU-seconds of solving it."""
    pictures, truth = capture(kind, seed, width, folder)
    features, views = matched(pictures)
    start = time.process_time()
    poses = solved(pictures, features, views)
    cpu_s = time.process_time() - start
    placed = judge_placements(poses, truth)
    right, wrong = int(placed.right.sum()), int((~placed.right).sum())
    return [len(truth), len(poses.worlds), right, wrong, int(placed.doubted.sum()), len(placed.unreported)], cpu_s


def main() -> None:
    """Measure the captures that the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=["house", "twins", "colonnade"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--width", type=int, default=1024, help="width of the pictures in pixels")
    parser.add_argument("--work", type=Path, help="folder for pictures; by default a temporary one")
    options = parser.parse_args()
    print("place        seed  views groups right wrong doubted unreported  CPU-s")
    total = np.zeros(6, int)
    with tempfile.TemporaryDirectory() as temporary:
        for kind in options.kinds:
            for seed in options.seeds:
                folder = options.work or Path(temporary)
                numbers, cpu_s = row(kind, seed, width=options.width, folder=folder)
                views, groups, right, wrong, doubted, unreported = numbers
                total += numbers
                label = f"{kind:12s} {seed:4d} {views:6d} {groups:6d} {right:5d}"
                print(f"{label} {wrong:5d} {doubted:7d} {unreported:10d} {cpu_s:6.1f}", flush=True)
    print("all: " + " ".join(map(str, total)))
