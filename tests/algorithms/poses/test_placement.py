"""Where an image may stand: true directions of some partners among false ones that weigh more."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
import pytest

from pano_mvs.algorithms.poses.placement.pair_evidence import PairEvidence
from pano_mvs.algorithms.poses.placement.places import agreement, placements
from pano_mvs.geometry import Rigid3, Similarity3, geodesic_angle, rotation_from_rotvec
from tests.algorithms.poses.synthetic_capture import random_rotation

TRUTH = Rigid3.from_center(rotation_from_rotvec([0.3, -1.2, 0.4]), [0.4, -0.1, 0.7])
ORIGINS = np.array([[0.0, 0, 0], [1.5, 0.2, 0.1], [-0.9, -0.1, 1.4], [0.6, 0.3, 2.1], [1.8, 0, 1.5]])


@dataclass
class Says:
    """One geometry of a pair with the image: what partner it is of, and the pose that it has for the image."""

    partner: int
    pose: Rigid3 = TRUTH
    weight: float = 1.0
    length_known: bool = True
    rank: int = 0


def evidence_of(said: list[Says]) -> PairEvidence:
    offsets = np.array([says.pose.center - ORIGINS[says.partner] for says in said]).reshape(-1, 3)
    distances = np.linalg.norm(offsets, axis=1)
    return PairEvidence(
        partner=np.array([says.partner for says in said], np.intp),
        rank=np.array([says.rank for says in said], np.intp),
        weight=np.array([says.weight for says in said]),
        rotations=np.array([says.pose.rotation for says in said]).reshape(-1, 3, 3),
        origins=ORIGINS[[says.partner for says in said]].reshape(-1, 3),
        directions=offsets / distances[:, None],
        lengths=np.where([says.length_known for says in said], distances, np.nan),
        tolerance_rad=np.full(len(said), np.deg2rad(1.5)),
    )


def reordered(evidence: PairEvidence, order: np.ndarray) -> PairEvidence:
    return PairEvidence(*(getattr(evidence, field.name)[order] for field in fields(evidence)))


def elsewhere(by: list[float], *, turn_deg: float = 0.0) -> Rigid3:
    turn = rotation_from_rotvec([0.0, np.deg2rad(turn_deg), 0.0])
    return Rigid3.from_center(turn @ TRUTH.rotation, TRUTH.center + np.array(by))


def assert_same_pose(found: Rigid3, expected: Rigid3, *, size: float = 1.0, rtol: float = 1e-6) -> None:
    assert np.linalg.norm(found.center - expected.center) < rtol * size
    assert geodesic_angle(found.rotation, expected.rotation) < 1e-6


FALSE = elsewhere([1.2, 0.0, -0.3])
# Three partners know the truth; the false geometry of one of them weighs more than all of its true ones together.
OUTVOTED = [Says(0), Says(1), Says(2), Says(3, FALSE, weight=2.5), Says(3, weight=0.4, rank=1)]


def test_what_partners_agree_on_beats_what_one_says_louder() -> None:
    found = placements(evidence_of(OUTVOTED))
    assert_same_pose(found[0].cam_from_world, TRUTH)
    np.testing.assert_array_equal(found[0].explained, [True, True, True, False, True])
    assert found[0].score == pytest.approx(3.4)
    assert_same_pose(found[1].cam_from_world, FALSE)
    np.testing.assert_array_equal(found[1].explained, [False, False, False, True, False])
    assert [place.score for place in found] == sorted((place.score for place in found), reverse=True)


def test_each_partner_has_one_vote() -> None:
    """Of several geometries of one partner that agree only the heaviest counts."""
    repeated = [Says(0, FALSE, rank=rank) for rank in range(4)]
    found = placements(evidence_of([*repeated, Says(1), Says(2)]))
    assert_same_pose(found[0].cam_from_world, TRUTH)
    assert [place.score for place in found] == pytest.approx([2.0, 1.0])
    assert evidence_of([*repeated, Says(1), Says(2, weight=0.3), Says(2, weight=0.7)]).total == pytest.approx(2.7)


@pytest.mark.parametrize("seed", range(3))
def test_the_order_of_the_evidence_does_not_matter(seed: int) -> None:
    evidence = evidence_of([*OUTVOTED, Says(4, length_known=False)])
    order = np.random.default_rng(seed).permutation(len(evidence))
    expected, found = placements(evidence), placements(reordered(evidence, order))
    assert len(found) == len(expected)
    for one, other in zip(expected, found, strict=True):
        assert one.score == pytest.approx(other.score)
        assert_same_pose(other.cam_from_world, one.cam_from_world)
        np.testing.assert_array_equal(other.explained, one.explained[order])


@pytest.mark.parametrize("size", [0.002, 1.0, 500.0])
def test_the_world_may_be_turned_moved_and_scaled(size: float) -> None:
    rng = np.random.default_rng(int(1000 * size))
    moved_from = Similarity3(size, random_rotation(rng), size * 5 * rng.normal(size=3))
    evidence = evidence_of([*OUTVOTED, Says(4, FALSE, length_known=False)])
    moved = replace(
        evidence,
        rotations=evidence.rotations @ moved_from.rotation.T,
        origins=moved_from.apply(evidence.origins),
        directions=evidence.directions @ moved_from.rotation.T,
        lengths=moved_from.scale * evidence.lengths,
    )
    expected, found = placements(evidence), placements(moved)
    assert len(found) == len(expected) >= 2
    for one, other in zip(expected, found, strict=True):
        assert_same_pose(other.cam_from_world, moved_from.move_camera(one.cam_from_world), size=moved_from.scale)
        np.testing.assert_array_equal(other.explained, one.explained)


def test_rays_cross_where_no_length_is_known() -> None:
    found = placements(evidence_of([Says(partner, length_known=False) for partner in range(3)]))
    assert_same_pose(found[0].cam_from_world, TRUTH)
    assert found[0].explained.all()


def test_rays_do_not_cross_behind_a_partner() -> None:
    """Both point away from where their lines meet."""
    evidence = evidence_of([Says(0, length_known=False), Says(1, length_known=False)])
    assert placements(replace(evidence, directions=-evidence.directions)) == []


def test_a_known_length_places_an_image_alone() -> None:
    (found,) = placements(evidence_of([Says(0)]))
    assert_same_pose(found.cam_from_world, TRUTH)


@pytest.mark.parametrize(
    "said",
    [
        pytest.param([], id="no evidence"),
        pytest.param([Says(0, length_known=False)], id="one ray"),
        pytest.param([Says(0, length_known=False), Says(0, FALSE, length_known=False)], id="two rays of one partner"),
    ],
)
def test_nothing_is_placed_by_less_than_a_length_or_two_rays(said: list[Says]) -> None:
    assert placements(evidence_of(said)) == []


def test_directions_that_are_a_little_off_are_averaged() -> None:
    rng = np.random.default_rng(7)
    evidence = evidence_of([Says(partner) for partner in range(5)])
    noisy = evidence.directions + np.deg2rad(0.4) * rng.normal(size=(5, 3))
    noisy /= np.linalg.norm(noisy, axis=1, keepdims=True)
    (found,) = placements(replace(evidence, directions=noisy, lengths=evidence.lengths * rng.uniform(0.95, 1.05, 5)))
    chains = evidence.origins + evidence.lengths[:, None] * noisy
    assert found.explained.all()
    error = np.linalg.norm(found.cam_from_world.center - TRUTH.center)
    assert error < np.linalg.norm(chains - TRUTH.center, axis=1).max()
    assert error < 0.02


@pytest.mark.parametrize(
    ("pose", "agrees"),
    [
        pytest.param(TRUTH, True, id="the truth"),
        pytest.param(elsewhere([0, 0, 0], turn_deg=10), False, id="another rotation"),
        pytest.param(elsewhere([0, 0.3, 0]), False, id="another direction"),
        pytest.param(Rigid3.from_center(TRUTH.rotation, 2 * TRUTH.center), False, id="another distance"),
        pytest.param(Rigid3.from_center(TRUTH.rotation, -TRUTH.center), False, id="the other way"),
        pytest.param(Rigid3.from_center(TRUTH.rotation, ORIGINS[0]), False, id="the very place of the partner"),
    ],
)
def test_a_geometry_agrees_in_rotation_direction_and_distance(pose: Rigid3, agrees: bool) -> None:
    said = evidence_of([Says(0)])
    assert agreement(said, pose.rotation[None], pose.center[None]).tolist() == [[agrees]]


def test_without_a_length_any_distance_along_the_ray_agrees() -> None:
    said = evidence_of([Says(0, length_known=False), Says(0)])
    far = Rigid3.from_center(TRUTH.rotation, 5 * TRUTH.center)
    assert agreement(said, far.rotation[None], far.center[None]).tolist() == [[True, False]]
