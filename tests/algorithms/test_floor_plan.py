"""Wall lines, storeys and the orthophoto of rooms whose walls are known."""

from __future__ import annotations

import numpy as np
import pytest

from pano_mvs.algorithms.floor_plan.plan_grid import (
    Extent,
    PlanGrid,
    Storey,
    WallCells,
    bar_length,
    draw_plan,
    find_storeys,
)
from pano_mvs.algorithms.floor_plan.wall_lines import Walls, wall_lines
from pano_mvs.core.arrays import FloatArray
from tests.algorithms.floor_plan_rooms import HEIGHT, L_SHAPE, RoomCloud, room_cloud, walls_of

ROOM = Storey(0.0, HEIGHT, (0,))
EXTENT = Extent(-0.2, 5.2, 0.01, (540, 640))


def grid_of(cloud: RoomCloud, *, parts: int = 1, storey: Storey = ROOM, extent: Extent = EXTENT) -> PlanGrid:
    grid = PlanGrid(storey, extent, cut=storey.floor + 1.4, cell_px=4)
    for chosen in np.array_split(np.arange(len(cloud.points)), parts):
        grid.add(cloud.points[chosen], cloud.normals[chosen], cloud.colors[chosen])
    return grid


def walls_found(cells: WallCells) -> Walls:
    return wall_lines(cells, min_share=0.4, min_length=0.4, max_gap=0.3, snap=0.2)


def distance_to(walls: FloatArray, xy: FloatArray) -> FloatArray:
    """The distance of each position (N, 2) from the nearest of the walls (M, 2, 2)."""
    start, along = walls[:, 0], walls[:, 1] - walls[:, 0]
    share = np.einsum("nmk,mk->nm", xy[:, None] - start, along) / (along**2).sum(axis=1)
    nearest = start + np.clip(share, 0, 1)[..., None] * along
    return np.asarray(np.linalg.norm(xy[:, None] - nearest, axis=-1).min(axis=1))


def samples(walls: FloatArray) -> FloatArray:
    return np.concatenate([start + np.linspace(0, 1, 50)[:, None] * (end - start) for start, end in walls])


def turned(cloud: RoomCloud, angle_deg: float) -> tuple[RoomCloud, FloatArray]:
    turn = np.deg2rad(angle_deg)
    rotation = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    return RoomCloud(cloud.points @ rotation.T, cloud.normals @ rotation.T, cloud.colors), rotation[:2, :2]


@pytest.mark.parametrize("angle_deg", [0.0, 31.0])
def test_the_walls_of_an_l_shaped_room_are_found_at_any_angle(angle_deg: float) -> None:
    cloud, rotation = turned(room_cloud(), angle_deg)
    low, high = cloud.points[:, :2].min(axis=0) - 0.2, cloud.points[:, :2].max(axis=0) + 0.2
    columns, rows = np.ceil((high - low) / 0.01).astype(int).tolist()
    walls = walls_found(grid_of(cloud, extent=Extent(low[0], high[1], 0.01, (rows, columns))).wall_cells())
    true = walls_of(L_SHAPE) @ rotation.T
    assert len(walls.ends_xy) == 6
    assert distance_to(true, samples(walls.ends_xy)).max() < 0.04
    assert distance_to(walls.ends_xy, samples(true)).max() < 0.04
    assert np.sort(walls.lengths) == pytest.approx(np.sort([6, 3, 2.5, 2, 3.5, 5]), abs=0.05)


def test_the_side_that_was_seen_is_on_the_left() -> None:
    walls = walls_found(grid_of(room_cloud()).wall_cells())
    for start, end in walls.ends_xy:
        along = (end - start) / np.linalg.norm(end - start)
        inside = (start + end) / 2 + 0.1 * np.array([-along[1], along[0]])
        outside = (start + end) / 2 - 0.1 * np.array([-along[1], along[0]])
        assert distance_to(walls_of(L_SHAPE), np.stack([inside, outside])).min() > 0.05
        assert 0 < inside[0] < 6
        assert 0 < inside[1] < 5


def test_a_door_is_a_gap() -> None:
    walls = walls_found(grid_of(room_cloud(door=(0, 2.0, 2.9))).wall_cells())
    lower = walls.ends_xy[np.abs(walls.ends_xy[:, :, 1]).max(axis=1) < 0.05]
    assert len(lower) == 2
    assert np.sort(lower[:, :, 0].ravel()) == pytest.approx([0, 2.0, 2.9, 6], abs=0.06)


def test_low_furniture_is_not_a_wall() -> None:
    """A sideboard of half the height of the walls that are counted."""
    cloud = room_cloud()
    rng = np.random.default_rng(1)
    side = np.column_stack([rng.uniform(1, 3, 3000), np.full(3000, 2.0), rng.uniform(0, 0.9, 3000)])
    with_side = RoomCloud(
        np.concatenate([cloud.points, side]),
        np.concatenate([cloud.normals, np.tile([0.0, -1, 0], (3000, 1))]),
        np.concatenate([cloud.colors, np.zeros((3000, 3), np.uint8)]),
    )
    assert len(walls_found(grid_of(with_side).wall_cells()).ends_xy) == 6


def test_no_cells_have_no_walls() -> None:
    empty = PlanGrid(ROOM, EXTENT, cut=1.0, cell_px=4)
    assert walls_found(empty.wall_cells()).ends_xy.shape == (0, 2, 2)
    assert not empty.photo()[1].any()


def test_the_order_and_the_parts_of_the_cloud_do_not_matter() -> None:
    cloud = room_cloud(density=200)
    order = np.random.default_rng(0).permutation(len(cloud.points))
    mixed = RoomCloud(cloud.points[order], cloud.normals[order], cloud.colors[order])
    first, second = grid_of(cloud), grid_of(mixed, parts=7)
    np.testing.assert_array_equal(first.photo()[0], second.photo()[0])
    np.testing.assert_allclose(first.wall_cells().xy, second.wall_cells().xy, atol=1e-9)


def test_the_orthophoto_shows_what_is_highest_below_the_cut() -> None:
    photo, known = grid_of(room_cloud(density=3000)).photo()
    column, row = (EXTENT.pixels_from_xy(np.array([1.6, 1.4]))).astype(int)
    assert photo[row, column].tolist() == [30, 30, 220]  # the table
    column, row = (EXTENT.pixels_from_xy(np.array([5.0, 1.5]))).astype(int)
    assert photo[row, column].tolist() == [90, 120, 90]  # the floor, not the ceiling
    column, row = (EXTENT.pixels_from_xy(np.array([5.0, 4.0]))).astype(int)
    assert not known[row, column]  # outside of the L


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


def test_the_picture_has_walls_where_they_are_and_a_bar_of_its_length() -> None:
    extent = Extent(0.0, 2.0, 0.01, (200, 400))
    walls = np.array([[[0.5, 0.5], [3.5, 0.5]]])
    blank = np.zeros((200, 400, 3), np.uint8), np.zeros((200, 400), np.bool_)
    picture = draw_plan(*blank, extent, walls=walls, cameras=np.array([[2.0, 1.5]]), unit="m")
    assert picture.shape == (236, 400, 3)
    dark = picture.max(axis=-1) < 100
    assert dark[149:151, 60:340].all(axis=1).any()
    assert not dark[:140].any()
    assert picture[50, 200].tolist() == [214, 72, 36]
    bar = np.flatnonzero(dark[200 + 18])
    longest = max(np.split(bar, np.flatnonzero(np.diff(bar) > 1) + 1), key=len)
    assert len(longest) == pytest.approx(100, abs=3)  # 1 m
