"""Groups that see each other through a door are joined by their true similarity, and others stay apart."""

from __future__ import annotations

import numpy as np
import pytest

from pano_mvs.algorithms.poses.joining.bridges import find_bridges, is_linked
from pano_mvs.algorithms.poses.scaled_translation import solve_scaled_translation
from pano_mvs.geometry import Rigid3, angle_between, geodesic_angle
from pano_mvs.scene import Features, TwoView
from tests.algorithms.poses.joining.two_rooms import room_features, room_poses, verified_inside
from tests.benchmarks.poses.placements import judge_placements


def _errors_deg(view: TwoView, first: Rigid3, second: Rigid3) -> tuple[float, float]:
    relative = second @ first.inverse()
    direction = relative.translation / np.linalg.norm(relative.translation)
    return (
        float(np.rad2deg(geodesic_angle(view.rotation, relative.rotation))),
        float(np.rad2deg(angle_between(view.direction, direction))),
    )


@pytest.mark.slow
@pytest.mark.parametrize("turned", [False, True])
def test_joins_two_rooms_by_what_the_door_shows(turned: bool) -> None:
    poses = room_poses(turned=turned)
    features = room_features(poses, door=30)
    found = find_bridges(features, verified_inside(features), rng=np.random.default_rng(0))
    assert found.groups == (2, 1)
    assert len(found.bridges) == 1
    assert {*found.two_views} <= {("a1", "b1"), ("a1", "b2"), ("a2", "b1"), ("a2", "b2")}
    assert found.two_views
    for (a, b), view in found.two_views.items():
        view.check()
        assert max(_errors_deg(view, poses[a], poses[b])) < 0.5


@pytest.mark.slow
def test_the_solver_puts_both_rooms_into_one_frame() -> None:
    poses = room_poses()
    features = room_features(poses, door=30)
    inside = verified_inside(features)
    apart = solve_scaled_translation(features, inside, rng=np.random.default_rng(0))
    assert len(apart.worlds) == 2
    bridged = find_bridges(features, inside, rng=np.random.default_rng(0)).two_views
    joined = solve_scaled_translation(features, {**inside, **bridged}, rng=np.random.default_rng(0))
    assert len(joined.worlds) == 1
    judged = judge_placements(joined, poses)
    assert judged.right.all()
    assert len(judged.names) == 4


def test_rooms_that_share_nothing_stay_apart() -> None:
    features = room_features(room_poses(), door=0)
    found = find_bridges(features, verified_inside(features), rng=np.random.default_rng(0))
    assert found.groups == (2, 2)
    assert found.two_views == {}


@pytest.mark.slow
def test_a_few_common_points_are_not_enough() -> None:
    features = room_features(room_poses(), door=3)
    found = find_bridges(features, verified_inside(features), rng=np.random.default_rng(0))
    assert found.two_views == {}


def test_nothing_is_matched_if_the_pairs_connect_all_images(monkeypatch: pytest.MonkeyPatch) -> None:
    features: dict[str, Features] = {
        name: one for name, one in room_features(room_poses(), door=60).items() if name[0] == "a"
    }
    two_views = verified_inside(features)
    assert is_linked(tuple(features), two_views)
    monkeypatch.setattr("pano_mvs.algorithms.poses.joining.bridges.local_models", lambda *_: pytest.fail("examined"))
    assert find_bridges(features, two_views, rng=np.random.default_rng(0)).groups == (1, 1)


def test_two_pairs_of_an_image_without_common_key_points_do_not_link() -> None:
    def view(first: range, second: range) -> TwoView:
        matches = np.stack([np.array(first), np.array(second)], axis=1).astype(np.int32)
        return TwoView(matches, np.eye(3), np.array([1.0, 0, 0]), np.zeros(len(matches), np.float32), "general")

    forty, others = range(40), range(100, 140)
    assert is_linked(("a", "b", "c"), {("a", "b"): view(forty, forty), ("b", "c"): view(forty, forty)})
    assert not is_linked(("a", "b", "c"), {("a", "b"): view(forty, forty), ("b", "c"): view(others, forty)})
    assert not is_linked(("a", "b", "c"), {("a", "b"): view(forty, forty)})
