"""What poses cost, beside COLMAP.

A suite of furnished rooms (`tools.benchmarks.poses.suite_of_rooms`) is rendered once into `--work`, ten panoramas to a
room. Printed are the CPU-seconds of one thread from pictures to refined poses, step by step: of our functions called
one after the other in this process, of the same chain as a workflow through the engine (`pano-mvs run` with the serial
executor and a fresh cache, `--engine`), and of COLMAP on its own on the same pictures (`--colmap`: EQUIRECTANGULAR
cameras, its SIFT, all pairs, its defaults). Kernels are compiled before. With each comes the number of registered
cameras and the median over all pairs of the larger of rotation and direction error. `--neighbours N` matches each
panorama with the N that look most like it, instead of all pairs; COLMAP's all pairs can then be had for the first
`--colmap-views` only.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

import numpy as np

from pano_mvs.algorithms.features.tangent import extract_sift
from pano_mvs.algorithms.matching.brute_force import match_features
from pano_mvs.algorithms.matching.pair_selection import exhaustive_pairs, retrieval_pairs
from pano_mvs.algorithms.matching.vlad import vlad_descriptor
from pano_mvs.algorithms.poses.adjustment.refine import refine_poses
from pano_mvs.algorithms.poses.scaled_translation import solve_scaled_translation
from pano_mvs.algorithms.poses.verification.verify_poses import verify_poses
from pano_mvs.algorithms.two_view import verify_pair
from pano_mvs.geometry.pose_errors import relative_pose_errors
from pano_mvs.io.poses.files import read_poses
from pano_mvs.scene.image_file import decode_image
from pano_mvs.scene.pose_groups import split_groups
from tools.benchmarks.poses.captures_with_truth import (
    MAPPERS,
    SEED,
    Cameras,
    cameras_of,
    native_features,
    native_matches,
    native_model,
)
from tools.benchmarks.poses.suite_of_rooms import write_suite

Result = TypeVar("Result")

_WARM_VIEWS, _WARM_WIDTH = 4, 256
WORKFLOW = """\
pano_mvs: 1
name: pose_speed
stages:
  images:   {{use: source.folder, path: {images}}}
  features: {{use: features.sift_tangent}}
{pairs}
  matches:  {{use: matches.brute_force}}
  poses:    {{use: poses.scaled_translation}}
  verified: {{use: poses.verify}}
  refined:  {{use: poses.refine}}
  colmap:   {{use: export.colmap}}
"""
_ALL_PAIRS = "  pairs:    {use: pairs.exhaustive}"
_SIMILAR_PAIRS = "  global:   {{use: global.vlad}}\n  pairs:    {{use: pairs.retrieval, neighbours: {neighbours}}}"


class Steps:
    """CPU-seconds of this process and of those that it waits for, by step."""

    def __init__(self) -> None:
        self.cpu_s: dict[str, float] = {}

    def take(self, step: str, work: Callable[[], Result]) -> Result:
        """Return the result of some work, and note its time."""
        start = _cpu_s()
        result = work()
        self.cpu_s[step] = self.cpu_s.get(step, 0.0) + _cpu_s() - start
        return result

    @property
    def total(self) -> float:
        """All steps together."""
        return sum(self.cpu_s.values())


def in_memory(images: Path, steps: Steps, *, neighbours: int = 0, names: tuple[str, ...] = ()) -> Cameras:
    """Return our refined poses, from function to function."""
    rng = np.random.default_rng(SEED)
    names = names or tuple(sorted(path.name for path in images.glob("*.png")))
    pictures = steps.take("read", lambda: {name: decode_image(images / name) for name in names})
    masks = {name: np.ones(picture.shape[:2], np.bool_) for name, picture in pictures.items()}
    features = steps.take("features", lambda: {name: extract_sift(pictures[name], masks[name]) for name in names})
    pairs = exhaustive_pairs(names)
    if neighbours:
        pairs = steps.take(
            "pairs",
            lambda: retrieval_pairs(
                names, {name: vlad_descriptor(features[name]) for name in names}, neighbours=neighbours
            ),
        )
    found = steps.take("match", lambda: {(a, b): match_features(features[a], features[b]) for a, b in pairs.pairs})
    two_views = steps.take(
        "verify pairs",
        lambda: {(a, b): verify_pair(features[a], features[b], found[a, b], rng=rng) for a, b in pairs.pairs},
    )
    print(f"    {len(pairs.pairs)} pairs, {sum(map(bool, two_views.values()))} verified", flush=True)

    def load(name: str) -> tuple[np.ndarray, np.ndarray]:
        return pictures[name], masks[name]

    poses = steps.take("solve", lambda: solve_scaled_translation(features, two_views, load=load, rng=rng))
    poses = steps.take("verify poses", lambda: verify_poses(poses, load, features=features, two_views=two_views))
    refined = steps.take("refine", lambda: refine_poses(poses))
    if not refined.other_worlds:
        return cameras_of(refined)
    groups = split_groups(refined)
    sizes = ", ".join(str(len(group.names)) for group in groups)
    print(f"    {len(groups)} groups, of {sizes} cameras; the largest counts")
    return cameras_of(groups[0])


def through_the_engine(images: Path, steps: Steps, *, neighbours: int = 0) -> Cameras:
    """Return our refined poses from `pano-mvs run`; the serial executor with one thread and a fresh cache."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        pairs = _SIMILAR_PAIRS.format(neighbours=neighbours) if neighbours else _ALL_PAIRS
        (folder / "workflow.yaml").write_text(WORKFLOW.format(images=images.resolve(), pairs=pairs))
        command = [
            sys.executable,
            "-m",
            "pano_mvs",
            "run",
            str(folder / "workflow.yaml"),
            "--out",
            str(folder / "out"),
            "--cache",
            str(folder / "cache"),
            "--executor",
            "serial",
            "--threads-per-worker",
            "1",
        ]
        steps.take("pano-mvs run", lambda: subprocess.run(command, check=True, capture_output=True))
        model = read_poses(folder / "out" / "colmap")
    return cameras_of(model)


def colmap(images: Path, mapper: str, database: Path, steps: Steps) -> Cameras:
    """Return COLMAP's poses; features and matches that the database has are not computed again."""
    if not database.is_file():
        steps.take("features", lambda: native_features(database, images))
        steps.take("match + verify pairs", lambda: native_matches(database))
    return steps.take(f"map {mapper}", lambda: native_model(database, images, mapper))


def show(label: str, steps: Steps, found: Cameras, truth: Cameras) -> None:
    """Print one method's figures."""
    errors = relative_pose_errors(found, truth)
    registered = f"{errors.registered}/{errors.expected}"
    print(
        f"  {label:24s} {steps.total:8.1f} CPU-s  registered {registered}  median pair error "
        f"{errors.median_pair_deg:.4f}°"
    )
    print("    " + ", ".join(f"{step} {cpu_s:.1f}" for step, cpu_s in steps.cpu_s.items()), flush=True)


@contextmanager
def _subset(images: Path, names: list[str]) -> Iterator[Path]:
    """Yield a folder with links to some pictures."""
    with tempfile.TemporaryDirectory() as folder:
        for name in names:
            (Path(folder) / name).symlink_to((images / name).resolve())
        yield Path(folder)


def _warm_up(work: Path) -> None:
    """Compile or load all kernels."""
    images = work / f"warm-{_WARM_WIDTH}"
    write_suite(images, _WARM_VIEWS, width=_WARM_WIDTH)
    in_memory(images, Steps(), neighbours=2)


def _cpu_s() -> float:
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def measure(options: argparse.Namespace, work: Path) -> None:
    """Render what is not there yet, run the methods, and print."""
    images = work / f"suite-{options.views}-{options.width}"
    rendering = Steps()
    truth = rendering.take("render", lambda: write_suite(images, options.views, width=options.width))
    print(f"{options.views} views of {options.width}×{options.width // 2}, rendered in {rendering.total:.1f} CPU-s")
    _warm_up(work)
    ours = Steps()
    found = in_memory(images, ours, neighbours=options.neighbours)
    show("ours, in memory", ours, found, truth)
    if options.engine:
        steps = Steps()
        found = through_the_engine(images, steps, neighbours=options.neighbours)
        show("ours, pano-mvs run", steps, found, truth)
    if not options.colmap:
        return
    names = list(truth)[: options.colmap_views or None]
    with _subset(images, names) as subset, tempfile.TemporaryDirectory() as scratch:
        common: dict[str, float] = {}
        for mapper in MAPPERS:
            steps = Steps()
            steps.cpu_s.update(common)
            found = colmap(subset, mapper, Path(scratch) / "native.db", steps)
            common = {step: cpu_s for step, cpu_s in steps.cpu_s.items() if not step.startswith("map")}
            show(f"COLMAP {mapper}, {len(names)} views", steps, found, {name: truth[name] for name in names})
            if len(names) == len(truth):
                print(f"    ours take {ours.total / steps.total:.2f} times as long")


def main() -> None:
    """Measure what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--views", type=int, default=20)
    parser.add_argument("--width", type=int, default=1024, help="of the pictures in pixels")
    parser.add_argument("--neighbours", type=int, default=0, help="pairs by retrieval; 0: all pairs")
    parser.add_argument("--engine", action="store_true", help="also through the engine")
    parser.add_argument("--colmap", action="store_true", help="also COLMAP on its own")
    parser.add_argument("--colmap-views", type=int, default=0, help="only so many for COLMAP; 0: all")
    parser.add_argument("--work", type=Path, help="folder for the pictures; by default a temporary one")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        measure(options, options.work or Path(temporary))
