"""Poses on rendered captures with truth, ours beside COLMAP's own.

Run it with `python -m tools benchmarks poses.captures_with_truth DATA_DIR…`.

A DATA_DIR holds poses.json ({"views": [{"R": …, "t": …}, …]}, cam_from_world) and the pictures rgb/*.png in the same
order. For the first 4 and the first 9 views, as they are and each turned by an arbitrary rotation, it prints the
median over all pairs of the larger of rotation and direction error, the areas under the recall curve up to 0.1, 0.5,
1 and 5°, the number of registered views, and seconds of one thread: of extraction and matching, and of the solver.
`native` is COLMAP on its own: EQUIRECTANGULAR cameras, its SIFT, its defaults.
"""

from __future__ import annotations

import argparse
import functools
import json
import tempfile
import time
from collections.abc import Callable
from itertools import combinations
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np

from pano_mvs.algorithms.features.tangent import extract_sift
from pano_mvs.algorithms.matching.brute_force import match_features
from pano_mvs.algorithms.poses.adjustment.refine import refine_poses
from pano_mvs.algorithms.poses.colmap.mapping import quiet_colmap
from pano_mvs.algorithms.poses.colmap.solver import solve_colmap
from pano_mvs.algorithms.poses.scaled_translation import solve_scaled_translation
from pano_mvs.algorithms.two_view import verify_pair
from pano_mvs.geometry import Rigid3, rotate_panorama, rotation_from_rotvec
from pano_mvs.geometry.pose_errors import AUC_LIMITS_DEG, relative_pose_errors
from pano_mvs.scene import Features, Poses, TwoView
from pano_mvs.scene.image_file import decode_image

Pictures = dict[str, np.ndarray]
Cameras = dict[str, Rigid3]
SEED = 1
MAPPERS = ("incremental", "global")


def load(folder: Path, count: int) -> tuple[Pictures, Cameras]:
    """Return the first pictures of a set and their true poses."""
    views = json.loads((folder / "poses.json").read_text())["views"][:count]
    files = sorted((folder / "rgb").glob("*.png"))[:count]
    truth = {
        path.name: Rigid3(np.array(view["R"], float), np.array(view["t"], float))
        for path, view in zip(files, views, strict=True)
    }
    return {path.name: decode_image(path) for path in files}, truth


def turned(pictures: Pictures, truth: Cameras) -> tuple[Pictures, Cameras]:
    """Return the capture with every camera turned by a rotation of its own, any as likely as any other."""
    rng = np.random.default_rng(SEED)
    new_pictures, new_truth = {}, {}
    for name, picture in pictures.items():
        quaternion = rng.normal(size=4)
        axis = quaternion[1:] / np.linalg.norm(quaternion[1:])
        turn = rotation_from_rotvec(2 * np.arctan2(np.linalg.norm(quaternion[1:]), quaternion[0]) * axis)
        new_pictures[name] = rotate_panorama(picture, turn)
        new_truth[name] = Rigid3(turn, np.zeros(3)) @ truth[name]
    return new_pictures, new_truth


def native(pictures: Pictures, mapper: str, scratch: Path) -> Cameras:
    """Return the poses of COLMAP on its own."""
    (scratch / "images").mkdir()
    for name, picture in pictures.items():
        cv2.imwrite(str(scratch / "images" / name), picture[..., ::-1])
    database = scratch / "native.db"
    native_features(database, scratch / "images")
    native_matches(database)
    return native_model(database, scratch / "images", mapper)


def native_features(database: Path, images: Path) -> None:
    """Have COLMAP extract its features from all pictures of a folder, on one thread."""
    import pycolmap

    with quiet_colmap():
        pycolmap.extract_features(
            database,
            images,
            camera_mode=pycolmap.CameraMode.SINGLE,
            reader_options=pycolmap.ImageReaderOptions(camera_model="EQUIRECTANGULAR"),
            extraction_options=pycolmap.FeatureExtractionOptions(num_threads=1),
        )


def native_matches(database: Path) -> None:
    """Have COLMAP match and verify all pairs, on one thread."""
    import pycolmap

    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = SEED
    with quiet_colmap():
        pycolmap.match_exhaustive(
            database,
            matching_options=pycolmap.FeatureMatchingOptions(num_threads=1),
            verification_options=verification,
        )


def native_model(database: Path, images: Path, mapper: str) -> Cameras:
    """Return the poses of COLMAP's largest model from a database with matches, on one thread."""
    import pycolmap

    options = pycolmap.IncrementalPipelineOptions() if mapper == "incremental" else pycolmap.GlobalPipelineOptions()
    options.random_seed, options.num_threads = SEED, 1
    run = pycolmap.incremental_mapping if mapper == "incremental" else pycolmap.global_mapping
    with quiet_colmap():
        models = run(database, images, database.parent, options)
    if not models:
        return {}
    largest = max(models.values(), key=lambda model: model.num_reg_images())
    found = {}
    for image_id in largest.reg_image_ids():
        pose = largest.images[image_id].cam_from_world()
        found[largest.images[image_id].name] = Rigid3(pose.rotation.matrix(), np.array(pose.translation))
    return found


def matched(pictures: Pictures) -> tuple[dict[str, Features], dict[tuple[str, str], TwoView]]:
    """Return our key points and verified matches."""
    rng = np.random.default_rng(SEED)
    features = {name: extract_sift(image, np.ones(image.shape[:2], np.bool_)) for name, image in pictures.items()}
    pairs = combinations(features, 2)
    return features, {
        (a, b): verify_pair(features[a], features[b], match_features(features[a], features[b]), rng=rng)
        for a, b in pairs
    }


def cameras_of(poses: Poses) -> Cameras:
    """Return the poses by name."""
    return {name: poses.cam_from_world(idx) for idx, name in enumerate(poses.names)}


def show(label: str, found: Cameras, truth: Cameras, seconds: float) -> float:
    """Print one row of the table, and return its median error."""
    errors = relative_pose_errors(found, truth)
    areas = " ".join(f"{100 * errors.auc[limit]:5.1f}" for limit in AUC_LIMITS_DEG)
    registered = f"{errors.registered}/{errors.expected}"
    print(f"  {label:32s} {errors.median_pair_deg:8.4f}  {areas}  {registered:>5s}  {seconds:6.1f} s", flush=True)
    return errors.median_pair_deg


Value = TypeVar("Value")


def timed(work: Callable[[Path], Value]) -> tuple[Value, float]:
    """Return the result of some work in an empty folder, and its seconds."""
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        result = work(Path(folder))
        return result, time.perf_counter() - start


def measure(pictures: Pictures, truth: Cameras) -> None:
    """Print the rows of one capture, and whether the bars are met."""
    print(f"  {'':32s} {'median °':>8s}  " + " ".join(f"@{limit:<4g}" for limit in AUC_LIMITS_DEG))
    bar = 180.0
    for mapper in MAPPERS:
        found, seconds = timed(functools.partial(native, pictures, mapper))
        bar = min(bar, show(f"native {mapper}", found, truth, seconds))
    start = time.perf_counter()
    features, two_views = matched(pictures)
    print(f"  our key points and matches: {time.perf_counter() - start:.1f} s")

    def by_colmap(folder: Path, *, mapper: Any, cameras: Any) -> Poses:
        rng = np.random.default_rng(SEED)
        return solve_colmap(features, two_views, mapper=mapper, cameras=cameras, rng=rng, scratch=folder)

    rows: dict[str, Callable[[Path], Poses]] = {
        f"poses.colmap {mapper} {cameras}": functools.partial(by_colmap, mapper=mapper, cameras=cameras)
        for mapper in MAPPERS
        for cameras in ("sphere", "faces")
    }
    rows["poses.scaled_translation"] = lambda folder: solve_scaled_translation(
        features, two_views, rng=np.random.default_rng(SEED)
    )
    for label, solve in rows.items():
        poses, seconds = timed(solve)
        errors = [show(label, cameras_of(poses), truth, seconds)]
        start = time.perf_counter()
        refined = refine_poses(poses)
        errors.append(show("  … poses.refine", cameras_of(refined), truth, time.perf_counter() - start))
        verdicts = ["goal" if error <= bar / 2 else "bar" if error <= bar else "MISSED" for error in errors]
        print(f"  {'':32s} better native {bar:.4f}°: {verdicts[0]}, refined {verdicts[1]}")


def main() -> None:
    """Measure all captures that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--views", nargs="+", type=int, default=[4, 9])
    parser.add_argument("--rotations", nargs="+", choices=["none", "any"], default=["none", "any"])
    options = parser.parse_args()
    for folder in options.folders:
        for count in options.views:
            for rotations in options.rotations:
                pictures, truth = load(folder, count)
                if rotations == "any":
                    pictures, truth = turned(pictures, truth)
                print(f"{folder.name}, {len(pictures)} views, rotations: {rotations}")
                measure(pictures, truth)
