"""A walk without images.

The cameras of `house_walk` see some hundred points of the walls around their path, with noise of 0.03° and a fifth of
the matches wrong. They are paired with the next four, and with up to four that are near but far away in the order, as
retrieval finds them. With twins, a stretch of 8 m has the same points as another one, so that cameras there are paired
falsely as well, with matches that agree perfectly. Seconds are CPU time of one process; errors are in percent of the
length of the path after alignment of all cameras with the truth.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.poses.adjustment.refine import refine_poses
from pano_mvs.algorithms.poses.loop_closures import find_false_closures
from pano_mvs.algorithms.poses.scaled_translation import solve_scaled_translation
from pano_mvs.algorithms.two_view import verify_pair
from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import similarity_from_points
from pano_mvs.scene import TwoView
from pano_mvs.scene.pose_groups import split_groups
from tests.algorithms.poses.synthetic_capture import features_from_bearings, noisy_bearings
from tests.algorithms.poses.synthetic_path import PathCapture, window_matches
from tools.benchmarks.poses.house_walk import walk_poses

SIGHT, NEAREST, NOISE_DEG = 5.0, 0.6, 0.03
WINDOW, CLOSURES, NEAR, FAR_IN_ORDER = 4, 4, 1.0, 10
TWIN_FROM, TWIN_TO, TWIN_SHIFT = 12.0, 20.0, 12.0


def simulated_walk(rng: np.random.Generator, views: int, *, keypoints: int = 300, twins: bool = False) -> PathCapture:
    """Return cameras of the walk with the points that they see; twin points have one number."""
    cameras = walk_poses(views)
    centers = np.array([camera.center for camera in cameras])
    count = keypoints * views // 4
    around = centers[rng.integers(views, size=count)]
    away = rng.uniform(-1, 1, (count, 3))
    away /= np.abs(away).max(axis=1, keepdims=True)
    points = around + away * (1.2, 1.3, 1.2)
    numbers = np.arange(count)
    if twins:
        points, numbers = _with_twins(points, numbers)
    poses, features, seen_by = {}, {}, {}
    for idx, camera in enumerate(cameras):
        distance = np.linalg.norm(points - camera.center, axis=1)
        seen = np.flatnonzero((distance < SIGHT) & (distance > NEAREST))
        seen = rng.permutation(seen)[: keypoints * 2]
        _, first = np.unique(numbers[seen], return_index=True)  # a camera sees one of two twins
        seen = seen[np.sort(first)]
        name = f"{idx:04d}.jpg"
        poses[name], seen_by[name] = camera, numbers[seen]
        features[name] = features_from_bearings(noisy_bearings(rng, camera, points[seen], noise_deg=NOISE_DEG))
    return PathCapture(poses, features, seen_by)


def pairs_of_walk(capture: PathCapture, *, closures: bool, twins: bool = False) -> list[tuple[int, int]]:
    """Return the positions of the pairs: in sequence, true loop closures, and false ones between twins."""
    centers = np.array([pose.center for pose in capture.poses.values()])
    count = len(centers)
    pairs = {(idx, idx + step) for idx in range(count) for step in range(1, WINDOW + 1) if idx + step < count}
    if closures:
        pairs |= _near_pairs(centers, centers)
    if twins:
        pairs |= _near_pairs(centers + np.array((TWIN_SHIFT, 0, 0)), centers, inside=_in_twin(centers))
    return sorted(pairs)


def _near_pairs(here: FloatArray, there: FloatArray, inside: NDArray[np.bool_] | None = None) -> set[tuple[int, int]]:
    found = set()
    for idx, center in enumerate(here):
        if inside is not None and not inside[idx]:
            continue
        distances = np.linalg.norm(there - center, axis=1)
        distances[max(0, idx - FAR_IN_ORDER) : idx + FAR_IN_ORDER + 1] = np.inf
        nearest = np.argsort(distances, kind="stable")[:CLOSURES]
        found |= {(min(idx, int(n)), max(idx, int(n))) for n in nearest if distances[n] < NEAR}
    return found


def _in_twin(points: FloatArray) -> NDArray[np.bool_]:
    return np.asarray((points[:, 0] > TWIN_FROM) & (points[:, 0] < TWIN_TO))


def _with_twins(points: FloatArray, numbers: NDArray[np.intp]) -> tuple[FloatArray, NDArray[np.intp]]:
    """Return the points with those of one stretch replaced by a copy of another stretch, under the same numbers."""
    kept = ~_in_twin(points - (TWIN_SHIFT, 0, 0))
    copied = _in_twin(points)
    return (
        np.concatenate([points[kept], points[copied] + (TWIN_SHIFT, 0, 0)]),
        np.concatenate([numbers[kept], numbers[copied]]),
    )


def measure(views: int, *, closures: bool, twins: bool = False, seed: int = 0) -> dict[str, float]:
    """Return time and drift of one walk."""
    rng = np.random.default_rng(seed)
    capture = simulated_walk(rng, views, twins=twins)
    names = list(capture.poses)
    two_views: dict[tuple[str, str], TwoView] = {}
    start = time.process_time()
    for a, b in pairs_of_walk(capture, closures=closures, twins=twins):
        matches = window_matches(rng, capture, names[a], names[b])
        if len(matches) >= 8:
            two_views[names[a], names[b]] = verify_pair(
                capture.features[names[a]], capture.features[names[b]], matches, rng=rng
            )
    matched = time.process_time()
    false = [closure.pair for closure in find_false_closures(capture.features, two_views)]
    two_views = {pair: view for pair, view in two_views.items() if pair not in set(false)}
    tested = time.process_time()
    poses = solve_scaled_translation(capture.features, two_views, rng=rng)
    solved = time.process_time()
    poses = split_groups(refine_poses(poses))[0]
    refined = time.process_time()
    truth = np.array([capture.poses[name].center for name in poses.names])
    errors = np.linalg.norm(similarity_from_points(poses.centers, truth).apply(poses.centers) - truth, axis=1)
    return {
        "views": views,
        "registered": len(poses.names),
        "pairs": sum(len(view) > 0 for view in two_views.values()),
        "match_s": matched - start,
        "test_s": tested - matched,
        "left_out": len(false),
        "solve_s": solved - tested,
        "refine_s": refined - solved,
        "rms_percent": 100 * float(np.sqrt(np.mean(errors**2))) / capture.length,
        "max_percent": 100 * float(errors.max()) / capture.length,
    }


def main() -> None:
    """Measure every size without and with loop closures, and with false ones."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--views", type=int, nargs="+", default=[75, 150, 300])
    parser.add_argument("--draws", type=int, default=1)
    arguments = parser.parse_args()
    for views in arguments.views:
        for closures, twins in ((False, False), (True, False), (True, True)):
            for seed in range(arguments.draws):
                row = measure(views, closures=closures, twins=twins, seed=seed)
                kind = "with false closures" if twins else "with closures" if closures else "in sequence alone"
                print(f"{kind:20} " + "  ".join(f"{name} {value:.4g}" for name, value in row.items()), flush=True)
