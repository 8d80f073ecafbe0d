"""What the pairs of an image say about its pose: directions, lengths, weights, whichever way a pair is stored."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pano_mvs.algorithms.poses.placement.pair_evidence import (
    PairEvidence,
    gather_pair_evidence,
    geometries_of,
    oriented,
)
from pano_mvs.algorithms.poses.placement.placed_model import PlacedModel, pairs_of
from pano_mvs.algorithms.poses.placement.view_graph import consistent_edges
from pano_mvs.geometry import Rigid3, angle_between, rotation_from_rotvec
from pano_mvs.scene import TwoView
from tests.algorithms.poses.aliased_capture import aliased_capture, same_matches, view_of
from tests.algorithms.poses.synthetic_capture import noisy_bearings, points_in_box, random_rotation

RNG = np.random.default_rng(31)
POINTS = points_in_box(RNG, 120)
FIRST = Rigid3.from_center(random_rotation(RNG), [0.2, 0.0, -0.3])
SECOND = Rigid3.from_center(random_rotation(RNG), [-0.4, 0.2, 0.5])
BEARINGS = [noisy_bearings(RNG, pose, POINTS, noise_deg=0.02) for pose in (FIRST, SECOND)]
RANGES = [np.linalg.norm(POINTS - pose.center, axis=1) for pose in (FIRST, SECOND)]
BASELINE = float(np.linalg.norm(FIRST.center - SECOND.center))
NOTHING_KNOWN = [np.full(len(POINTS), np.nan)] * 2
TRUE = view_of(SECOND @ FIRST.inverse(), same_matches(len(POINTS)))


def gathered(view: TwoView = TRUE, *, image: int = 1, ranges: list[np.ndarray] = RANGES) -> PairEvidence:
    """Return what the pair says about one of the two images, the other being registered where it truly stands."""
    partner = 1 - image
    return gather_pair_evidence(
        image,
        [partner],
        geometries={(0, 1): geometries_of(view, *BEARINGS)},
        cameras={partner: (FIRST, SECOND)[partner]},
        ranges={partner: ranges[partner]},
    )


def test_oriented_turns_a_pair_round_and_back() -> None:
    matches = np.array([[3, 7], [4, 1]], np.int32)
    view = view_of(SECOND @ FIRST.inverse(), matches)
    there, as_stored = oriented(view, 0, 1)
    back, turned = oriented(view, 1, 0)
    np.testing.assert_array_equal(as_stored, matches)
    np.testing.assert_array_equal(turned, [[7, 3], [1, 4]])
    np.testing.assert_allclose((back @ there).rotation, np.eye(3), atol=1e-12)
    np.testing.assert_allclose((back @ there).translation, 0, atol=1e-12)
    assert np.linalg.norm(back.translation) == pytest.approx(1.0)


def test_a_pair_that_is_stored_the_other_way_round_says_the_same() -> None:
    """Its runner-ups are turned round with it."""
    other = Rigid3(rotation_from_rotvec([0.1, 0.7, 0.2]), np.array([0.0, 0.6, 0.8]))
    matches = np.stack([np.arange(40), np.arange(40)[::-1]], axis=1).astype(np.int32)
    there = TRUE.with_alternatives([view_of(other, matches)])
    back = view_of(FIRST @ SECOND.inverse(), TRUE.matches_idx[:, ::-1]).with_alternatives(
        [view_of(other.inverse(), matches[:, ::-1])]
    )
    stored, turned = (
        consistent_edges(("a", "b"), {pair: view})[0, 1] for pair, view in ((("a", "b"), there), (("b", "a"), back))
    )
    assert len(stored.alternatives) == len(turned.alternatives) == 1
    for one, same in zip((stored, *stored.alternatives), (turned, *turned.alternatives), strict=True):
        np.testing.assert_allclose(same.rotation, one.rotation, atol=1e-12)
        np.testing.assert_allclose(same.direction, one.direction, atol=1e-12)
        np.testing.assert_array_equal(same.matches_idx, one.matches_idx)


@pytest.mark.parametrize("image", [0, 1])
def test_pair_evidence_has_pose_and_length_of_the_image(image: int) -> None:
    pose = (FIRST, SECOND)[image]
    says = gathered(image=image)
    assert says.partner.tolist() == [1 - image]
    assert says.lengths[0] == pytest.approx(BASELINE, rel=0.01)
    np.testing.assert_allclose(says.rotations[0], pose.rotation, atol=1e-9)
    np.testing.assert_allclose(says.origins[0] + BASELINE * says.directions[0], pose.center, atol=1e-9)


def test_lengths_are_in_the_unit_of_the_known_ranges() -> None:
    tripled = [3 * known for known in RANGES]
    assert gathered(ranges=tripled).lengths[0] == pytest.approx(3 * gathered().lengths[0])


def test_wrong_ranges_among_the_known_do_not_change_a_length() -> None:
    spoiled = [known.copy() for known in RANGES]
    spoiled[0][::4] *= np.random.default_rng(3).uniform(2, 9, len(spoiled[0][::4]))
    assert gathered(ranges=spoiled).lengths[0] == pytest.approx(BASELINE, rel=0.03)


def test_too_few_known_ranges_give_no_length() -> None:
    few = [known.copy() for known in RANGES]
    few[0][2:] = np.nan
    assert np.isnan(gathered(ranges=few).lengths).all()
    assert np.isnan(gathered(ranges=NOTHING_KNOWN).lengths).all()


def test_ranges_that_agree_on_nothing_give_no_length() -> None:
    scattered = [np.exp(np.random.default_rng(4).uniform(-3, 3, len(POINTS)))] * 2
    assert np.isnan(gathered(ranges=scattered).lengths).all()


def test_every_geometry_of_a_pair_is_evidence_the_heaviest_first() -> None:
    feigned = view_of(Rigid3(TRUE.rotation, np.array([1.0, 0.0, 0.0])), same_matches(30))
    says = gathered(TRUE.with_alternatives([feigned]))
    assert says.rank.tolist() == [0, 1]
    assert says.weight[0] > says.weight[1] > 0
    assert says.total == says.weight[0]


def test_weight_grows_with_matches_but_much_slower() -> None:
    counts = (15, 30, 60, 110)
    weights = [
        geometries_of(view_of(SECOND @ FIRST.inverse(), same_matches(count)), *BEARINGS)[0].weight for count in counts
    ]
    assert weights == sorted(weights)
    assert weights[-1] < weights[0] * counts[-1] / counts[0] / 2


def test_parallax_is_the_angle_between_rays_after_derotation() -> None:
    (geometry,) = geometries_of(TRUE, *BEARINGS)
    turned = np.array([FIRST.rotation.T, SECOND.rotation.T])
    in_world = [rays @ turn.T for rays, turn in zip(BEARINGS, turned, strict=True)]
    assert geometry.parallax_deg == pytest.approx(np.rad2deg(np.median(angle_between(*in_world))))
    empty = replace(TRUE, matches_idx=np.zeros((0, 2), np.int32), residuals_rad=np.zeros(0, np.float32))
    assert geometries_of(empty, *BEARINGS)[0].parallax_deg == 0


def test_no_partner_is_no_evidence() -> None:
    says = gather_pair_evidence(0, [], geometries={}, cameras={}, ranges={})
    assert len(says) == 0
    assert says.total == 0
    assert says.rotations.shape == (0, 3, 3)


def test_a_model_asks_only_registered_partners() -> None:
    capture = aliased_capture("witnesses", false={})
    model = PlacedModel(pairs_of(capture.features, capture.two_views))
    for image in (0, 2):
        model.cameras[image] = capture.poses[capture.names[image]]
    assert set(model.evidence(1).partner.tolist()) == {0, 2}
    assert model.evidence(1, [2]).partner.tolist() == [2]
