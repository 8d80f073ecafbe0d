"""Rigid and similarity transforms: named target_from_source, and groups."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3, Similarity3, rotation_from_rotvec, similarity_from_points
from tests.geometry.strategies import POINTS, RIGIDS, ROTATIONS, SIMILARITIES

CLOSE: dict[str, Any] = {"rel": 1e-9, "abs": 1e-8}


@given(RIGIDS, POINTS)
def test_a_rigid_transform_is_R_x_plus_t(pose: Rigid3, point: NDArray[np.float64]) -> None:
    assert pose.apply(point) == pytest.approx(pose.rotation @ point + pose.translation, **CLOSE)
    assert pose.apply([[point, 2 * point]])[0, 1] == pytest.approx(pose.apply(2 * point), **CLOSE)


@given(RIGIDS, RIGIDS, RIGIDS, POINTS)
def test_rigid_transforms_are_a_group(first: Rigid3, second: Rigid3, third: Rigid3, point: NDArray[np.float64]) -> None:
    assert ((first @ second) @ third).apply(point) == pytest.approx((first @ (second @ third)).apply(point), **CLOSE)
    assert (first @ second).apply(point) == pytest.approx(first.apply(second.apply(point)), **CLOSE)
    assert (first.inverse() @ first).apply(point) == pytest.approx(point, **CLOSE)
    assert (first @ first.inverse()).apply(point) == pytest.approx(point, **CLOSE)
    assert (Rigid3.identity() @ first).apply(point) == pytest.approx(first.apply(point), **CLOSE)


@given(RIGIDS)
def test_the_centre_is_where_the_camera_stands(cam_from_world: Rigid3) -> None:
    assert cam_from_world.apply(cam_from_world.center) == pytest.approx(np.zeros(3), **CLOSE)
    again = Rigid3.from_center(cam_from_world.rotation, cam_from_world.center)
    assert again.translation == pytest.approx(cam_from_world.translation, **CLOSE)


@given(SIMILARITIES, SIMILARITIES, SIMILARITIES, POINTS)
def test_similarities_are_a_group(
    first: Similarity3, second: Similarity3, third: Similarity3, point: NDArray[np.float64]
) -> None:
    left, right = ((first @ second) @ third).apply(point), (first @ (second @ third)).apply(point)
    assert left == pytest.approx(right, rel=1e-9, abs=1e-4)
    assert (first @ second).apply(point) == pytest.approx(first.apply(second.apply(point)), rel=1e-9, abs=1e-6)
    assert (first.inverse() @ first).apply(point) == pytest.approx(point, rel=1e-9, abs=1e-6)
    assert first.inverse().apply(first.apply(point)) == pytest.approx(point, rel=1e-9, abs=1e-6)


@given(SIMILARITIES, RIGIDS, POINTS)
def test_a_moved_camera_sees_the_moved_point_in_the_same_direction(
    world: Similarity3, cam_from_source: Rigid3, point: NDArray[np.float64]
) -> None:
    """It is seen scale times as far away, for the unit of length is now the target's."""
    seen = world.move_camera(cam_from_source).apply(world.apply(point))
    assert seen == pytest.approx(world.scale * cam_from_source.apply(point), rel=1e-9, abs=1e-6)
    center = world.move_camera(cam_from_source).center
    assert center == pytest.approx(world.apply(cam_from_source.center), rel=1e-9, abs=1e-6)


@given(SIMILARITIES, st.integers(3, 20), st.integers(0, 1000), st.booleans())
def test_a_similarity_is_recovered_from_points(truth: Similarity3, count: int, seed: int, flat: bool) -> None:
    source = np.random.default_rng(seed).normal(size=(count, 3)) * (1, 1, 0 if flat else 1)
    found = similarity_from_points(source, truth.apply(source))
    assert found.scale == pytest.approx(truth.scale, rel=1e-6)
    assert found.rotation == pytest.approx(truth.rotation, abs=1e-5)
    assert found.apply(source) == pytest.approx(truth.apply(source), rel=1e-6, abs=1e-6)


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


def test_noise_moves_the_similarity_by_no_more_than_itself() -> None:
    rng = np.random.default_rng(2)
    truth = Similarity3(2.5, rotation_from_rotvec((0.3, 0.5, -1)), np.array([1.0, 2, 3]))
    source = rng.normal(size=(500, 3))
    found = similarity_from_points(source, truth.apply(source) + 0.01 * rng.normal(size=(500, 3)))
    assert found.scale == pytest.approx(2.5, abs=2e-3)
    assert found.rotation == pytest.approx(truth.rotation, abs=2e-3)


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
