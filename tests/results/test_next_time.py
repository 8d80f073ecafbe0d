"""What each camera sees, and where to stand next time."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import Rigid3, pixel_solid_angle, ray_grid
from pano_mvs.results.coverage import (
    LonelyArea,
    ViewCoverage,
    coverage,
    coverage_from_fact,
    coverage_key,
    fact_of,
    seen_alone,
    view_coverage,
)
from pano_mvs.results.next_time import Suggestion, direction_words, marks_of, shortest_tree, suggestions
from pano_mvs.results.stored_values import StoredValues
from pano_mvs.results.summary import RunSummary
from pano_mvs.scene import RangeMap
from pano_mvs.testing.tiny_capture import TinyCapture


def in_a_row(*places: float, metric: bool = True, **more: Any) -> dict[str, Any]:
    """Return the poses of cameras a, b, c, … on a line, each linked to the next two."""
    names = [chr(ord("a") + idx) for idx in range(len(places))]
    links = [[one, other, 100, 200, 0.02] for idx, one in enumerate(names) for other in names[idx + 1 : idx + 3]]
    centers = [[place, 0.0, 0.0] for place in places]
    return {"registered": names, "centers": centers, "metric": metric, "links": links, **more}


def advice(poses: dict[str, Any], ranges: float | None = None, **more: Any) -> tuple[Suggestion, ...]:
    coverage = {} if ranges is None else {name: ViewCoverage(ranges, 0.0) for name in poses["registered"]}
    return suggestions(RunSummary.from_json({"poses": poses, **more}), coverage)


def test_a_gap_in_a_row_of_cameras_is_where_to_stand() -> None:
    (found,) = advice(in_a_row(0, 1, 2, 3, 6.5, 7.5, 8.5), 5.0)
    assert found.action == "Take 3 panoramas between d and e."
    assert found.reasons == ("they are 3.5 m apart; the median distance between neighbours is 1 m",)
    assert found.at == (4.75, 0.0, 0.0)
    assert marks_of([found], 0) == [(1, (4.75, 0.0, 0.0))]
    assert marks_of([found], 1) == []


def test_an_even_row_needs_nothing() -> None:
    assert advice(in_a_row(0, 1, 2.1, 3, 4.2), 5.0) == ()
    assert advice(in_a_row(0, 1, 2.9, 4), 5.0) == (), "not more than twice the usual distance"
    assert advice(in_a_row(0)) == ()
    assert suggestions(RunSummary()) == ()


def test_a_gap_that_is_small_against_the_surroundings_is_none() -> None:
    """Cameras 0.1 m apart with one gap of 0.4 m, outdoors: no surface is seen any worse."""
    near = in_a_row(0, 0.1, 0.2, 0.6, 0.7)
    assert [found.action for found in advice(near, 1.0)] == ["Take 3 panoramas between c and d."]
    assert not any("between" in found.action for found in advice(near, 20.0))


def test_of_three_cameras_none_is_far_from_the_others() -> None:
    """Two distances have no usual one."""
    assert advice(in_a_row(0, 1, 4), 6.0) == ()


def test_lengths_without_scale_are_in_scene_units() -> None:
    (found,) = advice(in_a_row(0, 1, 2, 5, 6, metric=False), 5.0)
    assert found.reasons[0].startswith("they are 3 scene units apart")


def test_a_camera_far_from_all_others_for_what_it_sees_is_named() -> None:
    found = advice(in_a_row(0, 1, 2, 3), 1.1)
    assert [one.action for one in found] == [f"Take a panorama between {a} and {b}." for a, b in ("ab", "bc", "cd")]
    assert (
        "b is 1 m from its nearest neighbour, 91 % of the median distance to what it sees (1.1 m)"
        in found[0].reasons[1]
    )


def test_cameras_too_close_for_what_they_see_should_be_farther_apart() -> None:
    (found,) = advice(in_a_row(0, 0.02, 0.04, 0.06, 0.08), 10.0)
    assert found.action == "Take panoramas 0.5–2 m apart."
    assert "5 of 5 panoramas (a, b, c … (5 in all))" in found.reasons[0]
    assert "c, for example, within 0.04 m, 0.4 %" in found.reasons[0]
    assert found.at is None


def test_a_close_pair_within_a_good_capture_is_fine() -> None:
    assert advice(in_a_row(0, 0.02, 1, 2, 3), 5.0) == ()


def test_views_that_others_hardly_confirm_are_named_with_figures() -> None:
    shares = {"a": 0.5, "b": 0.6, "c": 0.14, "d": 0.5, "e": 0.05}
    views = [{"name": name, "consistent": share, "completeness": 1.0} for name, share in shares.items()]
    first, second = advice(in_a_row(0, 1, 2, 3, 4), 5.0, views=views)
    assert first.action == "Take a panorama between b and c."
    assert first.reasons == ("other views confirm 14 % of c, and 50 % of the median view",)
    assert second.action == "Take a panorama between d and e."
    assert advice(in_a_row(0, 1, 2, 3, 4), 5.0, views=[{**view, "consistent": 0.4} for view in views]) == ()


def test_reasons_for_one_place_are_one_suggestion() -> None:
    views = [{"name": name, "consistent": 0.1 if name == "d" else 0.5} for name in "abcdefg"]
    found = advice(in_a_row(0, 1, 2, 5, 9, 10, 11, doubts={"d": "hardly confirmed"}), 6.0, views=views)
    assert found[0].action == "Take 2 panoramas between c and d."
    assert [reason.split()[0] for reason in found[0].reasons] == ["they", "the", "other"]
    assert [one.action for one in found[1:]] == ["Take 3 panoramas between d and e."]


def test_a_camera_with_one_partner_needs_another() -> None:
    poses = in_a_row(0, 1, 2, 3)
    poses["links"] = [["a", "b", 80], ["b", "c", 70], ["a", "c", 60], ["c", "d", 31], ["b", "d", 0, 12]]
    (found,) = advice(poses, 5.0)
    assert found.action == "Take a panorama between b and d."
    assert found.reasons == ("one panorama alone, c, shares a verified geometry with d (31 verified matches)",)


def test_groups_without_a_connection_name_the_pair_to_connect() -> None:
    groups = [
        {"images": ["a", "b", "c", "d"]},
        {"images": ["x", "y"], "nearest_pair": ["c", "y", 3, 40]},
        {"images": ["p", "q"]},
    ]
    poses = in_a_row(0, 1, 2, 3, 0, 1, 0, 1) | {"registered": [*"abcdxypq"], "groups": groups, "links": []}
    first, second = advice(poses)
    assert {first.action, second.action} == {
        "Take a panorama between c and y.",
        "Take panoramas on the way from a, b … (4 in all) to p, q.",
    }
    reasons = " ".join(first.reasons + second.reasons)
    assert "group 1 (2 panoramas) has no reliable connection to the largest group" in reasons
    assert "3 verified matches of 40 candidates" in reasons
    assert first.at is second.at is None, "their worlds are unrelated"


def test_panoramas_without_a_pose_are_to_be_connected_with_those_that_match_best() -> None:
    poses = in_a_row(0, 1, 2, 3)
    poses["rejected"] = {"m": "too few", "n": "too few", "notes.png": "not a panorama"}
    poses["links"] += [["a", "m", 0, 9], ["m", "c", 4, 30], ["m", "n", 50, 60]]
    summary = {
        "stages": [{"name": "images", "use": "source.folder"}],
        "rejected": {"notes.png": {"stage": "images", "reason": "not a panorama"}},
    }
    first, second = advice(poses, 5.0, **summary)
    assert first.action == "Take a panorama between c and m."
    assert first.reasons == ("the image m has no pose; this pair has 4 verified matches of 30 candidates",)
    assert second.action == "Take panoramas 0.5–1 m apart on the way to n."
    assert second.reasons == ("1 more panorama of 7 has no pose",)


def test_areas_that_one_camera_sees_are_named_with_place_and_size() -> None:
    area = LonelyArea(90.0, -10.0, 0.08, 4.0, (1.0, 0.0, -4.0))
    small = LonelyArea(0.0, 0.0, 0.03, 2.0, (0.0, 0.0, 2.0))
    coverage = {"a": ViewCoverage(5.0, 0.03, (small,)), "b": ViewCoverage(5.0, 0.08, (area,))}
    first, second = suggestions(RunSummary.from_json({"poses": in_a_row(0, 1, 2)}), coverage)
    assert first.action == (
        "Take a panorama half-way from b to what it sees 90° to the right of the image centre, 10° below the horizon."
    )
    assert first.reasons[0].startswith("8.0 % of the sphere around b, 90° to the right")
    assert "about 4 m away" in first.reasons[0]
    assert first.at == (1.0, 0.0, -2.0)
    assert "at the image centre" in second.action


def test_directions_are_said_in_words() -> None:
    def words(azimuth_deg: float, elevation_deg: float) -> str:
        return direction_words(LonelyArea(azimuth_deg, elevation_deg, 0.1, 1.0, (0.0, 0.0, 0.0)))

    assert words(3, 30) == "at the image centre, 30° above the horizon"
    assert words(-178, 0) == "at the left and right edge of the image"
    assert words(-90, -4) == "90° to the left of the image centre"


def test_unknown_places_give_no_advice() -> None:
    assert advice(in_a_row(0, 1, float("nan"), 9)) == ()
    poses = in_a_row(0, 1, 2, 9)
    assert advice(poses | {"centers": poses["centers"][:3]}) == ()


def test_cameras_in_one_place_are_no_failure() -> None:
    assert advice(in_a_row(*[0.0] * 12), 5.0)[0].action.startswith("Take panoramas 0.25–1")
    assert advice(in_a_row(0, 0), 5.0)


def test_the_tree_is_the_shortest() -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(40, 3))
    edges = shortest_tree(points)
    from scipy.sparse.csgraph import minimum_spanning_tree

    distances = np.linalg.norm(points[:, None] - points, axis=-1)
    assert sum(length for *_, length in edges) == pytest.approx(minimum_spanning_tree(distances).sum())
    assert len(edges) == 39
    assert all(distances[a, b] == pytest.approx(length) for a, b, length in edges)
    assert shortest_tree(points[:1]) == []


HALF = np.array([3.0, 1.5, 3.0])


def camera(x: float, z: float = 0.0) -> Rigid3:
    return Rigid3.from_center(np.eye(3), np.array([x, 0.0, z]))


def box_with_screen(pose: Rigid3, size_hw: tuple[int, int]) -> FloatArray:
    """Return ranges in a box with a wall at x = 0 from floor to ceiling that leaves a door at z > 1."""
    center, rays = pose.center, ray_grid(size_hw)
    with np.errstate(divide="ignore", invalid="ignore"):
        walls = (np.where(rays > 0, HALF, -HALF) - center) / rays
        ranges = np.nanmin(np.where(walls > 0, walls, np.inf), axis=-1)
        screen = -center[0] / rays[..., 0]
        z = center[2] + screen * rays[..., 2]
    return np.asarray(np.where((screen > 0) & (screen < ranges) & (z < 1), screen, ranges))


def test_behind_a_wall_a_camera_sees_alone() -> None:
    """The second camera stands in the other room: only what is seen through the door is common."""
    left, right = camera(-1.5), camera(1.5)
    others = [(box_with_screen(right, (64, 128)), right)]
    alone = seen_alone(box_with_screen(left, (32, 64)), left, others)
    rays = ray_grid((32, 64))
    points = left.center + rays * box_with_screen(left, (32, 64))[..., None]
    weights = np.broadcast_to(pixel_solid_angle((32, 64))[:, None], alone.shape) / (4 * np.pi)
    assert alone[points[..., 0] < -0.5].mean() > 0.8
    assert weights[alone].sum() > 0.6
    assert not alone[points[..., 0] > 0.5].any(), "the other room"
    assert not seen_alone(box_with_screen(left, (32, 64)), left, []).any(), "nobody to compare with"


def test_cameras_in_one_room_see_the_same() -> None:
    first, second = camera(-1.5), camera(-2.0, 1.0)
    others = [(box_with_screen(second, (64, 128)), second)]
    found = view_coverage(box_with_screen(first, (32, 64)), first, others)
    assert found.alone < 0.05
    assert found.areas == ()


def test_the_area_is_where_it_is() -> None:
    left, right = camera(-1.5), camera(1.5)
    third = camera(-1.5, 2.0)
    ranges = box_with_screen(left, (32, 64))
    found = view_coverage(ranges, left, [(box_with_screen(right, (64, 128)), right)])
    (area, *_) = found.areas
    assert area.share == pytest.approx(found.alone, abs=0.1)
    at = left.center + area.distance * np.array(
        [
            np.cos(np.deg2rad(area.elevation_deg)) * np.sin(np.deg2rad(area.azimuth_deg)),
            -np.sin(np.deg2rad(area.elevation_deg)),
            np.cos(np.deg2rad(area.elevation_deg)) * np.cos(np.deg2rad(area.azimuth_deg)),
        ]
    )
    assert area.at == pytest.approx(at)
    assert area.at[0] < 0, "in its own room"
    both = [(box_with_screen(right, (64, 128)), right), (box_with_screen(third, (64, 128)), third)]
    assert view_coverage(ranges, left, both).alone < 0.05, "a third camera sees it too"


def test_what_is_unknown_counts_as_seen() -> None:
    left, right = camera(-1.5), camera(1.5)
    unknown = np.full((64, 128), np.nan)
    assert view_coverage(box_with_screen(left, (32, 64)), left, [(unknown, right)]).alone == 0


def test_an_area_across_the_seam_is_one() -> None:
    """Two cameras back to back with a wall between them; the first looks away from it, so the area is cut in two."""
    left, right = camera(-1.5), camera(1.5)
    turned = Rigid3.from_center(np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]), left.center)
    rays = ray_grid((32, 64)) @ turned.rotation
    columns = np.round((np.arctan2(rays[..., 0], rays[..., 2]) / (2 * np.pi) + 0.5) * 64 - 0.5).astype(int) % 64
    ranges = np.take_along_axis(box_with_screen(left, (32, 64)), columns, axis=1)
    others = [(box_with_screen(right, (64, 128)), right)]
    straight = view_coverage(box_with_screen(left, (32, 64)), left, others)
    found = view_coverage(ranges, turned, others)
    assert found.areas[0].share == pytest.approx(straight.areas[0].share, rel=0.02)
    assert found.areas[0].at == pytest.approx(straight.areas[0].at, abs=0.3)


def test_the_typical_range_is_the_median_by_solid_angle() -> None:
    ranges = np.full((32, 64), 2.0)
    ranges[:8] = 50.0  # a quarter of the rows, but less than 15 % of the sphere
    ranges[20:] = 1.0
    assert view_coverage(ranges, camera(0), []).typical_range == 2.0
    ranges[10:] = np.nan
    assert view_coverage(ranges, camera(0), []).typical_range == 50.0


def test_stored_values_are_compared(results: StoredValues, tiny: TinyCapture) -> None:
    found = coverage(results, tiny.names)
    assert list(found) == list(tiny.names)
    for name, known in found.items():
        true = tiny.each(RangeMap)[name].range
        low, high = np.quantile(true[np.isfinite(true)], [0.25, 0.75])
        assert low < known.typical_range < high
        assert known.alone < 0.5
    assert list(coverage(results, tiny.names[:1])) == [tiny.names[0]]
    assert coverage(StoredValues(), tiny.names) == {}
    without = replace(results, refs={name: refs for name, refs in results.refs.items() if name != "ranges"})
    assert coverage(without, tiny.names) == {}


def test_the_key_changes_with_the_ranges(results: StoredValues, tiny: TinyCapture) -> None:
    assert results.store is not None
    ranges = dict(results.refs["ranges"]) | {tiny.names[0]: results.refs["ranges"][tiny.names[1]]}
    other = replace(results, refs={**results.refs, "ranges": ranges})
    keys = {coverage_key(results, tiny.names), coverage_key(other, tiny.names), coverage_key(results, tiny.names[:2])}
    assert len(keys) == 3


def test_figures_survive_a_page(results: StoredValues, tiny: TinyCapture) -> None:
    area = LonelyArea(1.0, -2.0, 0.1, 3.5, (1.0, 2.0, 3.0))
    found = {"a": ViewCoverage(2.5, 0.1, (area,)), **coverage(results, tiny.names)}
    assert coverage_from_fact(json.loads(json.dumps(fact_of(found)))) == found
