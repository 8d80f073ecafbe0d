"""Rigid and similarity transforms: named target_from_source, and groups."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import (
    Rigid3,
    Similarity3,
    geodesic_angle,
    nearest_rotation,
    quat_wxyz_from_rotation,
    rotation_from_quat_wxyz,
    rotation_from_rotvec,
    rotation_from_two_vectors,
    rotvec_from_rotation,
    similarity_from_points,
    skew,
)
from tests.geometry.strategies import ANGLES, FEW, POINTS, RIGIDS, ROTATIONS, SIMILARITIES, UNITS

CLOSE: dict[str, Any] = {"rel": 1e-9, "abs": 1e-8}


@FEW
@given(RIGIDS, POINTS)
def test_a_rigid_transform_is_R_x_plus_t(pose: Rigid3, point: NDArray[np.float64]) -> None:
    assert pose.apply(point) == pytest.approx(pose.rotation @ point + pose.translation, **CLOSE)
    assert pose.apply([[point, 2 * point]])[0, 1] == pytest.approx(pose.apply(2 * point), **CLOSE)


@pytest.mark.slow
@FEW
@given(RIGIDS, RIGIDS, RIGIDS, POINTS)
def test_rigid_transforms_are_a_group(first: Rigid3, second: Rigid3, third: Rigid3, point: NDArray[np.float64]) -> None:
    assert ((first @ second) @ third).apply(point) == pytest.approx((first @ (second @ third)).apply(point), **CLOSE)
    assert (first @ second).apply(point) == pytest.approx(first.apply(second.apply(point)), **CLOSE)
    assert (first.inverse() @ first).apply(point) == pytest.approx(point, **CLOSE)
    assert (first @ first.inverse()).apply(point) == pytest.approx(point, **CLOSE)
    assert (Rigid3.identity() @ first).apply(point) == pytest.approx(first.apply(point), **CLOSE)


@FEW
@given(RIGIDS)
def test_the_centre_is_where_the_camera_stands(cam_from_world: Rigid3) -> None:
    assert cam_from_world.apply(cam_from_world.center) == pytest.approx(np.zeros(3), **CLOSE)
    again = Rigid3.from_center(cam_from_world.rotation, cam_from_world.center)
    assert again.translation == pytest.approx(cam_from_world.translation, **CLOSE)


@FEW
@given(SIMILARITIES, SIMILARITIES, SIMILARITIES, POINTS)
def test_similarities_are_a_group(
    first: Similarity3, second: Similarity3, third: Similarity3, point: NDArray[np.float64]
) -> None:
    left, right = ((first @ second) @ third).apply(point), (first @ (second @ third)).apply(point)
    assert left == pytest.approx(right, rel=1e-9, abs=1e-4)
    assert (first @ second).apply(point) == pytest.approx(first.apply(second.apply(point)), rel=1e-9, abs=1e-6)
    assert (first.inverse() @ first).apply(point) == pytest.approx(point, rel=1e-9, abs=1e-6)
    assert first.inverse().apply(first.apply(point)) == pytest.approx(point, rel=1e-9, abs=1e-6)


@FEW
@given(SIMILARITIES, RIGIDS, POINTS)
def test_a_moved_camera_sees_the_moved_point_in_the_same_direction(
    world: Similarity3, cam_from_source: Rigid3, point: NDArray[np.float64]
) -> None:
    """It is seen scale times as far away, for the unit of length is now the target's."""
    seen = world.move_camera(cam_from_source).apply(world.apply(point))
    assert seen == pytest.approx(world.scale * cam_from_source.apply(point), rel=1e-9, abs=1e-6)
    center = world.move_camera(cam_from_source).center
    assert center == pytest.approx(world.apply(cam_from_source.center), rel=1e-9, abs=1e-6)


@FEW
@given(SIMILARITIES, st.integers(3, 20), st.integers(0, 1000), st.booleans())
def test_a_similarity_is_recovered_from_points(truth: Similarity3, count: int, seed: int, flat: bool) -> None:
    source = np.random.default_rng(seed).normal(size=(count, 3)) * (1, 1, 0 if flat else 1)
    found = similarity_from_points(source, truth.apply(source))
    assert found.scale == pytest.approx(truth.scale, rel=1e-6)
    assert found.rotation == pytest.approx(truth.rotation, abs=1e-5)
    assert found.apply(source) == pytest.approx(truth.apply(source), rel=1e-6, abs=1e-6)


@FEW
@given(ROTATIONS, POINTS, st.integers(0, 1000))
def test_without_scale_the_best_rigid_motion_is_found(
    rotation: NDArray[np.float64], offset: NDArray[np.float64], seed: int
) -> None:
    source = np.random.default_rng(seed).normal(size=(8, 3))
    found = similarity_from_points(source, 3 * source @ rotation.T + offset, with_scale=False)
    assert found.scale == 1
    assert found.rotation == pytest.approx(rotation, abs=1e-9)


def test_points_mirrored_give_a_rotation_and_no_mirror() -> None:
    source = np.random.default_rng(1).normal(size=(10, 3))
    found = similarity_from_points(source, source * (1, 1, -1))
    assert np.linalg.det(found.rotation) == pytest.approx(1)


@pytest.mark.parametrize(
    ("source", "target", "what"),
    [
        (np.zeros((2, 3)), np.zeros((3, 3)), "paired points"),
        (np.zeros((2, 2)), np.zeros((2, 2)), "paired points"),
        (np.zeros((0, 3)), np.zeros((0, 3)), "paired points"),
        (np.ones((4, 3)), np.ones((4, 3)), "coincide"),
    ],
)
def test_points_that_cannot_tell_are_refused(
    source: NDArray[np.float64], target: NDArray[np.float64], what: str
) -> None:
    with pytest.raises(UsageError, match=what):
        similarity_from_points(source, target)


def test_one_point_without_scale_gives_the_shift() -> None:
    found = similarity_from_points([[1, 2, 3]], [[4, 6, 8]], with_scale=False)
    assert found.apply([1, 2, 3]) == pytest.approx([4, 6, 8])


def is_rotation(matrix: NDArray[np.float64]) -> bool:
    return bool(matrix @ matrix.T == pytest.approx(np.eye(3), abs=1e-12) and np.linalg.det(matrix) > 0)


@FEW
@given(POINTS, POINTS)
def test_skew_is_the_cross_product(first: NDArray[np.float64], second: NDArray[np.float64]) -> None:
    assert skew(first) @ second == pytest.approx(np.cross(first, second), abs=1e-9)


@FEW
@given(UNITS, ANGLES)
def test_rotation_vectors_survive_the_round_trip(axis: NDArray[np.float64], angle: float) -> None:
    rotation = rotation_from_rotvec(axis * angle)
    assert is_rotation(rotation)
    back = rotvec_from_rotation(rotation)
    assert np.linalg.norm(back) <= np.pi + 1e-12
    if abs(angle) < np.pi - 1e-6:  # a half turn about an axis is one about its opposite
        assert back == pytest.approx(axis * angle, abs=1e-9)
    assert rotation_from_rotvec(back) == pytest.approx(rotation, abs=1e-9)


@FEW
@given(UNITS, st.floats(-np.pi / 2, np.pi / 2))
def test_a_rotation_turns_right_handedly_about_its_axis(axis: NDArray[np.float64], angle: float) -> None:
    across = np.cross(axis, (0.3, -0.5, 0.8))
    turned = rotation_from_rotvec(axis * angle) @ across
    assert turned == pytest.approx(across * np.cos(angle) + np.cross(axis, across) * np.sin(angle), abs=1e-12)


@FEW
@given(ROTATIONS)
def test_quaternions_survive_the_round_trip(rotation: NDArray[np.float64]) -> None:
    quat_wxyz = quat_wxyz_from_rotation(rotation)
    assert np.linalg.norm(quat_wxyz) == pytest.approx(1, abs=1e-12)
    assert quat_wxyz[0] >= 0
    for factor in (1, -1, 5):  # any length, and both signs, are one rotation
        assert rotation_from_quat_wxyz(factor * quat_wxyz) == pytest.approx(rotation, abs=1e-9)


def test_the_scalar_of_a_quaternion_comes_first() -> None:
    half_turn_about_y = np.diag([-1.0, 1.0, -1.0])
    assert quat_wxyz_from_rotation(half_turn_about_y) == pytest.approx([0, 0, 1, 0])
    assert rotation_from_quat_wxyz((1, 0, 0, 0)) == pytest.approx(np.eye(3))


def test_many_rotations_at_once_are_each_alone() -> None:
    rotvecs = np.random.default_rng(5).normal(size=(4, 3))
    rotations = rotation_from_rotvec(rotvecs)
    quats = quat_wxyz_from_rotation(rotations)
    for idx in range(4):
        assert rotations[idx] == pytest.approx(rotation_from_rotvec(rotvecs[idx]))
        assert quats[idx] == pytest.approx(quat_wxyz_from_rotation(rotations[idx]))
    assert rotation_from_quat_wxyz(quats) == pytest.approx(rotations)


@FEW
@given(ROTATIONS, UNITS, ANGLES)
def test_geodesic_angle_is_that_of_the_turn_between(
    rotation: NDArray[np.float64], axis: NDArray[np.float64], angle: float
) -> None:
    turned = rotation @ rotation_from_rotvec(axis * angle)
    tolerance = 1e-12 if abs(angle) < 3 else 1e-7
    assert geodesic_angle(rotation, turned) == pytest.approx(abs(angle), abs=tolerance)


def test_geodesic_angle_keeps_small_angles() -> None:
    assert geodesic_angle(np.eye(3), rotation_from_rotvec((0, 1e-10, 0))) == pytest.approx(1e-10, rel=1e-5)


@FEW
@given(ROTATIONS, st.integers(0, 1000))
def test_the_nearest_rotation_undoes_a_small_error(rotation: NDArray[np.float64], seed: int) -> None:
    noise = 1e-3 * np.random.default_rng(seed).normal(size=(3, 3))
    found = nearest_rotation(rotation + noise)
    assert is_rotation(found)
    assert np.linalg.norm(found - rotation - noise) <= np.linalg.norm(noise) + 1e-15


@FEW
@given(ROTATIONS)
def test_the_nearest_rotation_of_a_reflection_is_no_reflection(rotation: NDArray[np.float64]) -> None:
    assert is_rotation(nearest_rotation(rotation @ np.diag([1.0, 1.0, -0.5])))


@FEW
@given(UNITS, UNITS)
@example(np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, -1.0]))
@example(np.array([0.0, 0.0, 1.0]), np.array([3e-12, -4e-12, -1.0]))
@example(np.array([0.6, 0.0, 0.8]), np.array([-0.6, 2e-12, -0.8]))
@example(np.array([1.0, 0.0, 0.0]), np.array([1.0, 1e-13, 0.0]))
def test_the_turn_from_one_direction_to_another_is_exact_and_the_smallest(
    source: NDArray[np.float64], target: NDArray[np.float64]
) -> None:
    target = target / np.linalg.norm(target)
    rotation = rotation_from_two_vectors(2 * source, 5 * target)
    assert is_rotation(rotation)
    assert rotation @ source == pytest.approx(target, abs=1e-9)
    between = np.arctan2(np.linalg.norm(np.cross(source, target)), source @ target)
    assert geodesic_angle(np.eye(3), rotation) == pytest.approx(between, abs=1e-7)


@pytest.mark.parametrize("error", [1e-7, 1e-10, 1e-11, 1e-12, 1e-13, 1e-15])
def test_the_turn_between_nearly_opposite_directions_is_exact(error: float) -> None:
    """The rounding of the cross product once tipped the axis out of its plane, by 7e-5 in the result."""
    rng = np.random.default_rng(0)
    for source in rng.normal(size=(50, 3)):
        target = error * rng.normal(size=3) - source / np.linalg.norm(source)
        rotation = rotation_from_two_vectors(source, target)
        turned = rotation @ (source / np.linalg.norm(source))
        assert turned == pytest.approx(target / np.linalg.norm(target), abs=1e-12)
