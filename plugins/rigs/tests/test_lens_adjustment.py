"""Lenses, the pose of one in the other, cameras and points are recovered from exact and noisy key points.

The image circle of a lens: found to a fraction of a pixel, also if the border cuts it, or not at all.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from pano_mvs_rigs.adjustment import (
    CAMERAS,
    Freedom,
    RigBundle,
    _linearised,
    _moved,
    adjust_rig,
    residuals_px,
)
from pano_mvs_rigs.circles import brightest, find_circle

from pano_mvs.geometry import geodesic_angle, rotation_from_rotvec
from pano_mvs.testing.room import capture_poses, default_room, range_along
from tools.benchmarks.poses.lens_calibration import random_rig


def true_bundle(seed: int, *, count: int = 6, points: int = 400, noise_px: float = 0.0) -> RigBundle:
    """Return what a random rig sees of points of the furnished room; the world is its first lens in the first pose."""
    rng, rig = np.random.default_rng(seed), random_rig(seed)
    first, second = rig.lens_from_rig
    second_from_first = second @ first.inverse()
    poses = [first @ pose for pose in capture_poses(count, seed=seed)]
    world = poses[0]
    rays = rng.normal(size=(points, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    room_points = world.center + rays * range_along(default_room(), world.center, rays)[:, None]
    seen: list[tuple[float, ...]] = []
    for camera, pose in enumerate(poses):
        in_first = pose.apply(room_points)
        for lens_idx, lens in enumerate(rig.lenses):
            pixels = lens.pixel_from_ray(second_from_first.apply(in_first) if lens_idx else in_first)
            chosen = np.flatnonzero(np.isfinite(pixels[:, 0]) & (rng.random(points) < 0.6))
            seen += [(camera, lens_idx, idx, *pixels[idx]) for idx in chosen.tolist()]
    table = np.array(seen)
    moved = [pose @ world.inverse() for pose in poses]
    bundle = RigBundle(
        lenses=np.array([[lens.focal_xy[0], *lens.principal_xy, *lens.distortion] for lens in rig.lenses]),
        turn=second_from_first.rotation,
        offset=second_from_first.translation,
        rotations=np.array([pose.rotation for pose in moved]),
        translations=np.array([pose.translation for pose in moved]),
        points=world.apply(room_points),
        pixels=table[:, 3:] + rng.normal(0, noise_px, (len(table), 2)),
        lens_idx=table[:, 1].astype(np.intp),
        camera_idx=table[:, 0].astype(np.intp),
        point_idx=table[:, 2].astype(np.intp),
    )
    return bundle.only(np.ones(len(table), np.bool_))


def started(true: RigBundle, seed: int) -> tuple[RigBundle, Freedom]:
    """Return start values as circles and rims give them, and what is adjusted."""
    rng = np.random.default_rng(seed)
    lenses = true.lenses * [1.03, 1, 1, 0, 0, 0, 0] + [0, 6, -5, 0, 0, 0, 0]
    start = replace(
        true,
        lenses=lenses,
        turn=rotation_from_rotvec(rng.normal(0, 0.02, 3)) @ true.turn,
        offset=np.zeros(3),
        points=true.points + rng.normal(0, 0.03, true.points.shape),
    )
    focal = lenses[0, 0]
    sigmas = [0.2 * focal, 0.05 * focal, 0.05 * focal, 0.1, 0.05, 0.02, 0.005] * 2
    return start, Freedom(
        np.array([*sigmas, *(0.17,) * 3, *(np.inf,) * 3]), np.concatenate([lenses.ravel(), np.zeros(6)])
    )


def test_the_projection_is_that_of_the_lenses() -> None:
    assert residuals_px(true_bundle(0)) == pytest.approx(0, abs=1e-9)


def test_derivatives_are_those_of_the_errors() -> None:
    bundle = true_bundle(1, count=3, points=40)
    errors, by_camera, columns, by_point = _linearised(bundle)
    size, step = CAMERAS + 6 * len(bundle.rotations), 1e-6
    for column in range(size):
        change = np.zeros(size)
        change[column] = step
        numeric = (_linearised(_moved(bundle, change, np.zeros_like(bundle.points)))[0] - errors) / step
        exact = np.where(columns[:, None] == column, by_camera, 0.0).sum(axis=-1)
        assert numeric == pytest.approx(exact, rel=1e-4, abs=2e-5 * max(1.0, float(np.abs(exact).max())))
    for axis in range(3):
        steps = np.zeros_like(bundle.points)
        steps[:, axis] = step
        numeric = (_linearised(_moved(bundle, np.zeros(size), steps))[0] - errors) / step
        assert numeric == pytest.approx(by_point[..., axis], rel=1e-4, abs=0.02)


@pytest.mark.parametrize("seed", [1, 2])
def test_the_camera_is_recovered_within_its_stated_uncertainty(seed: int) -> None:
    true = true_bundle(seed, noise_px=0.2)
    start, freedom = started(true, seed)
    found, _ = adjust_rig(start, freedom, scale_px=5.0)
    found, covariance = adjust_rig(found, freedom, scale_px=0.6)
    stds = np.sqrt(np.diag(covariance))
    deviations = (found.lenses - true.lenses).ravel() / stds[:14]
    assert 0.2 < np.sqrt(np.mean(deviations**2)) < 2.5
    turn_std, offset_std = (
        np.sqrt(np.linalg.eigvalsh(covariance[part, part])[-1]) for part in (slice(14, 17), slice(17, 20))
    )
    assert geodesic_angle(found.turn, true.turn) < min(6 * turn_std, np.radians(0.15))
    assert np.linalg.norm(found.offset - true.offset) < min(6 * offset_std, 0.1 * np.linalg.norm(true.offset))


def test_an_offset_that_is_held_stays() -> None:
    start, freedom = started(true_bundle(3, count=3, points=150), 3)
    sigmas = freedom.sigmas.copy()
    sigmas[-3:] = 0
    found, covariance = adjust_rig(start, replace(freedom, sigmas=sigmas), scale_px=5.0, max_iterations=4)
    assert not found.offset.any()
    assert not covariance[-3:].any()


def disc(center_xy: tuple[float, float], radius: float, *, dark: float = 3.0) -> NDArray[np.uint8]:
    rng = np.random.default_rng(0)
    rows, columns = np.mgrid[:400, :420] + 0.5
    away = np.hypot(columns - center_xy[0], rows - center_xy[1])
    light = np.clip(radius - away + 0.5, 0, 1) * (1 - 0.6 * np.clip(away / radius, 0, 1) ** 4)
    texture = rng.uniform(60, 250, (400, 420))
    picture: NDArray[np.uint8] = np.clip(np.rint(dark + light * texture), 0, 255).astype(np.uint8)
    return picture


@pytest.mark.parametrize(
    ("center_xy", "radius", "seen"),
    [((205.0, 192.0), 170.0, 1.0), ((214.3, 208.8), 183.0, 0.99), ((210.0, 200.0), 215.0, 0.35)],
)
def test_a_circle_is_found_although_the_border_may_cut_it(
    center_xy: tuple[float, float], radius: float, seen: float
) -> None:
    pictures = [np.stack([np.roll(disc(center_xy, radius), 0)] * 3, axis=-1) for _ in range(2)]
    circle = find_circle(brightest(pictures))
    assert circle is not None
    assert circle.center_xy == pytest.approx(center_xy, abs=1.5)
    assert circle.radius_px == pytest.approx(radius, rel=0.015)
    assert circle.seen > seen - 0.05


def test_reflections_outside_of_the_circle_do_not_move_it() -> None:
    picture = disc((205.0, 192.0), 150.0)
    picture[5:60, 5:110] = 120
    circle = find_circle(picture)
    assert circle is not None
    assert circle.center_xy == pytest.approx((205.0, 192.0), abs=1.5)


@pytest.mark.parametrize("value", [0, 90, 255])
def test_a_picture_without_dark_surround_has_no_circle(value: int) -> None:
    assert find_circle(np.full((200, 200), value, np.uint8)) is None
