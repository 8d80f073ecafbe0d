"""The map: true to scale, whatever lies where; links by their inliers, rejected ones apart."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.poses.frame.vertical import level_poses
from pano_mvs.report import camera_map
from pano_mvs.report.camera_map import CameraMap
from pano_mvs.results.records import PosesSummary
from pano_mvs.scene import Poses
from pano_mvs.testing.tiny_capture import TinyCapture

NAMES = ["a/1.png", "a/2.png", "a/3.png"]
POSES = {
    "registered": NAMES,
    "centers": [[0, 0, 0], [1, 0.1, 0.2], [0.4, 0, 2]],
    "links": [
        ["a/1.png", "a/2.png", 300, 410, 0.02],
        ["a/2.png", "a/3.png", 30],
        ["a/1.png", "a/4.png", 3],
        ["a/1.png", "a/3.png", 0, 12, None],
    ],
}


def camera_maps(
    poses: Mapping[str, Any], reasons: Mapping[tuple[str, str], str] | None = None
) -> tuple[CameraMap, ...]:
    return camera_map.camera_maps(PosesSummary.model_validate(poses), reasons)


def up_of(poses: Mapping[str, Any]) -> NDArray[np.float64]:
    return camera_map.up_of(PosesSummary.model_validate(poses))


def places(drawn: CameraMap) -> NDArray[np.float64]:
    return np.array([camera[:2] for camera in drawn.cameras])


def test_the_map_shows_the_cameras_true_to_scale_from_above_and_from_the_side() -> None:
    above, side = camera_maps(POSES)
    centers = np.array(POSES["centers"])
    for drawn, flat in ((above, centers[:, [0, 2]] * (1, -1)), (side, centers[:, [0, 1]])):
        found = places(drawn)
        scale = np.linalg.norm(found[1] - found[0]) / np.linalg.norm(flat[1] - flat[0])
        assert found - found[0] == pytest.approx((flat - flat[0]) * scale, abs=1)
        length, words = drawn.bar[2:]
        assert words == f"{length / scale:.2g} scene units".replace("1 scene units", "1 scene unit")


def test_links_are_weighted_by_their_inliers_and_rejected_ones_told_apart() -> None:
    above, _ = camera_maps(POSES, {("a/1.png", "a/3.png"): "too little in common"})
    assert [link.strength for link in above.links] == [0, 0.1, 1]
    assert [link.rejected for link in above.links] == [True, False, False]
    assert above.rejected == 1
    assert above.links[0].text == "1 – 3: rejected, none of 12 candidates; too little in common"
    assert above.links[2].text == "1 – 2: 300 matches of 410 candidates"


def test_doubtful_cameras_are_drawn_over_the_others_where_they_stand() -> None:
    above, side = camera_maps(POSES | {"doubts": {"a/3.png": "nobody sees it there", "gone.png": "no pose"}})
    for drawn in (above, side):
        assert drawn.doubtful == ((*drawn.cameras[2][:2], "3", "nobody sees it there"),)
        assert drawn.text.endswith(", 1 of them doubtful")
    assert not camera_maps(POSES)[0].doubtful


def test_cameras_have_the_probability_of_their_poses_also_in_a_group_of_several() -> None:
    known = POSES | {"p_right": {"a/1.png": 0.99, "a/3.png": 0.2}}
    assert [drawn.judged for drawn in camera_maps(known)] == [(0.99, None, 0.2)] * 2
    groups = [{"images": ["a/1.png", "a/2.png"]}, {"images": ["a/3.png"]}]
    parts = PosesSummary.model_validate(known | {"groups": groups}).by_group()
    assert [drawn.judged for part in parts for drawn in camera_map.camera_maps(part)[:1]] == [(0.99, None), (0.2,)]
    assert camera_maps(POSES)[0].judged == ()


def test_of_very_many_links_the_strongest_are_drawn() -> None:
    names = [str(number) for number in range(200)]
    links = [[a, b, idx] for idx, (a, b) in enumerate((a, b) for a in names for b in names if a < b)]
    above, _ = camera_maps({"registered": names, "centers": [[i, 0, i % 7] for i in range(200)], "links": links})
    strengths = [link.strength for link in above.links if not link.rejected]
    assert len(strengths) == 1500
    assert strengths == sorted(strengths)
    assert strengths[-1] == 1


def test_of_very_many_rejected_pairs_those_that_came_nearest_are_drawn() -> None:
    names = [str(number) for number in range(60)]
    pairs = [(a, b) for a in names for b in names if a < b]
    links = [[*pair, 0, idx, None] for idx, pair in enumerate(pairs)]
    above, _ = camera_maps({"registered": names, "centers": [[i, 0, i % 7] for i in range(60)], "links": links})
    assert above.rejected == 600
    assert f"none of {len(pairs) - 1} candidates" in above.links[0].text
    assert not any("none of 9 candidates" in link.text for link in above.links)


def test_of_very_many_cameras_only_dots_are_drawn() -> None:
    above, _ = camera_maps({"registered": [str(i) for i in range(5000)], "centers": [[i, 0, i] for i in range(5000)]})
    assert not above.cameras
    assert above.dots.count("M") == 5000
    assert "5000 cameras from above" in above.text


def test_the_map_is_drawn_along_the_direction_up() -> None:
    """Cameras on a wall of the world stand side by side from above if that wall is the ground."""
    above, side = camera_maps({"registered": NAMES, "centers": [[0, 0, 0], [1, 0, 0], [0, 3, 0]], "up": [0, 0, 1]})
    assert np.ptp(places(above)[:, 1]) == pytest.approx(3 * np.ptp(places(above)[:, 0]), rel=0.02)
    assert np.ptp(places(side)[:, 1]) == pytest.approx(0, abs=0.11)


@pytest.mark.parametrize("up", [None, [0, 0, 0], [float("nan")] * 3])
def test_a_direction_up_that_is_none_is_that_of_the_first_camera(up: Sequence[float] | None) -> None:
    assert up_of({"up": up}).tolist() == [0, -1, 0]


def test_north_is_shown_where_poses_level_has_found_it(tiny: TinyCapture) -> None:
    poses = tiny.whole(Poses)
    up = {name: tuple(-rotation[:, 1]) for name, rotation in zip(tiny.names, poses.rotations, strict=True)}
    forward = poses.rotations[:, 2]
    headings = dict(zip(tiny.names, np.rad2deg(np.arctan2(forward[:, 0], forward[:, 2])) + 40, strict=True))
    for known, north in ((headings, True), ({}, False)):
        level, _ = level_poses(poses, up, known)
        above, side = camera_maps(
            {"registered": list(level.names), "centers": level.centers.tolist(), "axes": level.axes, "up": [1, 0, 0]}
        )
        assert (above.north, side.north) == (north, False)
        assert up_of({"axes": level.axes, "up": [1, 0, 0]}).tolist() == [0, -1, 0]


def test_labels_stand_beside_their_cameras_and_cover_no_other() -> None:
    """Of cameras in a row too close for their names some go without one, rather than with one far away."""
    names = [f"R{number:07d}.jpg" for number in range(10210, 10240)]
    above, _ = camera_maps({"registered": names, "centers": [[0.3 * idx, 0, 0.02 * idx] for idx in range(30)]})
    spots = [(spot, (x, y)) for x, y, _, spot in above.cameras if spot is not None]
    assert 6 <= len(spots) < 30
    wide = 8.6 * 8
    for idx, ((left, line), (x, y)) in enumerate(spots):
        assert abs(line - y) <= 34
        assert min(abs(left - x), abs(left + wide - x)) <= 9.5
        for (other, other_line), _ in spots[:idx]:
            assert abs(left - other) > wide or abs(line - other_line) >= 16


@pytest.mark.parametrize(
    "centers", [[[0, 0, 0]] * 3, [[0, 0, 0], [0, 1e-12, 0], [0, 0, 0]], [[0, 0, 0], [1e6, 0, 0], [2e6, 0, 0]]]
)
def test_cameras_in_one_place_or_in_a_row_are_drawn_within_the_map(centers: Sequence[Sequence[float]]) -> None:
    for drawn in camera_maps({"registered": ["a rather long name of a picture", "b", "c"], "centers": centers}):
        assert np.all((places(drawn) > 0) & (places(drawn) < drawn.size_wh))


@pytest.mark.parametrize("centers", [[[0, 0, 0]], [[0, 0, float("nan")]] * 3])
def test_centres_that_do_not_fit_give_no_map(centers: Sequence[Sequence[float]]) -> None:
    assert camera_maps({"registered": NAMES, "centers": centers}) == ()


def test_places_to_stand_are_marked_to_scale_and_within_the_map() -> None:
    marks = [(1, (0.5, 0.0, 1.0)), (4, (90.0, 0.0, -90.0))]
    above, side = camera_map.camera_maps(PosesSummary.model_validate(POSES), marks=marks)
    first, _, third = places(above)
    scale = np.linalg.norm(third - first) / np.linalg.norm([0.4, 2])
    assert above.marks[0][:2] == pytest.approx(first + scale * np.array([0.5, -1]), abs=0.2)
    assert [mark[2] for mark in above.marks] == [1, 4]
    assert side.marks == ()
    assert above.marks[1][:2] == (above.size_wh[0] - 14, above.size_wh[1] - 14)


def walked(count: int, extra: list[tuple[int, int]], window: int = 3) -> dict[str, Any]:
    """Return poses along a circle, with links of each camera to the next ones and further links."""
    angles = 2 * np.pi * np.arange(count) / count
    near = [(idx, idx + step) for idx in range(count) for step in range(1, window + 1) if idx + step < count]
    names = [f"{idx:03d}.png" for idx in range(count)]
    return {
        "registered": names,
        "centers": np.stack([np.sin(angles), 0 * angles, np.cos(angles)], axis=1).tolist(),
        "links": [[names[a], names[b], 100] for a, b in [*extra, *near]],
    }


def test_the_path_of_a_walk_is_drawn_with_its_ends_and_loop_closures() -> None:
    above, side = camera_maps(walked(300, [(0, 299), (3, 290)]))
    for drawn in (above, side):
        assert drawn.path.startswith("M")
        assert drawn.path.count("L") == 299
        assert drawn.ends == (drawn.cameras[0][:2], drawn.cameras[-1][:2])
        assert drawn.closures == 2
        assert [link.closure for link in drawn.links[-2:]] == [True, True], "closures are drawn over the others"
        assert drawn.links[-1].text.endswith("; closes a loop")
    assert above.radius < camera_maps(walked(100, []))[0].radius
    assert camera_maps(walked(30, []))[0].path
    assert not camera_maps(walked(30, []))[0].ends, "cameras with labels"


def test_loop_closures_are_drawn_though_other_links_are_stronger() -> None:
    capture = walked(400, [], window=9)
    capture["links"].append(["000.png", "399.png", 1])
    drawn = camera_maps(capture)[0]
    assert drawn.closures == 1
    assert len(drawn.links) == 1500


def test_a_path_is_interrupted_where_no_pair_leads_on() -> None:
    capture = walked(60, [])
    names = capture["registered"]
    capture["links"] = [link for link in capture["links"] if not link[0] < names[30] <= link[1]]
    assert camera_maps(capture)[0].path.count("M") == 2


def test_captures_without_order_have_no_path() -> None:
    names = walked(40, [])["registered"]
    everything = walked(40, []) | {"links": [[a, b, 50] for a in names for b in names if a < b]}
    shuffled = np.random.default_rng(0).permutation(40)
    disordered = walked(40, []) | {"links": [[names[a], names[b], 50] for a, b in pairwise(shuffled)]}
    for capture in (everything, disordered, walked(10, [])):
        drawn = camera_maps(capture)[0]
        assert (drawn.path, drawn.ends, drawn.closures) == ("", (), 0)
