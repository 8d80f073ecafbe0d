"""COLMAP's own SIFT key points and matches on whole panoramas."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.poses.colmap.mapping import THREADS, quiet_colmap
from pano_mvs.algorithms.two_view.cheirality import agreement
from pano_mvs.core.settings import Setting, checks_settings
from pano_mvs.geometry import Rigid3, ray_from_pixel
from pano_mvs.scene import Features, TwoView


@checks_settings
def colmap_sift(
    pictures: Iterable[tuple[str, NDArray[np.uint8], NDArray[np.bool_]]],
    *,
    max_keypoints: Annotated[int, Setting("maximum number per image", ge=8)] = 8192,
    rng: np.random.Generator,
    scratch: Path,
) -> tuple[dict[str, Features], dict[tuple[str, str], TwoView]]:
    """Return COLMAP's SIFT key points of panoramas, and all pairs as matched and verified by COLMAP.

    This is planar SIFT: there are fewer key points near the seam and the poles.

    Args:
        pictures: name, (H, W, 3) uint8 RGB and (H, W) bool valid pixels of each panorama, in the capture's order;
            loaded one at a time, so they need not all be in memory.
        rng: gives COLMAP's seed.
        scratch: an empty folder for the images, their masks and COLMAP's database.
    """
    import pycolmap

    names = _exported(pictures, scratch)
    database_path = scratch / "sift.db"
    with quiet_colmap():
        reading, extraction = pycolmap.ImageReaderOptions(), pycolmap.FeatureExtractionOptions()
        matching, verification = pycolmap.FeatureMatchingOptions(), pycolmap.TwoViewGeometryOptions()
        reading.camera_model, reading.mask_path = "EQUIRECTANGULAR", scratch / "masks"
        for options in (extraction, matching):
            options.num_threads, options.use_gpu = THREADS, False
        extraction.sift.max_num_features = max_keypoints
        verification.compute_relative_pose = True
        verification.ransac.random_seed, verification.ransac.num_threads = int(rng.integers(1, 2**31 - 1)), THREADS
        pycolmap.extract_features(
            database_path, scratch / "images", reader_options=reading, extraction_options=extraction
        )
        pycolmap.match_exhaustive(database_path, matching_options=matching, verification_options=verification)
    return _read(database_path, names, scratch / "images")


def _exported(pictures: Iterable[tuple[str, NDArray[np.uint8], NDArray[np.bool_]]], scratch: Path) -> list[str]:
    """Write images and masks under numbers, in COLMAP's naming, and return the image names."""
    names = []
    for folder in ("images", "masks"):
        (scratch / folder).mkdir()
    for number, (name, image, valid) in enumerate(pictures):
        names.append(name)
        target = _file_name(number)
        header = f"P6 {image.shape[1]} {image.shape[0]} 255\n".encode()
        (scratch / "images" / target).write_bytes(header + np.ascontiguousarray(image).tobytes())
        mask = cv2.imencode(".png", np.where(valid, np.uint8(255), np.uint8(0)))[1]
        (scratch / "masks" / f"{target}.png").write_bytes(bytes(mask))
    return names


def _file_name(number: int) -> str:
    return f"{number:08d}.ppm"


def _read(path: Path, names: list[str], folder: Path) -> tuple[dict[str, Features], dict[tuple[str, str], TwoView]]:
    """Return the content of the database as records."""
    import pycolmap

    database = pycolmap.Database.open(path)
    try:
        ids = {image.image_id: int(Path(image.name).stem) for image in database.read_all_images()}
        by_number = {number: image_id for image_id, number in ids.items()}
        features = {
            name: _features(database, by_number[number], folder / _file_name(number))
            for number, name in enumerate(names)
        }
        pair_ids, geometries = database.read_two_view_geometries()
    finally:
        database.close()
    found = {}
    for pair_id, geometry in zip(pair_ids, geometries, strict=True):
        first, second = (names[ids[image_id]] for image_id in pycolmap.pair_id_to_image_pair(pair_id))
        found[first, second] = _two_view(geometry, features[first], features[second])
    return features, found


def _features(database: Any, image_id: int, picture: Path) -> Features:
    image = cv2.cvtColor(cv2.imread(str(picture)), cv2.COLOR_BGR2RGB)
    height, width = image.shape[:2]
    keypoints = np.asarray(database.read_keypoints(image_id), np.float64).reshape(-1, 6)
    columns, rows = (np.floor(keypoints[:, axis]).astype(int) for axis in (0, 1))
    scales_px = np.sqrt(np.abs(keypoints[:, 2] * keypoints[:, 5] - keypoints[:, 3] * keypoints[:, 4]))
    # SIFT describes 4 × 4 bins of three scales each.
    return Features(
        bearings=ray_from_pixel(keypoints[:, :2], (height, width)),
        descriptors=np.asarray(database.read_descriptors(image_id).data, np.float32).reshape(-1, 128),
        sizes_rad=(12.0 * scales_px * 2 * np.pi / width).astype(np.float32),
        scores=scales_px.astype(np.float32),
        colors_rgb=image[np.clip(rows, 0, height - 1), columns % width],
        metric="l2",
        size_hw=(height, width),
    )


def _two_view(geometry: Any, first: Features, second: Features) -> TwoView:
    """Return COLMAP's geometry of a pair; a failed one if COLMAP found no relative pose."""
    matches = np.asarray(geometry.inlier_matches, np.int32).reshape(-1, 2)
    pose = geometry.cam2_from_cam1
    length = 0.0 if pose is None else float(np.linalg.norm(pose.translation))
    if length == 0 or not len(matches):
        return TwoView.failed("COLMAP found no relative pose", candidates=len(matches))
    second_from_first = Rigid3(pose.rotation.matrix(), np.array(pose.translation) / length)
    rays = first.bearings[matches[:, 0]], second.bearings[matches[:, 1]]
    residuals, _ = agreement(second_from_first, *rays, threshold_rad=1.0)
    return TwoView(
        matches_idx=matches,
        rotation=second_from_first.rotation,
        direction=second_from_first.translation,
        residuals_rad=residuals.astype(np.float32),
        geometry="general",
        candidates=len(matches),
    )
