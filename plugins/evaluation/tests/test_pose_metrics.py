from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3, Similarity3, rotation_from_rotvec
from pano_mvs.geometry.pose_errors import align_centers, center_errors, relative_pose_errors
from tests.algorithms.poses.synthetic_capture import random_poses, random_rotation


def moved(poses: dict[str, Rigid3], similarity: Similarity3) -> dict[str, Rigid3]:
    return {name: similarity.move_camera(pose) for name, pose in poses.items()}


def test_no_error_in_any_world_frame_and_scale() -> None:
    rng = np.random.default_rng(1)
    truth = random_poses(rng, 5)
    errors = relative_pose_errors(moved(truth, Similarity3(3.0, random_rotation(rng), rng.normal(size=3))), truth)
    assert errors.median_pair_deg < 1e-5
    assert errors.registered == errors.expected == 5
    assert len(errors.pairs) == len(errors.pair_deg) == 10
    assert errors.scale_ratio_max < 1e-9
    assert errors.auc[0.1] == pytest.approx(1.0, abs=1e-4)


def test_one_turned_camera_spoils_its_pairs_by_its_angle() -> None:
    truth = random_poses(np.random.default_rng(2), 4)
    turn = Rigid3(rotation_from_rotvec([np.deg2rad(2.0), 0, 0]), np.zeros(3))
    estimated = {**truth, "3.jpg": turn @ truth["3.jpg"]}
    errors = relative_pose_errors(estimated, truth)
    spoilt = np.array(["3.jpg" in pair for pair in errors.pairs])
    np.testing.assert_allclose(errors.rotation_deg[spoilt], 2.0, rtol=1e-6)
    np.testing.assert_allclose(errors.pair_deg[~spoilt], 0.0, atol=1e-5)
    assert np.all(errors.direction_deg[spoilt] <= 2.0 + 1e-9)
    assert errors.auc[1.0] == pytest.approx(0.5)
    assert errors.auc[5.0] == pytest.approx(0.5 + 0.5 * 0.6)


def test_missing_images_count_as_half_a_turn() -> None:
    truth = random_poses(np.random.default_rng(3), 3)
    errors = relative_pose_errors({name: truth[name] for name in ("0.jpg", "2.jpg")}, truth)
    assert sorted(errors.pair_deg)[1:] == [180.0, 180.0]
    assert errors.median_pair_deg == 180.0
    assert (errors.registered, errors.expected) == (2, 3)
    assert np.isnan(errors.scale_ratio_median)


def test_scale_ratio_sees_a_baseline_that_is_too_long() -> None:
    x = np.array([1.0, 0, 0])
    truth = {f"{n}": Rigid3.from_center(np.eye(3), n * x) for n in range(3)}
    estimated = {**truth, "2": Rigid3.from_center(np.eye(3), 2.1 * x)}
    errors = relative_pose_errors(estimated, truth)  # baselines 1, 2.1 / 2, 1.1
    assert errors.scale_ratio_max == pytest.approx(0.05 / 1.05)
    assert errors.median_pair_deg == 0.0


def test_too_few_images_are_refused() -> None:
    pose = Rigid3.identity()
    with pytest.raises(UsageError, match="at least two"):
        relative_pose_errors({}, {"a": pose})
    with pytest.raises(UsageError, match="only 1 image has"):
        align_centers({"a": pose}, {"a": pose, "b": pose})


@pytest.mark.parametrize("places", [[0, 1], [0, 1, 2], [0, 1, 1], [0, 0, 1, 1]])
def test_alignment_is_whole_where_centres_leave_a_turn_open(places: Sequence[int]) -> None:
    """Two images, images on a line and duplicate pictures once left the turn about the line to rounding."""
    rng = np.random.default_rng(6)
    line = random_rotation(rng)[0]
    truth = {f"{n}": Rigid3.from_center(random_rotation(rng), place * line) for n, place in enumerate(places)}
    there = Similarity3(0.25, random_rotation(rng), rng.normal(size=3))
    identity = align_centers(moved(truth, there), truth) @ there
    assert identity.scale == pytest.approx(1)
    np.testing.assert_allclose(identity.rotation, np.eye(3), atol=1e-6)
    np.testing.assert_allclose(identity.translation, 0, atol=1e-6)


def test_centre_errors_are_in_the_unit_of_the_truth() -> None:
    x, y = np.eye(3)[0], np.eye(3)[1]
    truth = {f"{n}": Rigid3.from_center(np.eye(3), c) for n, c in enumerate([-2 * x, 2 * x, -2 * y, 2 * y])}
    wide = {name: Rigid3.from_center(np.eye(3), 10 * pose.center * (1, 1.5, 1)) for name, pose in truth.items()}
    errors = center_errors(wide, truth)
    assert errors.extent == pytest.approx(4)
    scale = 10 * (1 + 1.5) / 10 / 10 / (1 + 1.5**2)  # Σ a·b / Σ a·a
    assert errors.scale == pytest.approx(scale)
    np.testing.assert_allclose(errors.distances, 2 * np.abs(1 - 10 * scale * np.array([1, 1, 1.5, 1.5])), rtol=1e-9)


@pytest.mark.parametrize("which", ["estimated", "true"])
def test_one_place_cannot_be_aligned(which: str) -> None:
    poses = random_poses(np.random.default_rng(7), 3)
    same = dict.fromkeys(poses, poses["0.jpg"])
    with pytest.raises(UsageError, match=f"the {which} centres of all 3 images coincide"):
        align_centers(*((same, poses) if which == "estimated" else (poses, same)))


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e4])
def test_a_picture_that_is_there_twice_has_no_direction_in_any_unit(unit: float) -> None:
    """Rounding of a duplicate's centre once counted as a baseline with a direction of its own."""
    poses = random_poses(np.random.default_rng(8), 3)
    truth = {**poses, "again": Rigid3.from_center(poses["0.jpg"].rotation, poses["0.jpg"].center + 1e-8)}
    aside = np.array([1e-4, -1e-4, 0])
    estimated = {**poses, "again": Rigid3.from_center(poses["0.jpg"].rotation, poses["0.jpg"].center + aside)}
    scaled = moved(truth, Similarity3(unit, np.eye(3), np.zeros(3)))
    assert relative_pose_errors(estimated, scaled).direction_deg.max() < 0.1


def test_pairs_across_groups_cannot_be_measured_and_count_as_not_registered() -> None:
    true = random_poses(np.random.default_rng(8), 5)
    groups = {"0.jpg": 0, "1.jpg": 1, "2.jpg": 0, "3.jpg": 1, "4.jpg": 0}
    # The second group in another unit: nothing tells what its lengths are to the first one's.
    found = {
        name: Rigid3.from_center(pose.rotation, pose.center * (7.0 if groups[name] else 1.0))
        for name, pose in true.items()
    }
    errors = relative_pose_errors(found, true, groups=groups)
    across = np.array([groups[a] != groups[b] for a, b in errors.pairs])
    assert (errors.pair_deg[across] == 180).all()
    assert errors.pair_deg[~across].max() < 1e-4
    assert (errors.registered, errors.in_one_frame, errors.expected) == (5, 3, 5)
    assert errors.scale_ratio_max < 1e-9
    unmoved = relative_pose_errors(true, true, groups=groups)
    assert (unmoved.pair_deg[across] == 180).all()
    assert relative_pose_errors(true, true).in_one_frame == 5


def test_all_pairs_at_once_are_the_pairs_one_by_one() -> None:
    rng = np.random.default_rng(8)
    truth = random_poses(rng, 7)
    names = list(truth)
    noise = {name: Rigid3(rotation_from_rotvec(rng.normal(0, 0.02, 3)), rng.normal(0, 0.1, 3)) for name in names}
    estimated = {name: noise[name] @ truth[name] for name in names if name != names[2]}
    groups = {name: idx % 2 for idx, name in enumerate(estimated)}
    found = relative_pose_errors(estimated, truth, groups=groups)
    for idx, (first, second) in enumerate(found.pairs):
        expected = np.array([180.0, 180.0])
        if first in groups and groups[first] == groups.get(second):
            guess, true = (poses[second] @ poses[first].inverse() for poses in (estimated, truth))
            angle = np.arccos((np.trace(guess.rotation.T @ true.rotation) - 1) / 2)
            cosine = guess.translation @ true.translation
            cosine /= np.linalg.norm(guess.translation) * np.linalg.norm(true.translation)
            expected = np.rad2deg([angle, np.arccos(cosine)])
        np.testing.assert_allclose([found.rotation_deg[idx], found.direction_deg[idx]], expected, atol=1e-5)
    assert (found.registered, found.in_one_frame, found.expected) == (6, 3, 7)
