"""Panoramas that were cropped above and below and stretched to 2:1 are found by the residuals of their rays."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pano_mvs.algorithms.poses.adjustment.refine import ElevationRange, fitted_elevation_range, refine_poses
from pano_mvs.algorithms.poses.verification.belief.doubts import is_doubtful
from pano_mvs.engine.stages.context import Context
from pano_mvs.geometry import Rigid3, pixel_from_ray, ray_from_pixel
from pano_mvs.scene import Poses
from pano_mvs.stages.poses import RefineParams, refine
from tests.algorithms.poses.synthetic_capture import noisy_bearings, points_in_box, random_poses

SIZE_HW = (512, 1024)


def seen_in(top_deg: float, bottom_deg: float, *, seed: int, cameras: int = 5) -> Poses:
    """Poses of images that end at two elevations, of points in a box, read as if they were full spheres."""
    rng = np.random.default_rng(seed)
    poses, points = random_poses(rng, cameras), points_in_box(rng, 400)
    tracks = []
    for idx, pose in enumerate(poses.values()):
        pixels = pixel_from_ray(noisy_bearings(rng, pose, points, noise_deg=0.05), SIZE_HW)
        elevations_deg = 90 - pixels[:, 1] / SIZE_HW[0] * 180
        pixels[:, 1] = (top_deg - elevations_deg) / (top_deg - bottom_deg) * SIZE_HW[0]
        inside = np.flatnonzero((pixels[:, 1] > 0) & (pixels[:, 1] < SIZE_HW[0]))
        tracks += [
            (point, idx, ray) for point, ray in zip(inside, ray_from_pixel(pixels[inside], SIZE_HW), strict=True)
        ]
    point_idx, image_idx, bearings = (np.array(column) for column in zip(*tracks, strict=True))
    return _with_tracks(poses, points, point_idx, image_idx=image_idx, bearings=bearings)


def _with_tracks(
    poses: dict[str, Rigid3], points: np.ndarray, point_idx: np.ndarray, *, image_idx: np.ndarray, bearings: np.ndarray
) -> Poses:
    bare = Poses.without_points(poses, frame="", scale="", metric=False)
    order = np.lexsort((image_idx, point_idx))
    return Poses(
        bare.names,
        bare.rotations,
        bare.translations,
        points,
        np.zeros((len(points), 3), np.uint8),
        np.zeros(len(points), np.float32),
        point_idx[order].astype(np.int32),
        image_idx[order].astype(np.int32),
        bearings[order],
        rejected={},
        frame="",
        scale="",
        metric=False,
    )


def range_of(poses: Poses) -> ElevationRange:
    found = fitted_elevation_range(poses, refine_poses(poses), loss="cauchy", loss_scale_deg=0.1)
    assert found is not None
    return found


@pytest.mark.parametrize("seed", range(3))
def test_full_spheres_are_full(seed: int) -> None:
    found = range_of(seen_in(90, -90, seed=seed))
    assert found.is_full
    assert found.top_deg == pytest.approx(90, abs=0.5)
    assert found.bottom_deg == pytest.approx(-90, abs=0.5)


@pytest.mark.parametrize(("top_deg", "bottom_deg"), [(84, -84), (90, -80), (80, -90), (75, -75)])
def test_the_edges_of_cropped_images_are_found(top_deg: float, bottom_deg: float) -> None:
    found = range_of(seen_in(top_deg, bottom_deg, seed=1))
    assert not found.is_full
    assert found.top_deg == pytest.approx(top_deg, abs=1)
    assert found.bottom_deg == pytest.approx(bottom_deg, abs=1)


@pytest.mark.parametrize(("top_deg", "doubted"), [(90, False), (75, True)])
def test_cameras_of_cropped_images_are_improbable_and_doubted(top_deg: float, doubted: bool, tmp_path: Path) -> None:
    """Regression: they kept the probability of .99 that was measured as if their images were full spheres."""
    poses = seen_in(top_deg, -top_deg, seed=1)
    poses = replace(poses, right_probabilities=np.full(len(poses.names), 0.99))
    params = RefineParams.model_validate({"align": False})
    refined = refine(poses=poses, images={}, params=params, ctx=Context(np.random.default_rng(0), tmp_path))
    assert set(refined.doubts) == (set(poses.names) if doubted else set())
    assert refined.right_probabilities is not None
    assert all(is_doubtful(float(p)) == doubted for p in refined.right_probabilities)


def test_rays_and_steps_agree() -> None:
    claimed = np.radians([[80.0], [-30.0]])
    first, second = ElevationRange(85, -80, (0, 0)), ElevationRange(88, -87, (0, 0))
    both = second.elevations_rad(first.elevations_rad(claimed))
    assert np.allclose(first.then(second).elevations_rad(claimed), both)
    rays = np.stack([np.cos(claimed[:, 0]), -np.sin(claimed[:, 0]), np.zeros(2)], axis=1)
    assert np.allclose(np.arcsin(-first.bearings(rays)[:, 1]), first.elevations_rad(claimed[:, 0]))
    assert np.allclose(first.bearings(rays)[:, 2], 0)


def test_poses_without_tracks_say_nothing() -> None:
    bare = Poses.without_points(random_poses(np.random.default_rng(0), 3), frame="", scale="", metric=False)
    assert fitted_elevation_range(bare, bare, loss="cauchy", loss_scale_deg=0.1) is None
