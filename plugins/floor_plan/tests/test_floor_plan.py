"""Rooms, walls, openings, storeys and the orthophoto of places whose walls are known."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from pano_mvs_floor_plan.evidence import CloudViews, Evidence, PlanView, range_view
from pano_mvs_floor_plan.rooms import Side
from pano_mvs_floor_plan.walls_and_openings import StoreyPlan, _Frame, plan_storey

from pano_mvs.algorithms.points.plan_grid import Extent, Orthophoto, Storey, bar_length, find_storeys
from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import Rigid3, rotation_from_rotvec
from pano_mvs.scene import RangeMap
from tests.synthetic.floor_plan_rooms import (
    DOOR,
    HEIGHT,
    L_SHAPE,
    WINDOW,
    RoomCloud,
    distance_to,
    flat_ranges,
    room_cloud,
    samples,
    walls_of,
)

ROOM = Storey(0.0, HEIGHT, (0,))
EXTENT = Extent(-0.2, 5.2, 0.01, (540, 640))
CAM_FROM_Z_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


def pixel_at(x: float, y: float) -> tuple[int, int]:
    return int((EXTENT.top - y) / EXTENT.pixel), int((x - EXTENT.left) / EXTENT.pixel)


def camera(center: FloatArray, turn_deg: float = 0.0) -> Rigid3:
    return Rigid3.from_center(rotation_from_rotvec([0, np.deg2rad(turn_deg), 0]) @ CAM_FROM_Z_UP, center)


def orthophoto(cloud: RoomCloud, *, parts: int = 1) -> Orthophoto:
    photo = Orthophoto(ROOM, EXTENT, cut=1.4)
    for chosen in np.array_split(np.arange(len(cloud.points)), parts):
        photo.add(cloud.points[chosen], cloud.colors[chosen])
    return photo


def rotation(angle_deg: float) -> FloatArray:
    turn = np.deg2rad(angle_deg)
    return np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])


def turned(cloud: RoomCloud, turn: FloatArray) -> RoomCloud:
    def apply(vectors: FloatArray) -> FloatArray:
        return np.column_stack([vectors[:, :2] @ turn.T, vectors[:, 2]])

    return RoomCloud(apply(cloud.points), apply(cloud.normals), cloud.colors)


def evidence_around(xy: FloatArray) -> Evidence:
    low, high = xy.min(axis=0) - 0.3, xy.max(axis=0) + 0.3
    columns, rows = np.ceil((high - low) / 0.03).astype(int).tolist()
    return Evidence(ROOM, Extent(float(low[0]), float(high[1]), 0.03, (rows, columns)))


def plan_of_cloud(cloud: RoomCloud, *places: FloatArray) -> StoreyPlan:
    cameras = np.array([(*place, 1.5) for place in places])
    views = CloudViews([camera(center) for center in cameras])
    views.add(cloud.points, cloud.normals)
    return planned([views.view(number) for number in range(len(cameras))], cloud.points[:, :2], cameras[:, :2])


def planned(views: Sequence[PlanView], xy: FloatArray, cameras: FloatArray) -> StoreyPlan:
    evidence = evidence_around(xy)
    for view in views:
        evidence.add(view)
    return plan_storey(evidence, [], views=lambda: views, cameras=cameras, min_share=0.4)


def plan_of_flat(
    angle_deg: float,
    cameras: FloatArray | None = None,
    change: Callable[[RangeMap], RangeMap] = lambda range_map: range_map,
) -> tuple[StoreyPlan, FloatArray]:
    turn = rotation(angle_deg)
    places = np.array([(1.0, 1.5), (3.0, 2.2), (5.5, 1.0)]) @ turn.T
    cams = [camera(np.array([*place, 1.5]), 70.0 * number) for number, place in enumerate(places)]
    views = [range_view(change(flat_ranges(cam, turn=turn)), cam) for cam in cams]
    corners = np.array([(0.0, -1.0), (7.2, 3), (0, 3), (7.2, -1)]) @ turn.T
    return planned(views, corners, places if cameras is None else cameras), turn


@pytest.mark.parametrize("angle_deg", [0.0, 31.0])
def test_the_outline_of_an_l_shaped_room_is_closed_at_any_angle(angle_deg: float) -> None:
    turn = rotation(angle_deg)
    plan = plan_of_cloud(turned(room_cloud(), turn), turn @ (2, 2), turn @ (5, 1))
    true = walls_of(L_SHAPE) @ turn.T
    (room,) = plan.rooms
    assert room.area == pytest.approx(25, rel=0.01)
    assert len(room.outline) == 6
    np.testing.assert_allclose(room.outline, np.array([wall.ends[0] for wall in plan.walls]), atol=1e-9)
    walls = np.array([wall.ends for wall in plan.walls])
    assert distance_to(true, samples(walls)).max() < 0.02
    assert distance_to(walls, samples(true)).max() < 0.02
    assert [wall.thickness for wall in plan.walls] == [None] * 6
    assert not plan.openings


@pytest.mark.parametrize("x", [5.0, 300.0])
def test_a_room_far_from_the_origin_has_the_same_plan(x: float) -> None:
    cloud, shift = room_cloud(), np.array([x, 3.0])
    moved = RoomCloud(cloud.points + np.append(shift, 0), cloud.normals, cloud.colors)
    (room,) = plan_of_cloud(moved, np.array([2, 2]) + shift, np.array([5, 1]) + shift).rooms
    assert room.area == pytest.approx(25, rel=0.01)
    assert len(room.outline) == 6


def test_the_side_that_was_seen_is_on_the_left() -> None:
    for wall in plan_of_cloud(room_cloud(), np.array([2, 2]), np.array([5, 1])).walls:
        along = wall.ends[1] - wall.ends[0]
        x, y = wall.ends.mean(axis=0) + 0.1 * np.array([-along[1], along[0]]) / np.linalg.norm(along)
        assert 0 < x < 6
        assert 0 < y < (5 if x < 3.5 else 3)


@pytest.mark.parametrize("angle_deg", [0.0, 31.0])
def test_a_wall_between_two_rooms_has_its_thickness_and_its_door(angle_deg: float) -> None:
    plan, turn = plan_of_flat(angle_deg)
    assert sorted(room.area for room in plan.rooms) == pytest.approx([9, 12], rel=0.02)
    between = [wall for wall in plan.walls if wall.thickness is not None]
    assert [wall.thickness for wall in between] == pytest.approx([0.2] * 4, abs=0.02)
    assert len(plan.solids) == 4
    (door,) = [one for one in plan.openings if one.kind == "door"]
    ends = door.ends @ turn
    assert ends[:, 0] == pytest.approx([4.1, 4.1], abs=0.02)
    assert np.sort(ends[:, 1]) == pytest.approx(DOOR, abs=0.1)
    assert door.bottom == 0
    assert door.top == pytest.approx(2.0, abs=0.1)
    assert door.rooms == (0, 1)


@pytest.mark.parametrize("angle_deg", [0.0, 31.0])
def test_each_wall_has_one_body_with_its_openings(angle_deg: float) -> None:
    plan, _ = plan_of_flat(angle_deg)
    (both,) = [body for body in plan.bodies if body.thickness is not None]
    assert both.thickness == pytest.approx(0.2, abs=0.02)
    assert set(both.rooms) == {0, 1}
    assert np.linalg.norm(both.ends[1] - both.ends[0]) == pytest.approx(3.0, abs=0.05)
    outer = [body for body in plan.bodies if body.thickness is None]
    lengths = sorted(float(np.linalg.norm(body.ends[1] - body.ends[0])) for body in outer)
    assert lengths == pytest.approx([3, 3, 3, 3, 4, 4], abs=0.05)
    for opening in plan.openings:
        (body,) = [one for one in plan.bodies if any(each is opening for each in plan.openings_of(one))]
        assert body.contains(opening.ends.mean(axis=0))
        assert (body is both) == (opening.kind == "door")


@pytest.mark.slow
def test_a_pillar_is_one_wall() -> None:
    corners = np.array([[1.5, 1.2], [1.5, 1.65], [1.95, 1.65], [1.95, 1.2]])
    panels = [(corners[idx - 1], corners[idx], 0.0, HEIGHT) for idx in range(4)]
    places = np.array([(0.6, 0.6), (3.2, 2.4), (0.7, 2.4), (3.2, 0.7), (5.5, 1.0)])
    cams = [camera(np.array([*place, 1.5])) for place in places]
    views = [range_view(flat_ranges(cam, turn=np.eye(2), size_hw=(256, 512), more=panels), cam) for cam in cams]
    plan = planned(views, np.array([(0.0, 0.0), (7.2, 3.0)]), places)
    assert len(plan.rooms[0].holes) == 1
    known = [body for body in plan.bodies if body.thickness is not None]
    assert sorted(body.thickness or 0 for body in known) == pytest.approx([0.2, 0.45], abs=0.03)


@pytest.mark.slow
def test_a_beam_below_the_ceiling_is_not_a_wall() -> None:
    """Both sides of a beam of .3 m across the first room; the same down to the floor is a wall."""
    places = np.array([(0.6, 1.0), (0.8, 2.4), (3.3, 2.4), (3.2, 0.7), (5.5, 1.0)])
    cams = [camera(np.array([*place, 1.5])) for place in places]

    def rooms(bottom: float) -> list[float]:
        panels = [(np.array([x, 0.0]), np.array([x, 3.0]), bottom, HEIGHT) for x in (1.9, 2.1)]
        views = [range_view(flat_ranges(cam, turn=np.eye(2), size_hw=(256, 512), more=panels), cam) for cam in cams]
        plan = planned(views, np.array([(0.0, 0.0), (7.2, 3.0)]), places)
        return sorted(room.area for room in plan.rooms)

    assert rooms(HEIGHT - 0.3) == pytest.approx([9, 12], rel=0.02)
    assert rooms(0.0) == pytest.approx([5.7, 5.7, 9], rel=0.03)


def test_a_window_does_not_reach_the_floor() -> None:
    plan, _ = plan_of_flat(0.0)
    (window,) = [one for one in plan.openings if one.kind == "window"]
    assert window.ends[:, 1] == pytest.approx([0, 0], abs=0.02)
    assert np.sort(window.ends[:, 0]) == pytest.approx(WINDOW, abs=0.15)
    assert (window.bottom, window.top) == pytest.approx((1.0, 2.0), abs=0.1)
    assert window.rooms == (0,)


@pytest.mark.parametrize(("start", "behind"), [(-3.0, False), (2.0, True), (11.0, False)])
def test_only_a_side_that_is_behind_another_is_its_back(start: float, behind: bool) -> None:
    evidence = evidence_around(np.array([(-6.0, -1), (12, 2)]))
    own = _Frame(Side(np.array([(0.0, 0), (8, 0)]), 0, 0), evidence)
    back = np.array([(start, 0.2 * own.back[1]), (start - 2, 0.2 * own.back[1])])
    assert (own.behind(_Frame(Side(back, 1, 1), evidence), 0.5) is not None) == behind


def test_a_window_that_shows_the_sky_is_a_window() -> None:
    def with_sky(range_map: RangeMap) -> RangeMap:
        far = range_map.range > 6.5
        return replace(range_map, range=np.where(far, np.nan, range_map.range).astype(np.float32),
                       confidence=np.where(far, 0, range_map.confidence).astype(np.uint8), sky=far)  # fmt: skip

    plan, _ = plan_of_flat(0.0, change=with_sky)
    assert sorted(one.kind for one in plan.openings) == ["door", "window"]


def test_what_was_filled_shows_no_opening() -> None:
    def filled(range_map: RangeMap) -> RangeMap:
        return replace(range_map, confidence=np.full(range_map.range.shape, 60, np.uint8))

    plan, _ = plan_of_flat(0.0, change=filled)
    assert len(plan.rooms) == 2
    assert not plan.openings


def test_furniture_is_not_a_wall() -> None:
    """A cupboard that ends below the ceiling."""
    cloud = room_cloud()
    rng = np.random.default_rng(1)
    front = np.column_stack([rng.uniform(1, 3, 3000), np.full(3000, 2.0), rng.uniform(0, 2.0, 3000)])
    furnished = RoomCloud(
        np.concatenate([cloud.points, front]),
        np.concatenate([cloud.normals, np.tile([0.0, -1, 0], (3000, 1))]),
        np.concatenate([cloud.colors, np.zeros((3000, 3), np.uint8)]),
    )
    plan = plan_of_cloud(furnished, np.array([2, 1]), np.array([5, 1]), np.array([1, 4]))
    assert len(plan.walls) == 6


def test_one_view_does_not_see_through_a_wall_that_two_see() -> None:
    cams = [camera(np.array([*place, 1.5])) for place in ((1.0, 1.5), (3.0, 2.2), (2.0, 1.0))]
    maps = [flat_ranges(cam, turn=np.eye(2)) for cam in cams]
    maps[2] = replace(maps[2], range=3 * maps[2].range)
    views = [range_view(one, cam) for one, cam in zip(maps, cams, strict=True)]
    evidence = evidence_around(np.array([(-2.0, -1), (7.2, 3)]))
    for view in views:
        evidence.add(view)
    (inside, outside), _ = evidence.extent.cells(np.array([(0.5, 1.5), (-1.0, 1.5)]))
    assert evidence.free[[inside, outside]].tolist() == [6, 2]
    evidence.recount(views)
    assert evidence.free[[inside, outside]].tolist() == [6, 0]


def test_what_no_camera_stands_in_is_no_room() -> None:
    assert len(plan_of_flat(0.0, cameras=np.array([[1.0, 1.5]]))[0].rooms) == 1


def test_without_views_there_is_no_plan() -> None:
    plan = planned([], np.array([(0.0, 0), (1, 1)]), np.zeros((1, 2)))
    assert not any((plan.rooms, plan.walls, plan.openings, plan.solids))


def test_the_order_and_the_parts_of_the_cloud_do_not_matter() -> None:
    cloud = room_cloud(density=200)
    order = np.random.default_rng(0).permutation(len(cloud.points))
    mixed = RoomCloud(cloud.points[order], cloud.normals[order], cloud.colors[order])
    np.testing.assert_array_equal(orthophoto(cloud).picture()[0], orthophoto(mixed, parts=7).picture()[0])
    cams = [camera(np.array([2.0, 2, 1.5])), camera(np.array([5.0, 1, 1.5]))]
    seen = []
    for one, parts in ((cloud, 1), (mixed, 7)):
        views = CloudViews(cams)
        for chosen in np.array_split(np.arange(len(one.points)), parts):
            views.add(one.points[chosen], one.normals[chosen])
        seen.append([views.view(number).free for number in range(2)])
    np.testing.assert_array_equal(seen[0], seen[1])


def test_the_orthophoto_shows_what_is_highest_below_the_cut() -> None:
    photo, known = orthophoto(room_cloud(density=3000)).picture()
    assert photo[pixel_at(1.6, 1.4)].tolist() == [30, 30, 220]  # the table
    assert photo[pixel_at(5.0, 1.5)].tolist() == [90, 120, 90]  # the floor, not the ceiling
    assert not known[pixel_at(5.0, 4.0)]  # outside of the L


def test_one_storey_with_its_cameras() -> None:
    cloud = room_cloud(floor=-1.5)
    (storey,) = find_storeys(cloud.points[:, 2], cloud.normals[:, 2], np.array([0.0, 0.1, -0.3]))
    assert storey.floor == pytest.approx(-1.5, abs=0.02)
    assert storey.ceiling == pytest.approx(-1.5 + HEIGHT, abs=0.02)
    assert storey.cameras == (0, 1, 2)
    assert storey.has_floor
    assert storey.has_ceiling


def test_two_storeys_are_told_apart() -> None:
    clouds = [room_cloud(), room_cloud(floor=2.9, seed=1)]
    heights = np.concatenate([cloud.points[:, 2] for cloud in clouds])
    ups = np.concatenate([cloud.normals[:, 2] for cloud in clouds])
    storeys = find_storeys(heights, ups, np.array([4.4, 1.5, 1.6, 4.5]))
    assert [storey.cameras for storey in storeys] == [(1, 2), (0, 3)]
    assert [storey.floor for storey in storeys] == pytest.approx([0, 2.9], abs=0.03)
    assert [storey.ceiling for storey in storeys] == pytest.approx([HEIGHT, 2.9 + HEIGHT], abs=0.03)


def test_a_camera_on_the_stairs_is_no_storey() -> None:
    """Half-way up, a camera is above the ceiling of the lower storey, and nearly as high as the upper floor."""
    clouds = [room_cloud(), room_cloud(floor=2.9, seed=1)]
    heights = np.concatenate([cloud.points[:, 2] for cloud in clouds])
    ups = np.concatenate([cloud.normals[:, 2] for cloud in clouds])
    storeys = find_storeys(heights, ups, np.array([1.5, 1.5, 1.6, 2.95, 4.4, 4.5]))
    assert [storey.cameras for storey in storeys] == [(0, 1, 2, 3), (4, 5)]
    assert [storey.floor for storey in storeys] == pytest.approx([0, 2.9], abs=0.03)
    assert [storey.ceiling for storey in storeys] == pytest.approx([HEIGHT, 2.9 + HEIGHT], abs=0.03)


def test_a_storey_has_a_floor() -> None:
    """A camera on a tripod of twice the height stands on the same floor."""
    cloud = room_cloud()
    (storey,) = find_storeys(cloud.points[:, 2], cloud.normals[:, 2], np.array([1.2, 1.3, 2.45]))
    assert storey.cameras == (0, 1, 2)
    assert storey.ceiling == pytest.approx(HEIGHT, abs=0.03)


def test_without_level_surfaces_the_storey_is_a_guess() -> None:
    heights = np.random.default_rng(0).uniform(0, 3, 500)
    (storey,) = find_storeys(heights, np.zeros(500), np.array([1.5]))
    assert not storey.has_floor
    assert not storey.has_ceiling
    assert storey.floor < 0.1
    assert storey.ceiling > 2.9
    (storey,) = find_storeys(heights, np.zeros(500), np.zeros(0))
    assert not storey.has_floor
    assert find_storeys(np.zeros(0), np.zeros(0), np.zeros(2)) == []


@pytest.mark.parametrize(("width", "length"), [(10, 2), (7.9, 1), (8, 2), (0.9, 0.2), (1234, 200)])
def test_the_scale_bar_has_a_round_length(width: float, length: float) -> None:
    assert bar_length(width) == pytest.approx(length)
