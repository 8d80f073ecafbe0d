"""Views that the others contradict: exact ranges and moved cameras, and the rule on figures."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from pano_mvs.algorithms.filters.consistency import Agreement, checked_with_agreement, nearest_views, view_doubts
from pano_mvs.geometry import Rigid3
from pano_mvs.scene import RangeMap
from pano_mvs.testing.room import capture_poses, default_room
from tests.algorithms.range_scenes import as_map, room_range

SIZE = (32, 64)
LIMITS: dict[str, Any] = {
    "max_relative_error": 0.02,
    "max_reprojection_px": 1.0,
    "min_support": 0.85,
    "min_motion_px": 0.01,
    "min_views": 1,
    "remove_inconsistent": False,
    "min_contradictions": 2,
}
POSES = capture_poses(5, seed=2, spread=0.5)
GOOD = Agreement(compared=0.9, agreed=0.5, seen_through=0.1, hidden=0.1)
WRONG = Agreement(compared=0.9, agreed=0.2, seen_through=0.5, hidden=0.1)


@pytest.fixture(scope="module")
def true_maps() -> list[RangeMap]:
    room = default_room()
    return [as_map(room_range(room, pose, SIZE)) for pose in POSES]


def agreement_of(maps: list[RangeMap], poses: list[Rigid3], view: int) -> Agreement:
    others = [idx for idx in range(len(poses)) if idx != view]
    return checked_with_agreement(
        maps[view], poses[view], [maps[idx] for idx in others], source_poses=[poses[idx] for idx in others], **LIMITS
    )[1]


def line(agreements: list[Agreement]) -> tuple[dict[str, Agreement], dict[str, np.ndarray]]:
    names = [f"{idx}.jpg" for idx in range(len(agreements))]
    return dict(zip(names, agreements, strict=True)), {
        name: np.array([idx, 0.0, 0.0]) for idx, name in enumerate(names)
    }


@pytest.mark.parametrize(("factor", "figure"), [(0.7, "seen_through"), (1.4, "hidden")])
def test_ranges_that_are_too_short_are_seen_through_and_too_long_ones_hidden(
    true_maps: list[RangeMap], factor: float, figure: str
) -> None:
    wrong = [as_map(true_maps[0].range * factor), *true_maps[1:]]
    found = agreement_of(wrong, POSES, 0)
    assert getattr(found, figure) > 0.8
    assert found.agreed + found.one_way <= 1 + 1e-9


def test_filled_ranges_and_ranges_that_nobody_sees_are_not_compared(true_maps: list[RangeMap]) -> None:
    half = true_maps[0].confidence.copy()
    half[: SIZE[0] // 2] = 10
    found = agreement_of([RangeMap(true_maps[0].range, half), *true_maps[1:]], POSES, 0)
    assert found.compared == pytest.approx(0.5, abs=0.01)
    assert agreement_of(true_maps[:1], POSES[:1], 0) == Agreement(0.0, 0.0, 0.0, 0.0)


def test_one_source_alone_contradicts_nothing(true_maps: list[RangeMap]) -> None:
    wrong = [as_map(true_maps[0].range * 0.7), true_maps[1]]
    assert agreement_of(wrong, POSES[:2], 0).one_way == 0


def test_a_moved_camera_is_doubted_alone(true_maps: list[RangeMap]) -> None:
    """A camera with good ranges in the wrong place; its neighbours' ranges are right."""
    moved = list(POSES)
    moved[1] = Rigid3(POSES[1].rotation, POSES[1].translation + np.array([0.9, 0.0, 0.4]))
    for poses, expected in ((POSES, set()), (moved, {"1"})):
        agreements = {str(idx): agreement_of(true_maps, poses, idx) for idx in range(len(poses))}
        centers = {str(idx): pose.center for idx, pose in enumerate(poses)}
        assert set(view_doubts(agreements, centers)) == expected


def test_the_reason_names_the_figures() -> None:
    (reason,) = view_doubts(*line([GOOD, GOOD, WRONG, GOOD])).values()
    assert reason == (
        "other views agree with 20 % of its ranges (usual around it: 50 %) and contradict 60 % in one direction"
    )


@pytest.mark.parametrize(
    "view",
    [
        pytest.param(replace(WRONG, agreed=0.3), id="an edge of the capture"),
        pytest.param(replace(WRONG, seen_through=0.3), id="errors that scatter"),
        pytest.param(replace(WRONG, compared=0.1), id="hardly anything to compare"),
    ],
)
def test_views_are_not_doubted_for_less(view: Agreement) -> None:
    assert view_doubts(*line([GOOD, GOOD, view, GOOD])) == {}


def test_nothing_is_said_where_nobody_agrees_or_nobody_is_there_to_compare_with() -> None:
    poor = replace(GOOD, agreed=0.09)
    assert view_doubts(*line([poor, poor, replace(WRONG, agreed=0.01), poor])) == {}
    assert view_doubts(*line([GOOD, WRONG])) == {}
    agreements, centers = line([GOOD, GOOD, WRONG, GOOD])
    assert view_doubts(agreements, {name: place for name, place in centers.items() if name != "2.jpg"}) == {}


def test_only_the_nearest_views_count() -> None:
    """At the far end of a long capture of a plain corridor everybody agrees little."""
    poor = replace(WRONG, agreed=0.22)
    assert view_doubts(*line([GOOD] * 6 + [poor] * 2 + [WRONG] + [poor] * 2)) == {}
    assert set(view_doubts(*line([GOOD] * 8 + [WRONG] + [GOOD] * 2))) == {"8.jpg"}


@pytest.mark.parametrize("case", ["random", "grid", "few", "coincident"])
def test_nearest_views_are_those_of_a_plain_search(case: str) -> None:
    rng = np.random.default_rng(0)
    places = {
        "random": rng.normal(size=(60, 3)),
        "grid": np.argwhere(np.ones((5, 5, 2))).astype(float),
        "few": rng.normal(size=(3, 3)),
        "coincident": np.repeat(rng.normal(size=(4, 3)), 9, axis=0),
    }[case]
    for idx, around in enumerate(nearest_views(places)):
        distances = np.linalg.norm(places - places[idx], axis=1)
        distances[idx] = np.inf
        assert around.tolist() == np.argsort(distances, kind="stable")[: min(4, len(places) - 1)].tolist()
