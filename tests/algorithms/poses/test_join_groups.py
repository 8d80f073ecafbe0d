"""Groups of images become one by all matches between them, or by a pair and the heights above their floors."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np
import pytest

from pano_mvs.algorithms.matching.brute_force import match_features
from pano_mvs.algorithms.poses.joining.alignment import Alignment, align_models
from pano_mvs.algorithms.poses.joining.cross_matches import CrossMatches
from pano_mvs.algorithms.poses.joining.floors import KnownLengths, height_above_floor, height_over_points
from pano_mvs.algorithms.poses.joining.join_groups import (
    _alignments_with,
    _is_rival,
    _is_significant,
    _Joint,
    _PairEvidence,
)
from pano_mvs.algorithms.poses.placement.pair_evidence import significant_length
from pano_mvs.algorithms.poses.placement.placed_model import PlacedModel, pairs_of
from pano_mvs.algorithms.poses.placement.view_graph import Edge
from pano_mvs.algorithms.poses.scaled_translation import solve_scaled_translation
from pano_mvs.algorithms.two_view import verify_pair
from pano_mvs.algorithms.two_view.verification import pose_near
from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import Rigid3, Similarity3, angle_between, rotation_from_rotvec
from pano_mvs.scene import Features, Poses, TwoView

CENTERS = {
    "a1": (-2.4, 0.0, 0.3),
    "a2": (-1.5, 0.05, -0.8),
    "b1": (2.3, 0.02, -0.4),
    "b2": (1.6, -0.03, 0.9),
}
NOISE_RAD = 3e-4


def room_poses(*, turned: bool = False) -> dict[str, Rigid3]:
    """Return cam_from_world of two cameras in either room, level with any heading, or turned in any way."""
    rng = np.random.default_rng(4)
    poses = {}
    for name, center in CENTERS.items():
        heading = (0.0, rng.uniform(-np.pi, np.pi), 0.0)
        turn = rng.uniform(-1.5, 1.5, 3) if turned else np.zeros(3)
        poses[name] = Rigid3.from_center(rotation_from_rotvec(turn) @ rotation_from_rotvec(heading), np.array(center))
    return poses


def room_features(
    poses: dict[str, Rigid3], *, door: int, own: int = 220, false: int = 0, door_seed: int = 7
) -> dict[str, Features]:
    """Return the key points of all cameras: those of the own room, and some of the other one seen through the door.

    Args:
        poses: cam_from_world by name.
        door: number of points of either room that the cameras of the other room see too.
        own: number of points of each room.
        false: number of key points that match in all images, although they show something else in each.
        door_seed: of the points behind the door and of the descriptors.
    """
    rng = np.random.default_rng(door_seed)
    points = np.concatenate([_room_points(rng, -2.0, own), _room_points(rng, 2.0, own)])
    through = np.concatenate([_door_points(rng, -3.0, door), _door_points(rng, 3.0, door)])
    descriptors = rng.integers(0, 120, (len(points) + len(through) + false, 64)).astype(np.float32)
    features = {}
    for name, pose in poses.items():
        mine = np.arange(own) + (0 if name[0] == "a" else own)
        seen = np.concatenate([mine, 2 * own + np.arange(len(through) + false)])
        elsewhere = rng.normal(size=(false, 3)) * (1.0, 0.3, 1.0)
        rays = pose.apply(np.concatenate([points, through, elsewhere + pose.center])[seen])
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        rays += rng.normal(0, NOISE_RAD, rays.shape)
        features[name] = Features(
            bearings=rays / np.linalg.norm(rays, axis=1, keepdims=True),
            descriptors=descriptors[seen] + rng.integers(-4, 5, (len(seen), 64)).astype(np.float32),
            sizes_rad=np.full(len(seen), 0.02, np.float32),
            scores=np.linspace(1, 0.1, len(seen), dtype=np.float32),
            colors_rgb=np.full((len(seen), 3), 128, np.uint8),
            metric="l2",
            size_hw=(512, 1024),
        )
    return features


def with_points_of_pairs(
    features: dict[str, Features],
    poses: dict[str, Rigid3],
    pairs: Iterable[tuple[str, str]],
    *,
    count: int,
    floor: int = 0,
) -> dict[str, Features]:
    """Return features with `count` more points for each of some pairs, which no other camera sees.

    They are near the door, but for `floor` of them.
    """
    rng = np.random.default_rng(5)
    found = dict(features)
    for pair in pairs:
        points = np.concatenate([_door_points(rng, x, count // 2) for x in (-3.0, 3.0)])
        points[:floor] = rng.uniform((-1.5, 1.3, -0.6), (1.5, 1.3, 0.6), (floor, 3))
        descriptors = rng.integers(0, 120, (count, 64)).astype(np.float32)
        for name in pair:
            rays = poses[name].apply(points)
            rays /= np.linalg.norm(rays, axis=1, keepdims=True)
            rays += rng.normal(0, NOISE_RAD, rays.shape)
            added = {"bearings": rays / np.linalg.norm(rays, axis=1, keepdims=True), "descriptors": descriptors}
            own = found[name]
            arrays: dict[str, Any] = {
                key: np.concatenate([getattr(own, key), added.get(key, getattr(own, key)[:count])])
                for key in ("bearings", "descriptors", "sizes_rad", "scores", "colors_rgb")
            }
            found[name] = replace(own, **arrays)
    return found


def matched(features: dict[str, Features]) -> dict[tuple[str, str], TwoView]:
    """Return all pairs of the capture."""
    return {
        (a, b): verify_pair(
            features[a], features[b], match_features(features[a], features[b]), rng=np.random.default_rng(1)
        )
        for a, b in combinations(features, 2)
    }


def _room_points(rng: np.random.Generator, middle: float, count: int) -> FloatArray:
    points = rng.uniform(-1, 1, (count, 3))
    side = rng.integers(3, size=count)
    points[np.arange(count), side] = np.sign(points[np.arange(count), side])
    return np.asarray(points * (1.9, 1.3, 2.0) + (middle, 0, 0))


def _door_points(rng: np.random.Generator, x: float, count: int) -> FloatArray:
    points: FloatArray = rng.uniform(-1, 1, (count, 3)) * (0.8, 0.9, 0.5) + (x, 0.1, 0.0)
    return points


def _solved(features: dict[str, Features]) -> Poses:
    return solve_scaled_translation(features, matched(features), rng=np.random.default_rng(0))


def _errors(poses: Poses, truth: dict[str, Rigid3]) -> tuple[float, float]:
    """Return the largest error of a relative rotation in degrees, and of a centre relative to the first two."""
    first = poses.names[0]
    placed = {name: poses.cam_from_world(idx) for idx, name in enumerate(poses.names)}
    turns = [
        (placed[name].rotation @ placed[first].rotation.T) @ (truth[name].rotation @ truth[first].rotation.T).T
        for name in poses.names
    ]
    angles = [float(np.rad2deg(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1)))) for turn in turns]
    centers, true = (np.array([one[name].center for name in poses.names]) for one in (placed, truth))
    own = (centers - centers[0]) @ placed[first].rotation.T
    other = (true - true[0]) @ truth[first].rotation.T
    scale = np.linalg.norm(other[1]) / np.linalg.norm(own[1])
    return max(angles), float(np.linalg.norm(scale * own - other, axis=1).max())


@pytest.mark.parametrize("turned", [pytest.param(False, marks=pytest.mark.slow), True])
def test_rooms_are_joined_by_the_matches_of_all_their_pairs(turned: bool) -> None:
    truth = room_poses(turned=turned)
    features = room_features(truth, door=8, false=60)
    views = matched(features)
    assert sum(bool(view) for pair, view in views.items() if pair[0][0] != pair[1][0]) < 2
    poses = _solved(features)
    assert len(poses.names) == 4
    assert len(poses.worlds) == 1
    turn_deg, off = _errors(poses, truth)
    assert turn_deg < 0.5
    assert off < 0.1


@pytest.mark.slow
def test_a_pair_that_only_lacks_a_direction_has_no_vote() -> None:
    """Such as of distant scenery: it is as significant as a verified one, but its direction is noise."""
    truth = room_poses(turned=True)
    features = with_points_of_pairs(room_features(truth, door=8, false=60), truth, [("a1", "b1")], count=60)
    views = matched(features)
    known = views["a1", "b1"]
    wrong = replace(known, direction=rotation_from_rotvec(np.array([0.3, 0.3, 0.3])) @ known.direction)
    failed = TwoView.failed("its direction is open", candidates=known.candidates)
    views["a1", "b1"] = replace(failed, log10_false_alarms=known.log10_false_alarms).with_alternatives([wrong])
    assert known.log10_false_alarms < -20
    poses = solve_scaled_translation(features, views, rng=np.random.default_rng(0))
    assert len(poses.worlds) == 1
    assert _errors(poses, truth)[1] < 0.1


def test_unrelated_places_stay_two_groups() -> None:
    features = room_features(room_poses(), door=0)
    poses = _solved(features)
    assert len(poses.names) == 4
    assert len(poses.worlds) == 2


@pytest.mark.slow
def test_rooms_that_fit_in_two_places_stay_two_groups() -> None:
    """Every point behind the door is seen twice: where it is, and where an equal room would have it."""
    truth = room_poses(turned=True)
    shifted = {
        name: Rigid3.from_center(pose.rotation, pose.center + np.array([0.0, 0.0, 1.1 * (name[0] == "b")]))
        for name, pose in truth.items()
    }
    own, door = 220, 8
    here = room_features(truth, door=door, own=own, false=60)
    there = room_features(shifted, door=door, own=own, door_seed=8)
    both = {name: _stacked(here[name], there[name], slice(own, own + 2 * door)) for name in truth}
    assert len(_solved(here).worlds) == 1
    assert len(_solved(both).worlds) == 2


@pytest.mark.slow
@pytest.mark.parametrize(("pairs", "groups"), [([("a1", "b1")], 2), ([("a1", "b1"), ("a2", "b2")], 1)])
def test_learned_pairs_that_are_weak_by_themselves_add_up(pairs: list[tuple[str, str]], groups: int) -> None:
    truth = room_poses()
    features = with_points_of_pairs(room_features(truth, door=1), truth, pairs, count=80)
    tilted = (0.0, -float(np.cos(0.045)), float(np.sin(0.045)))  # as the lines of the second room have it
    learned = {
        name: replace(one, learned=len(one), ups=(tilted,) if name[0] == "b" else one.ups)
        for name, one in features.items()
    }
    views = matched(learned)
    assert not any(views[pair] for pair in pairs)
    poses = solve_scaled_translation(learned, views, rng=np.random.default_rng(0))
    assert len(poses.worlds) == groups
    if groups == 1:
        turn_deg, off = _errors(poses, truth)
        assert turn_deg < 0.1
        assert off < 0.03


@pytest.mark.parametrize(
    ("alarms", "agreeing", "disagreeing", "significant"),
    [
        (-44, 1.2, 1.7, True),
        (-12, 1.1, 1.7, False),
        (-44, 0.0, 5.0, False),
        (-9, 0.9, 0.0, False),
        (-60, 0.5, 0.0, True),
    ],
)
def test_an_alignment_outweighs_the_pairs_that_contradict_it(
    alarms: float, agreeing: float, disagreeing: float, significant: bool
) -> None:
    evidence = _PairEvidence({(0, 1): agreeing}, disagreeing, has_length=True)
    assert _is_significant(_alignment(alarms), evidence, learned=False) == significant
    enough = agreeing >= max(1, disagreeing)
    assert _is_significant(_alignment(alarms), evidence, learned=True) == (significant and enough)


@pytest.mark.parametrize(
    ("best", "rival", "is_rival"),
    [
        ({(0, 1): 0.5}, {}, True),
        ({(0, 1): 3.0}, {}, False),
        ({(0, 1): 3.0}, {(0, 2): 2.0}, True),
        ({(0, 1): 3.0}, {(0, 1): 2.5}, True),  # only matches distinguish them
        ({(0, 1): 3.0, (0, 2): 1.0}, {(0, 1): 3.0}, False),
        ({(0, 1): 0.5}, {(0, 2): 1.5}, True),
    ],
)
def test_pairs_decide_between_alignments_that_as_many_matches_support(
    best: dict[Edge, float], rival: dict[Edge, float], is_rival: bool
) -> None:
    one, other = (_PairEvidence(agreeing, 0.0, has_length=True) for agreeing in (best, rival))
    ray = np.array([0.0, 0.0, 1.0])
    matches = CrossMatches(
        cameras=np.zeros((8, 2), np.intp),
        centers=np.tile(ray - ray, (8, 2, 1)),
        rays=np.tile(ray, (8, 2, 1)),
        ranges=np.ones((8, 2)),
    )
    assert _is_rival(_Joint(_alignment(-30.0), one, False), _Joint(_alignment(-4.0), other, False), matches) == is_rival


def _alignment(log10_false_alarms: float) -> Alignment:
    """Return an alignment of two worlds with the same axes, a unit apart, without matches that agree."""
    return Alignment(
        Similarity3(1.0, np.eye(3), np.array([0.0, 0.0, -1.0])),
        inliers=np.zeros(8, np.bool_),
        log10_false_alarms=log10_false_alarms,
        rotation_std_deg=0.1,
        offset_std_deg=0.1,
        scale_std=0.01,
    )


def _stacked(first: Features, second: Features, door: slice) -> Features:
    """Return the key points of the first image, and those behind the door of the second one."""
    names = "bearings", "descriptors", "sizes_rad", "scores", "colors_rgb"
    arrays: dict[str, Any] = {
        name: np.concatenate([getattr(first, name), getattr(second, name)[door]]) for name in names
    }
    return replace(first, **arrays)


def test_a_length_is_more_than_chance_if_ranges_agree() -> None:
    rng = np.random.default_rng(2)
    points = rng.normal(size=(30, 3)) * (4, 1, 4)
    pose = Rigid3(np.eye(3), np.array([0.6, 0.0, 0.8]))
    moved = points + 2.5 * pose.translation
    p, q = (rays / np.linalg.norm(rays, axis=1, keepdims=True) for rays in (points, moved))
    ranges = np.linalg.norm(points, axis=1)
    length, alarms = significant_length(pose, p, q, known_ranges=ranges, rng=rng)
    assert length == pytest.approx(2.5, rel=1e-6)
    assert alarms < -5
    assert significant_length(pose, p, q, known_ranges=rng.permutation(ranges), rng=rng)[1] > -1
    assert significant_length(pose, p, q, known_ranges=np.full(30, np.nan), rng=rng)[1] == np.inf


def _unit(vectors: np.ndarray) -> np.ndarray:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def _drawn(count: int = 60, noise: float = 0.02) -> tuple[Similarity3, CrossMatches]:
    rng = np.random.default_rng(8)
    similarity = Similarity3(1.7, rotation_from_rotvec(rng.normal(size=3)), rng.normal(size=3))
    centers = rng.normal(size=(count, 2, 3))
    second = 4 * rng.normal(size=(count, 3))
    offsets = np.stack([similarity.apply(second) - centers[:, 0], second - centers[:, 1]], axis=1)
    rays = _unit(offsets + rng.normal(0, noise, offsets.shape))
    ranges = np.linalg.norm(offsets, axis=2)
    ranges[::3, 0] = np.nan
    ranges[::4, 1] = np.nan
    return similarity, CrossMatches(np.zeros((count, 2), np.intp), centers, rays, ranges)


def _plain_error(similarity: Similarity3, matches: CrossMatches, idx: int) -> float:
    """The errors of one match, as the docstring states them."""
    (c, d), (u, v), (r, s) = matches.centers[idx], matches.rays[idx], matches.ranges[idx]
    angles = []
    if np.isfinite(r):
        angles.append(float(angle_between(similarity.inverse().apply((c + r * u)[None])[0] - d, v)))
    if np.isfinite(s):
        angles.append(float(angle_between(similarity.apply((d + s * v)[None])[0] - c, u)))
    if angles:
        return max(angles)
    baseline, turned = _unit(similarity.apply(d[None])[0] - c), similarity.rotation @ v
    e = float(np.cross(u, turned) @ baseline)
    squares = np.sum(np.cross(baseline, u) ** 2) + np.sum(np.cross(baseline, turned) ** 2) - 2 * e**2
    return float(abs(e) / np.sqrt(squares))


@pytest.mark.kernel("poses.joining.kernels_alignment")
def test_errors_are_those_of_plain_geometry() -> None:
    similarity, matches = _drawn()
    plain = np.array([_plain_error(similarity, matches, idx) for idx in range(len(matches))])
    assert np.isnan(matches.ranges).all(axis=1).any()
    errors, residuals = matches.errors(similarity)
    np.testing.assert_allclose(errors, plain, rtol=1e-6, atol=1e-9)
    unknown = np.isnan(matches.ranges)
    assert (residuals[unknown[:, 0], :3] == 0).all()
    assert (residuals[unknown[:, 1], 3:6] == 0).all()
    alone = unknown.all(axis=1)
    np.testing.assert_allclose(np.abs(residuals[alone, 6]), errors[alone])


def _models(features: dict[str, Features], truth: dict[str, Rigid3], *, unit: float) -> list[PlacedModel]:
    """Both rooms with true poses and ranges, the second one in another unit."""
    found = []
    for number, room in enumerate("ab"):
        model = PlacedModel(pairs_of(features, {}))
        scale = unit if number else 1.0
        for image, name in enumerate(features):
            if name[0] == room:
                model.cameras[image] = Rigid3.from_center(truth[name].rotation, truth[name].center * scale)
                # Of points on the walls of a box, which room_features draws around (±2, 0, 0).
                rays = features[name].bearings @ truth[name].rotation
                middle = np.array([-2.0 if room == "a" else 2.0, 0.0, 0.0])
                reach = (np.sign(rays) * (1.9, 1.3, 2.0) + middle - truth[name].center) / rays
                model.known_ranges(image)[:] = scale * reach.min(axis=1)
        found.append(model)
    return found


@pytest.mark.slow
@pytest.mark.parametrize(("floor", "groups"), [(100, 1), (0, 2)])
def test_a_pair_that_sees_the_floor_joins_two_rooms(floor: int, groups: int) -> None:
    """It has no point with a known range."""
    truth = room_poses()
    features = with_points_of_pairs(
        room_features(truth, door=0, own=600), truth, [("a1", "b1")], count=240, floor=floor
    )
    poses = _solved({name: replace(one, learned=len(one)) for name, one in features.items()})
    assert len(poses.names) == 4
    assert len(poses.worlds) == groups
    if groups == 1:
        placed = {name: poses.cam_from_world(idx) for idx, name in enumerate(poses.names)}
        ratios = [
            float(
                np.linalg.norm(placed[a].center - placed[b].center) / np.linalg.norm(truth[a].center - truth[b].center)
            )
            for a, b in (("a1", "a2"), ("b1", "b2"), ("a1", "b1"))
        ]
        assert max(ratios) < 1.1 * min(ratios)


def test_heights_above_the_floor_give_the_ratio_of_the_units() -> None:
    truth = room_poses()
    first, second = (
        height_above_floor(model) for model in _models(room_features(truth, door=0, own=600), truth, unit=3.0)
    )
    assert first == pytest.approx(1.3, rel=0.05)
    assert second == pytest.approx(3 * first, rel=0.05)


def test_cameras_that_are_turned_or_at_different_heights_have_none() -> None:
    turned = room_poses(turned=True)
    assert height_above_floor(_models(room_features(turned, door=0, own=600), turned, unit=1.0)[0]) == 0
    truth = room_poses()
    raised = {
        name: replace(pose, translation=pose.translation - pose.rotation @ np.array([0.0, 0.4 * (name == "a2"), 0.0]))
        for name, pose in truth.items()
    }
    assert height_above_floor(_models(room_features(raised, door=0, own=600), raised, unit=1.0)[0]) == 0
    assert height_above_floor(_models(room_features(truth, door=0, own=10), truth, unit=1.0)[0]) == 0


@pytest.mark.parametrize(
    ("raised", "known"),
    [
        ([0.0] * 10, True),
        ([0.0] * 8 + [0.12, 0.18], True),  # by the slope between joined models
        ([0.0] * 9 + [0.3], False),  # on a platform
        ([0.0] * 9 + [2.0], False),  # on another storey
        ([0.0] * 5 + [0.12] * 5, False),
    ],
)
def test_a_few_cameras_may_be_placed_less_exactly(raised: list[float], known: bool) -> None:
    """They are raised by shares of the height of most cameras."""
    rng = np.random.default_rng(3)
    floor = np.column_stack([rng.uniform(-4, 4, 500), rng.normal(1.5, 0.01, 500), rng.uniform(-4, 4, 500)])
    cameras = [
        Rigid3.from_center(np.eye(3), np.array([0.5 * idx - 2, -1.5 * share, 0.1])) for idx, share in enumerate(raised)
    ]
    height = height_over_points(floor, cameras, [np.array([0.0, -1.0, 0.0])] * len(cameras))
    assert height == (pytest.approx(1.5, rel=0.03) if known else 0.0)


def test_alignments_of_parts_are_those_of_the_joined_model() -> None:
    rng = np.random.default_rng(8)
    worlds = [
        Similarity3(scale, rotation_from_rotvec(rng.uniform(-1, 1, 3)), rng.uniform(-2, 2, 3))
        for scale in (1.0, 2.0, 0.5, 3.0, 0.7, 1.2, 0.8, 1.5)
    ]
    joints = {
        (a, b): _Joint(
            replace(_alignment(-40), first_from_second=worlds[a].inverse() @ worlds[b]),
            _PairEvidence({}, 0.0, has_length=True),
            False,
        )
        for a, b in ((0, 1), (0, 2), (3, 1), (1, 5), (6, 0), (0, 7), (7, 1))
    }
    point = np.array([[0.3, -0.2, 1.4]])
    for third, sizes, count in (
        (2, (3, 3), 1),
        (3, (3, 3), 1),
        (4, (3, 3), 0),
        (5, (3, 3), 1),
        (6, (3, 3), 1),
        (7, (3, 3), 2),
        (7, (3, 1), 1),  # a single camera says nothing of the scale
        (2, (1, 3), 0),
    ):
        found = list(_alignments_with(third, (0, 1), joints, sizes=sizes))
        assert len(found) == count
        for each in found:
            np.testing.assert_allclose(worlds[0].apply(each.apply(point)), worlds[third].apply(point), atol=1e-9)


def test_a_start_is_refined_without_any_pair_that_suggests_it() -> None:
    similarity, matches = _drawn(200, noise=1e-3)
    assert align_models(matches, hypotheses={}, known=KnownLengths(), has_scale=True) == []
    off = Similarity3(1.002, rotation_from_rotvec(np.array([0.002, -0.001, 0.001])), np.array([0.005, 0.0, -0.004]))
    (found,) = align_models(matches, hypotheses={}, starts=[off @ similarity], known=KnownLengths(), has_scale=True)
    assert found.first_from_second.scale == pytest.approx(similarity.scale, rel=2e-4)
    np.testing.assert_allclose(found.first_from_second.rotation, similarity.rotation, atol=5e-4)
    np.testing.assert_allclose(found.first_from_second.translation, similarity.translation, atol=2e-3)


@pytest.mark.parametrize("factor", [0.7, 1.03])
def test_a_start_gets_the_scale_that_is_known(factor: float) -> None:
    similarity, matches = _drawn(200, noise=1e-3)
    start = replace(similarity, scale=factor * similarity.scale)
    known = KnownLengths(scale=similarity.scale)
    (found,) = align_models(matches, hypotheses={}, starts=[start], known=known, has_scale=True)
    assert found.first_from_second.scale == similarity.scale
    np.testing.assert_allclose(found.first_from_second.translation, similarity.translation, atol=2e-3)


@pytest.mark.slow
def test_no_model_is_lost_where_joined_ones_share_no_pair() -> None:
    """Two pairs of rooms, between which no images were compared."""
    truth = room_poses()
    near = room_features(truth, door=8, false=60)
    features = {**{f"x{name}": one for name, one in near.items()}, **{f"y{name}": one for name, one in near.items()}}
    views = {(side + a, side + b): view for side in "xy" for (a, b), view in matched(near).items()}
    poses = solve_scaled_translation(features, views, rng=np.random.default_rng(0))
    assert sorted(poses.names) == sorted(features)
    assert len(poses.worlds) == 2


def test_a_pair_from_one_place_has_no_vote() -> None:
    """A rotation explains all its matches, so they agree with any direction."""
    rng = np.random.default_rng(3)
    rays = rng.normal(size=(120, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    turn = rotation_from_rotvec(np.array([0.0, 0.5, 0.0]))
    first, second = (
        replace(next(iter(room_features(room_poses(), door=0, own=120).values())), bearings=one)
        for one in (rays, rays @ turn.T)
    )
    matches = np.repeat(np.arange(120, dtype=np.int32)[:, None], 2, axis=1)
    assert pose_near(first, second, matches, pose=Rigid3(turn, np.array([1.0, 0.0, 0.0]))) is None
