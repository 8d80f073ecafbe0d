"""Single cameras against the truth: a wrong one is found and does not make others wrong."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.geometry import Rigid3, Similarity3, rotation_from_rotvec
from pano_mvs.scene import Poses
from tests.algorithms.poses.synthetic_capture import random_poses, random_rotation
from tools.benchmarks.poses.placements import judge_placements


def poses_of(cameras: dict[str, Rigid3], **more: Any) -> Poses:
    return replace(Poses.without_points(cameras, frame="any", scale="any", metric=False), **more)


def moved(cameras: dict[str, Rigid3], rng: np.random.Generator) -> dict[str, Rigid3]:
    similarity = Similarity3(float(rng.uniform(0.1, 10)), random_rotation(rng), rng.normal(size=3))
    return {name: similarity.move_camera(pose) for name, pose in cameras.items()}


def extent_of(cameras: dict[str, Rigid3]) -> float:
    centers = np.array([pose.center for pose in cameras.values()])
    return float(np.linalg.norm(centers[:, None] - centers, axis=-1).max())


def displaced(
    pose: Rigid3, *, by: NDArray[np.float64] | tuple[float, float, float] = (0.0, 0.0, 0.0), turn_deg: float = 0.0
) -> Rigid3:
    turn = rotation_from_rotvec([0, np.deg2rad(turn_deg), 0])
    return Rigid3.from_center(turn @ pose.rotation, pose.center + np.array(by))


@pytest.mark.parametrize("seed", range(4))
def test_right_cameras_are_right_in_any_world_frame_and_scale(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = random_poses(rng, 6)
    placed = judge_placements(poses_of(moved(truth, rng)), truth)
    assert placed.right.all()
    assert placed.names == tuple(truth)
    assert placed.rotation_deg.max() < 1e-5
    assert placed.center_shares.max() < 1e-9
    assert placed.expected == 6


@pytest.mark.parametrize("seed", range(4))
def test_a_camera_that_is_far_off_spoils_no_other(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = random_poses(rng, 6)
    names = list(truth)
    step = 20 * extent_of(truth) * np.array([0, 0, 1.0])
    estimated = truth | {
        names[2]: displaced(truth[names[2]], by=step),
        names[4]: displaced(truth[names[4]], turn_deg=3),
    }
    placed = judge_placements(poses_of(moved(estimated, rng), doubts={names[4]: "odd"}), truth)
    assert placed.right.tolist() == [True, True, False, True, False, True]
    assert placed.center_shares[2] == pytest.approx(20, rel=1e-6)
    assert placed.rotation_deg[4] == pytest.approx(3, rel=1e-6)
    assert placed.doubted.tolist() == [False] * 4 + [True, False]
    assert placed.unreported == (names[2],)


def test_limits_are_a_degree_and_a_fiftieth_of_the_true_extent() -> None:
    rng = np.random.default_rng(5)
    truth = random_poses(rng, 12)
    names, extent = list(truth), extent_of(truth)
    verdicts = []
    for share, turn_deg in ((0.018, 0.0), (0.03, 0.0), (0.0, 0.95), (0.0, 1.2)):
        estimated = truth | {names[0]: displaced(truth[names[0]], by=(0, share * extent, 0), turn_deg=turn_deg)}
        placed = judge_placements(poses_of(estimated), truth)
        assert placed.right[1:].all()
        verdicts.append(bool(placed.right[0]))
    # The fit to all right cameras takes up a little of what one of twelve is off.
    assert verdicts == [True, False, True, False]


def test_of_two_pieces_that_contradict_each_other_the_larger_is_right() -> None:
    rng = np.random.default_rng(6)
    truth = random_poses(rng, 7)
    names = list(truth)
    shifted = {name: displaced(truth[name], by=(extent_of(truth), 0, 0)) for name in names[:3]}
    placed = judge_placements(poses_of(moved(truth | shifted, rng)), truth)
    assert placed.right.tolist() == [False] * 3 + [True] * 4


def test_groups_are_aligned_each_by_itself() -> None:
    rng = np.random.default_rng(7)
    truth = random_poses(rng, 6)
    names = list(truth)
    first, second = ({name: truth[name] for name in part} for part in (names[:3], names[3:5]))
    estimated = moved(first, rng) | moved(second, rng) | moved({names[5]: truth[names[5]]}, rng)
    group_idx = np.array([0, 0, 0, 1, 1, 2], np.int32)
    placed = judge_placements(poses_of(estimated, group_idx=group_idx), truth)
    assert placed.right.tolist() == [True] * 5
    assert placed.alone == (names[5],)
    assert judge_placements(poses_of(estimated), truth).right.sum() < 5


def test_two_cameras_are_right_though_the_direction_between_them_is_not_exact() -> None:
    """A fit to centres alone once turned two close cameras by the error of their direction, and both were wrong."""
    rng = np.random.default_rng(10)
    truth = random_poses(rng, 6)
    names = list(truth)
    first = truth[names[0]]
    near = 0.05 * extent_of(truth) * np.array([1.0, 0, 0])
    truth[names[1]] = displaced(first, by=near)
    estimated = {names[0]: first, names[1]: displaced(first, by=near + np.array([0, 0.1 * near[0], 0]))}  # 6° off
    assert judge_placements(poses_of(moved(estimated, rng)), truth).right.all()
