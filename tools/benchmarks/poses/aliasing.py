"""Poses where structure repeats, against COLMAP's own.

Run it with `python -m tools benchmarks poses.aliasing --captures 50 --width 768`.

Captures of places in which floors, columns, doors or whole rooms repeat are drawn
(`tools.benchmarks.repeating.places`) and rendered. For each method and capture the table has the number of cameras
that are registered, of those that are right (rotation within 1°, centre within 2 % of the capture's extent, after
alignment to the largest consistent subset), of those that are wrong, of those that are wrong without being doubted,
and CPU-seconds. `--colmap` adds COLMAP on its own: EQUIRECTANGULAR cameras, its SIFT, its defaults. The folder
`--work` keeps pictures and what COLMAP made of them.
"""

from __future__ import annotations

import argparse
import hashlib
import inspect
import json
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from pano_mvs.algorithms.poses.adjustment.refine import refine_poses
from pano_mvs.algorithms.poses.scaled_translation import solve_scaled_translation
from pano_mvs.algorithms.poses.verification.confirmation import Picture
from pano_mvs.algorithms.poses.verification.verify_poses import verify_poses
from pano_mvs.geometry import Rigid3
from pano_mvs.scene import Features, Poses, TwoView
from pano_mvs.scene.image_file import decode_image, write_png
from pano_mvs.testing import room, surfaces
from tests.synthetic.scenes import Scene
from tools.benchmarks.poses.captures_with_truth import MAPPERS, SEED, Cameras, Pictures, matched, native
from tools.benchmarks.poses.placements import judge_placements
from tools.benchmarks.repeating import drawings, fittings, prints
from tools.benchmarks.repeating.places import draw_arguments, draw_capture

OURS = "ours"


@dataclass(frozen=True)
class Row:
    """What one method made of one capture: numbers of cameras, and the errors of each, as of `judge_placements`."""

    method: str
    registered: int
    right: int
    wrong: int
    unreported: int
    cpu_s: float
    rotation_deg: list[float]
    center_shares: list[float]


def place_cameras(
    pictures: Pictures, features: dict[str, Features], two_views: dict[tuple[str, str], TwoView]
) -> Poses:
    """Return the poses that are measured as ours: solved, verified, refined, as in the shipped presets."""

    def load(name: str) -> Picture:
        return pictures[name], np.ones(pictures[name].shape[:2], np.bool_)

    poses = solve_scaled_translation(features, two_views, load=load, rng=np.random.default_rng(SEED))
    return refine_poses(verify_poses(poses, load, features=features, two_views=two_views), load=load)


def ours(pictures: Pictures) -> tuple[Poses, float]:
    """Return our poses and their CPU-seconds."""
    start = time.process_time()
    poses = place_cameras(pictures, *matched(pictures))
    return poses, time.process_time() - start


def colmap(pictures: Pictures, mapper: str, folder: Path) -> tuple[Poses, float]:
    """Return COLMAP's poses and their CPU-seconds, computed once for a folder of pictures and a version of COLMAP."""
    kept = folder / f"colmap-{mapper}-{version('pycolmap')}.json"
    if not kept.is_file():
        start = time.process_time()
        with tempfile.TemporaryDirectory() as scratch:
            found = native(pictures, mapper, Path(scratch))
        written = {name: [pose.rotation.tolist(), pose.translation.tolist()] for name, pose in found.items()}
        kept.write_text(json.dumps({"cpu_s": time.process_time() - start, "poses": written}))
    read = json.loads(kept.read_text())
    cameras = {name: Rigid3(np.array(turn), np.array(shift)) for name, (turn, shift) in read["poses"].items()}
    return Poses.without_points(cameras, frame="COLMAP's", scale="COLMAP's", metric=False), read["cpu_s"]


def rendered(scene: Scene, work: Path, label: str, width: int) -> tuple[Pictures, Cameras, Path]:
    """Return the pictures of a scene and the true poses, and the folder that has the pictures from now on."""
    folder = work / f"{label}-{width}-{_fingerprint(scene)}"
    folder.mkdir(parents=True, exist_ok=True)
    names = [f"{idx:03d}.png" for idx in range(len(scene.poses))]
    for idx, name in enumerate(names):
        if not (folder / name).is_file():
            write_png(folder / "part.png", scene.view(idx, (width // 2, width))[0])
            (folder / "part.png").rename(folder / name)
    return {name: decode_image(folder / name) for name in names}, dict(zip(names, scene.poses, strict=True)), folder


def _fingerprint(scene: Scene) -> str:
    """Return a digest of the scene and of the code that renders it."""
    digest = hashlib.sha256(repr(scene).encode())
    for module in (drawings, fittings, prints, room, surfaces):
        digest.update(inspect.getsource(module).encode())
    return digest.hexdigest()[:12]


def judged(method: str, result: tuple[Poses, float], truth: Cameras) -> Row:
    """Return how good the poses are that a method found in some CPU-seconds."""
    poses, cpu_s = result
    placed = judge_placements(poses, truth)
    right = int(placed.right.sum())
    wrong, errors = len(placed.names) - right, (placed.rotation_deg.tolist(), placed.center_shares.tolist())
    return Row(method, len(poses.names), right, wrong, len(placed.unreported), cpu_s, *errors)


def show(methods: Sequence[str], captures: Sequence[dict[str, Any]], title: str) -> None:
    """Print what all captures together amount to."""
    views = sum(capture["views"] for capture in captures)
    if not views:
        return
    print(f"{title}: {len(captures)} captures, {views} views")
    for method in methods:
        rows = [Row(**row) for capture in captures for row in capture["rows"] if row["method"] == method]
        right, wrong, unreported = (sum(getattr(row, of) for row in rows) for of in ("right", "wrong", "unreported"))
        whole = sum(row.right == capture["views"] for row, capture in zip(rows, captures, strict=True))
        print(
            f"  {method:12s} right {100 * right / views:5.1f} %  wrong {100 * wrong / views:5.1f} %  wrong and not "
            f"reported {100 * unreported / views:5.1f} %  captures all right {whole}  "
            f"{sum(row.cpu_s for row in rows) / len(captures):.1f} CPU-s each"
        )


def main() -> None:
    """Measure the captures that the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--captures", type=int, default=50, help="number of captures")
    parser.add_argument("--first-seed", type=int, default=0, help="seed of the first; the others follow")
    parser.add_argument("--width", type=int, default=768, help="width of the pictures in pixels")
    parser.add_argument("--views", type=int, help="views of each capture; by default 6 to 12")
    parser.add_argument("--colmap", action="store_true", help="run COLMAP's own mappers too")
    parser.add_argument(
        "--work", type=Path, help="folder for pictures and COLMAP's results; by default a temporary one"
    )
    parser.add_argument("--json", type=Path, help="file for all figures")
    options = parser.parse_args()
    methods = [OURS, *(MAPPERS if options.colmap else ())]
    print(
        f"{'seed':>5s} {'place':12s} {'layout':10s} {'views':>5s} {'unique':>6s}"
        + "".join(f" | {method:11s} reg right wrong unrep  CPU-s" for method in methods)
    )
    captures: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as temporary:
        for seed in range(options.first_seed, options.first_seed + options.captures):
            scene = draw_capture(seed, views=options.views)
            name, arguments = draw_arguments(seed, views=options.views)
            label = f"{seed:04d}-{name}"
            pictures, truth, folder = rendered(scene, options.work or Path(temporary), label, options.width)
            rows = [judged(OURS, ours(pictures), truth)]
            rows += [judged(mapper, colmap(pictures, mapper, folder), truth) for mapper in methods[1:]]
            captures.append({"seed": seed, "place": name, **arguments, "rows": [asdict(row) for row in rows]})
            start = f"{seed:5d} {name:12s} {arguments['layout']:10s} {len(truth):5d} {arguments['unique']:6.2f}"
            cells = "".join(
                f" | {'':11s} {row.registered:3d} {row.right:5d} {row.wrong:5d} {row.unreported:5d} {row.cpu_s:6.1f}"
                for row in rows
            )
            print(start + cells, flush=True)
    show(methods, [capture for capture in captures if capture["unique"] > 0], "something unique")
    show(methods, [capture for capture in captures if capture["unique"] == 0], "nothing unique")
    if options.json:
        options.json.write_text(json.dumps(captures, indent=1))
