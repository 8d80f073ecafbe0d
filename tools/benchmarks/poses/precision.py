"""How precise poses are where texture is weak.

A DATA_DIR is as in `tools.benchmarks.poses.captures_with_truth`; every panorama is turned by an arbitrary rotation,
another one in each draw. The synthetic scenes are drawn with another seed each time. One draw says little: the error of
nine poses varies by a factor of two from one draw to the next, so the table has means over the draws. For the solver
alone and after `poses.refine` it prints the mean over the draws of the median over all pairs of the larger of rotation
and direction error, cameras registered, and CPU seconds. Cameras that stand in a wrong place are left out of the
medians and counted. Pictures, key points and verified matches are kept in the cache folder: empty it when their stages
have changed. `--native` adds COLMAP on its own (see `tools.benchmarks.poses.captures_with_truth`).
"""

from __future__ import annotations

import argparse
import functools
import pickle
import tempfile
import time
import zlib
from collections.abc import Callable
from itertools import combinations
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from pano_mvs.algorithms.features.tangent import extract_sift
from pano_mvs.algorithms.matching.brute_force import match_features
from pano_mvs.algorithms.poses.adjustment.refine import refine_poses
from pano_mvs.algorithms.poses.scaled_translation import solve_scaled_translation
from pano_mvs.algorithms.two_view import verify_pair
from pano_mvs.geometry import Rigid3, rotate_panorama, rotation_from_quat_wxyz
from pano_mvs.geometry.pose_errors import relative_pose_errors
from tests.synthetic.places import large_plain_room
from tests.synthetic.scenes import poles, weak_room, white_room
from tools.benchmarks.poses.captures_with_truth import Cameras, Pictures, cameras_of, load, native

SCENES = {scene.__name__: scene for scene in (large_plain_room, white_room, weak_room, poles)}
SIZE_HW = (512, 1024)
WRONG_DEG = 2.0
Value = TypeVar("Value")


def cached(path: Path, make: Callable[[], Value]) -> Value:
    """Return what the cache folder has, or make it and keep it there."""
    if not path.exists():
        value = make()
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(pickle.dumps(value))
    kept: Value = pickle.loads(path.read_bytes())
    return kept


def turned(pictures: Pictures, truth: Cameras, rng: np.random.Generator) -> tuple[Pictures, Cameras]:
    """Return the capture with every camera turned by a rotation of its own, any as likely as any other."""
    turns = {name: rotation_from_quat_wxyz(rng.normal(size=4)) for name in pictures}
    return (
        {name: rotate_panorama(picture, turns[name]) for name, picture in pictures.items()},
        {name: Rigid3(turns[name], np.zeros(3)) @ truth[name] for name in pictures},
    )


def capture(place: str | Path, draw: int, views: int) -> tuple[Pictures, Cameras]:
    """Return one draw of a folder's capture or of a synthetic scene."""
    if isinstance(place, Path):
        return turned(*load(place, views), np.random.default_rng([zlib.crc32(place.name.encode()), draw]))
    scene = SCENES[place](seed=draw, views=views)
    names = [f"{idx:02d}.png" for idx in range(views)]
    pictures = {name: scene.view(idx, SIZE_HW)[0] for idx, name in enumerate(names)}
    return pictures, dict(zip(names, scene.poses, strict=True))


def matched(pictures: Pictures) -> dict[str, Any]:
    """Return our key points and verified matches."""
    features = {name: extract_sift(image, np.ones(image.shape[:2], np.bool_)) for name, image in pictures.items()}
    rng = np.random.default_rng(0)
    two_views = {
        (a, b): verify_pair(features[a], features[b], match_features(features[a], features[b]), rng=rng)
        for a, b in combinations(features, 2)
    }
    return {"features": features, "two_views": two_views}


def judged(found: Cameras, truth: Cameras) -> tuple[float, int, int]:
    """Return the median pair error of the cameras that are in the right place, how many are not, and are registered."""
    if len(found) < 2:
        return float("nan"), 0, len(found)
    errors = relative_pose_errors(found, {name: truth[name] for name in found})
    of_camera = {
        name: np.median([e for pair, e in zip(errors.pairs, errors.pair_deg, strict=True) if name in pair])
        for name in found
    }
    right = [name for name in found if of_camera[name] < WRONG_DEG]
    if len(right) < 2:
        return errors.median_pair_deg, len(found) - len(right), len(found)
    return (
        relative_pose_errors(found, {name: truth[name] for name in right}).median_pair_deg,
        len(found) - len(right),
        len(found),
    )


def native_cameras(pictures: Pictures) -> Cameras:
    """Return the poses of COLMAP on its own, of its global mapper."""
    with tempfile.TemporaryDirectory() as folder:
        return native(pictures, "global", Path(folder))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="*", type=Path)
    parser.add_argument("--scene", nargs="*", choices=list(SCENES), default=list(SCENES))
    parser.add_argument("--draws", type=int, default=4)
    parser.add_argument("--views", type=int, default=9)
    parser.add_argument("--cache", type=Path, default=Path(tempfile.gettempdir()) / "pano_mvs_benchmark_precision")
    parser.add_argument("--native", action="store_true", help="COLMAP on its own, too")
    given = parser.parse_args()
    print("| place | method | median ° of each draw | mean | wrong | registered | CPU s |\n" + "|---" * 7 + "|")
    for place in [*given.folders, *given.scene]:
        rows: dict[str, list[tuple[float, int, int, float]]] = {}
        for draw in range(given.draws):
            name = place.name if isinstance(place, Path) else place
            stem = given.cache / f"{name}-{given.views}-{draw}"
            pictures, truth = cached(stem.with_suffix(".capture"), functools.partial(capture, place, draw, given.views))
            pairs = cached(stem.with_suffix(".matches"), functools.partial(matched, pictures))
            for label, cameras, seconds in measured(pictures, pairs):
                rows.setdefault(label, []).append((*judged(cameras, truth), seconds))
            if given.native:
                cameras = cached(stem.with_suffix(".native"), functools.partial(native_cameras, pictures))
                rows.setdefault("COLMAP alone", []).append((*judged(cameras, truth), 0.0))
        for label, row in rows.items():
            medians = [median for median, *_ in row]
            each = " ".join(f"{median:.4f}" for median in medians)
            wrong, registered = sum(item[1] for item in row), sum(item[2] for item in row)
            expected, seconds = given.draws * given.views, float(np.mean([item[3] for item in row]))
            print(
                f"| {name} | {label} | {each} | {np.nanmean(medians):.4f} | {wrong} | {registered}/{expected} | "
                f"{seconds:.2f} |",
                flush=True,
            )


def measured(pictures: Pictures, pairs: dict[str, Any]) -> list[tuple[str, Cameras, float]]:
    """Return the cameras of the solver, and of the refinement without and with the images, with CPU seconds."""
    start = time.process_time()
    poses = solve_scaled_translation(pairs["features"], pairs["two_views"], rng=np.random.default_rng(0))
    solved = time.process_time()
    refined = refine_poses(poses)
    plain = time.process_time()
    aligned = refine_poses(poses, load=lambda name: (pictures[name], np.ones(pictures[name].shape[:2], np.bool_)))
    return [
        ("solver", cameras_of(poses), solved - start),
        ("refined", cameras_of(refined), plain - solved),
        ("refined with images", cameras_of(aligned), time.process_time() - plain),
    ]
