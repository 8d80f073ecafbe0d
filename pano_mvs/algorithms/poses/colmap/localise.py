"""Localise ordinary photographs among panoramas: the pose and the focal length from key points with ranges."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.features.photograph import PhotographKeypoints
from pano_mvs.algorithms.matching.brute_force import match_l2
from pano_mvs.algorithms.poses.photograph_camera import FocalPrior, PhotographCamera, refine_camera
from pano_mvs.core.settings import Setting, checks_settings
from pano_mvs.geometry import Rigid3, pixel_from_ray
from pano_mvs.scene import Features, RangeMap

FloatArray = NDArray[np.float64]

_SEED_LIMIT = 2**31 - 1
_SIFT_LENGTH = 128
# Without a focal length in the file, a picture is taken to be as wide as most phones' for the first guess.
_GUESSED_FOV_DEG = 65.0
_FOV_BOUNDS_DEG = (15.0, 120.0)
_MAX_RADIAL = 0.5
# Ranges are used where the surface is continuous: the relative difference to the pixels beside it.
_MAX_STEP = 0.03
# How well EXIF's focal length, or a guessed one, is known: the standard deviation of its natural logarithm.
_EXIF_LOG_STD, _GUESSED_LOG_STD = 0.1, 0.4
# With a pose, key points within this many times the maximum error of a point's place are compared with it.
_GUIDED_ROUNDS, _GUIDED, _GUIDED_RATIO, _MAX_DISTANCE = 2, 2.0, 0.9, 300.0
_MIN_INLIER_SHARE = 0.15
# The inliers must spread over the picture: the standard deviation of their pixels, as a share of its diagonal.
_MIN_SPREAD = 0.05


class Localised(NamedTuple):
    """A photograph's pose and camera (see `Photographs`).

    Attributes:
        cam_from_world: the pose.
        focal_px: focal length.
        radial: coefficient of the distortion.
        inliers: number of key points that agree.
        error_px: median error of these.
    """

    cam_from_world: Rigid3
    focal_px: float
    radial: float
    inliers: int
    error_px: float


@dataclass(frozen=True, slots=True, eq=False)
class KnownPoints:
    """The key points of a panorama whose position is known.

    Attributes:
        descriptors: (N, D).
        points_in_world: (N, 3) float64.
    """

    descriptors: NDArray[np.generic]
    points_in_world: FloatArray


def has_sift(features: Features) -> bool:
    """Return whether key points can be compared with those of photographs."""
    return features.metric == "l2" and features.descriptors.shape[1] == _SIFT_LENGTH


def known_points(
    features: Features, cam_from_world: Rigid3, range_map: RangeMap, *, min_confidence: int
) -> KnownPoints:
    """Return the key points of a panorama that its range map places in the world.

    Key points at edges of surfaces, whose range is uncertain, are left out.

    Args:
        features: key points by `extract_sift`.
        cam_from_world: the panorama's pose.
        range_map: its ranges.
        min_confidence: smallest confidence of a range that is used.
    """
    height, width = range_map.range.shape
    x, y = np.floor(pixel_from_ray(features.bearings, (height, width))).astype(np.intp).T
    x, y = x % width, np.clip(y, 0, height - 1)
    ranges = range_map.range[y, x].astype(np.float64)
    beside = np.stack([range_map.range[np.clip(y + dy, 0, height - 1), (x + dx) % width] for dx, dy in _BESIDE])
    with np.errstate(invalid="ignore"):
        smooth = (np.abs(beside - ranges) <= _MAX_STEP * ranges).all(axis=0)
    keep = smooth & np.isfinite(ranges) & (range_map.confidence[y, x] >= min_confidence)
    points = cam_from_world.inverse().apply(features.bearings[keep] * ranges[keep, None])
    return KnownPoints(features.descriptors[keep], points)


_BESIDE = ((-1, 0), (1, 0), (0, -1), (0, 1))


@checks_settings
def localise_photograph(
    keypoints: PhotographKeypoints,
    size_hw: tuple[int, int],
    panoramas: Mapping[str, KnownPoints],
    *,
    focal_px: float | None,
    min_inliers: Annotated[int, Setting("minimum number of key points that agree with the pose", ge=6)] = 30,
    max_error_deg: Annotated[float, Setting("maximum error of a key point that agrees", gt=0, le=5)] = 0.4,
    rng: np.random.Generator,
) -> Localised | str:
    """Estimate the pose and the focal length of a photograph, or return the reason why that is not possible.

    Its key points are matched with those of each panorama. LO-RANSAC finds the pose, with the focal length unless it is
    known (as implemented by COLMAP). Pose, focal length and one coefficient of radial distortion are then refined, with
    more matches, which are looked for near the places that the pose predicts.

    Args:
        keypoints: of the photograph.
        size_hw: (height, width) of the photograph.
        panoramas: key points with positions, by name.
        focal_px: focal length if it is known, None otherwise.
        min_inliers: minimum number of key points that agree with the pose.
        max_error_deg: maximum error of these.
        rng: gives RANSAC's seed.
    """
    import pycolmap

    pixels, points = _matches(keypoints, panoramas)
    if len(pixels) < min_inliers:
        return f"only {len(pixels)} of its {len(keypoints.pixels_px)} key points match points of the panoramas"
    height, width = size_hw
    guess_px = focal_px or max(size_hw) / 2 / float(np.tan(np.radians(_GUESSED_FOV_DEG) / 2))
    camera = pycolmap.Camera(
        model="SIMPLE_RADIAL", width=width, height=height, params=[guess_px, width / 2, height / 2, 0.0]
    )
    estimation = pycolmap.AbsolutePoseEstimationOptions()
    estimation.estimate_focal_length = focal_px is None
    estimation.ransac.max_error = guess_px * float(np.radians(max_error_deg))
    estimation.ransac.random_seed = int(rng.integers(1, _SEED_LIMIT))
    found = pycolmap.estimate_absolute_pose(pixels, points, camera, estimation)
    if found is None:
        return f"no pose agrees with its {len(pixels)} matches"
    first = PhotographCamera(_rigid(found["cam_from_world"]), float(camera.params[0]), 0.0)
    if focal_px is None:
        prior = FocalPrior(max(size_hw) / 2 / float(np.tan(np.radians(_GUESSED_FOV_DEG) / 2)), _GUESSED_LOG_STD)
    else:
        prior = FocalPrior(focal_px, _EXIF_LOG_STD)
    max_error = float(np.radians(max_error_deg))
    refined = refine_camera(pixels, points, first, size_hw=size_hw, prior=prior, max_error=max_error)
    errors = refined.errors(pixels, points, size_hw)
    inliers = errors < refined.focal_px * max_error
    # Guided matches confirm any pose to some degree, so these have to be enough without them.
    if reason := _implausible(pixels[inliers], size_hw, camera=refined, matches=len(pixels), min_inliers=min_inliers):
        return reason
    for _ in range(_GUIDED_ROUNDS):
        guided = _guided_matches(keypoints, panoramas, refined, size_hw=size_hw, max_error=_GUIDED * max_error)
        pixels, points = np.concatenate([pixels, guided[0]]), np.concatenate([points, guided[1]])
        refined = refine_camera(pixels, points, refined, size_hw=size_hw, prior=prior, max_error=max_error)
        errors = refined.errors(pixels, points, size_hw)
        inliers = errors < refined.focal_px * max_error
        pixels, points, errors = pixels[inliers], points[inliers], errors[inliers]
    reason = _implausible(pixels, size_hw, camera=refined, matches=len(pixels), min_inliers=min_inliers)
    return reason or Localised(
        refined.cam_from_world,
        refined.focal_px,
        refined.radial,
        inliers=len(np.unique(pixels, axis=0)),
        error_px=float(np.median(errors)),
    )


def _rigid(pose: Any) -> Rigid3:
    return Rigid3(pose.rotation.matrix(), np.array(pose.translation))


def _matches(keypoints: PhotographKeypoints, panoramas: Mapping[str, KnownPoints]) -> tuple[FloatArray, FloatArray]:
    """Return the pixels (M, 2) of matched key points, and the points (M, 3) that they show."""
    pixels, points = [np.zeros((0, 2))], [np.zeros((0, 3))]
    for known in panoramas.values():
        if min(len(keypoints.descriptors), len(known.descriptors)) < 2:
            continue
        matched = match_l2(keypoints.descriptors, known.descriptors)
        pixels.append(keypoints.pixels_px[matched[:, 0]])
        points.append(known.points_in_world[matched[:, 1]])
    return np.concatenate(pixels), np.concatenate(points)


def _guided_matches(
    keypoints: PhotographKeypoints,
    panoramas: Mapping[str, KnownPoints],
    camera: PhotographCamera,
    *,
    size_hw: tuple[int, int],
    max_error: float,
) -> tuple[FloatArray, FloatArray]:
    """Match each known point with the most similar of the key points near its place in the photograph.

    These are many more matches than those without a pose, because only key points nearby compete.

    Returns:
        (M, 2) pixels and (M, 3) points.
    """
    from scipy.spatial import cKDTree

    tree = cKDTree(keypoints.pixels_px)
    pixels, points = [np.zeros((0, 2))], [np.zeros((0, 3))]
    for known in panoramas.values():
        seen, before = camera.project(known.points_in_world, size_hw)
        inside = np.flatnonzero(before & ((seen >= 0) & (seen < size_hw[::-1])).all(axis=1))
        chosen: dict[int, tuple[float, int]] = {}
        for idx in inside.tolist():
            nearby = tree.query_ball_point(seen[idx], camera.focal_px * max_error, return_sorted=True)
            distance, key = _most_similar(keypoints.descriptors, nearby, known.descriptors[idx].astype(np.float32))
            if distance < chosen.get(key, (_MAX_DISTANCE, 0))[0]:
                chosen[key] = distance, idx
        pixels.append(keypoints.pixels_px[list(chosen)].reshape(-1, 2))
        points.append(known.points_in_world[[idx for _, idx in chosen.values()]].reshape(-1, 3))
    return np.concatenate(pixels), np.concatenate(points)


def _most_similar(
    descriptors: NDArray[np.float32], candidates: list[int], wanted: NDArray[np.float32]
) -> tuple[float, int]:
    """Return the distance and the position of the most similar candidate; an infinite distance if it is ambiguous."""
    if not candidates:
        return np.inf, -1
    distances = np.linalg.norm(descriptors[candidates] - wanted, axis=1)
    best = int(distances.argmin())
    if len(distances) > 1 and distances[best] > _GUIDED_RATIO * np.partition(distances, 1)[1]:
        return np.inf, -1
    return float(distances[best]), candidates[best]


def _implausible(
    inliers_px: FloatArray, size_hw: tuple[int, int], *, camera: PhotographCamera, matches: int, min_inliers: int
) -> str:
    """Return why a pose cannot be trusted, "" if it can."""
    # A key point that matches the same place in several panoramas counts once.
    distinct = len(np.unique(inliers_px, axis=0))
    if distinct < min_inliers or len(inliers_px) < _MIN_INLIER_SHARE * matches:
        return f"only {len(inliers_px)} of its {matches} matches, of {distinct} key points, agree with one pose"
    fov_deg = float(np.degrees(2 * np.arctan(max(size_hw) / 2 / camera.focal_px)))
    if not _FOV_BOUNDS_DEG[0] <= fov_deg <= _FOV_BOUNDS_DEG[1] or abs(camera.radial) > _MAX_RADIAL:
        return f"its matches give an implausible camera: {fov_deg:.0f}° wide, distortion {camera.radial:.2f}"
    spread = np.linalg.svd(inliers_px - inliers_px.mean(axis=0), compute_uv=False)[-1] / np.sqrt(len(inliers_px))
    if spread < _MIN_SPREAD * np.hypot(*size_hw):
        return "its matches lie on a line or in one spot, which does not determine a pose"
    return ""
