"""The surface from ranges: compiled loops equal plain numpy, and planes are straight, closed and sharp."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.mesh.volume import (
    NO_PLANES,
    Planes,
    Volume,
    empty_volume,
    most_certain,
    on_planes,
    plane_of_faces,
    seen_triangles,
)
from pano_mvs.core.errors import InputError
from pano_mvs.geometry import Rigid3, ray_grid
from pano_mvs.scene import RangeMap
from pano_mvs.scene.range_map import MIRROR_CONFIDENCE, WEAK_CONFIDENCE, WINDOW_CONFIDENCE
from tests.algorithms.mesh.box import HALF, Capture, box, capture, poses
from tests.oracles.surfaces import mean_distances

AXES = np.concatenate([-np.eye(3), np.eye(3)])
WALLS: Planes = (AXES, -np.concatenate([HALF, HALF]))
"""The planes of the box, which face its inside."""


def filled(shown: Capture, *, cell: float = 0.1, threads: int = 1) -> Volume:
    maps = [(view.range_map, view.cam_from_world) for view in shown.views if view.range_map is not None]
    volume = empty_volume(maps, cell=cell)
    for range_map, pose in maps:
        volume.add(range_map, pose, np.ones(range_map.range.shape, np.bool_), threads=threads)
    return volume


def wall_distances(vertices: NDArray[np.float32]) -> NDArray[np.float64]:
    return np.asarray(np.abs(np.abs(vertices.astype(np.float64)) - HALF))


@pytest.mark.kernel("mesh.kernels_mesh")
@pytest.mark.parametrize("threads", [1, 2])
def test_distances_are_those_of_numpy(threads: int) -> None:
    shown = capture(poses(2), board=True, size_hw=(16, 32))
    volume = filled(shown, cell=0.25, threads=threads)
    places = volume.origin + volume.cell * np.moveaxis(np.indices(volume.distances.shape), 0, -1).reshape(-1, 3)
    maps = [(view.range_map, view.cam_from_world) for view in shown.views if view.range_map is not None]
    distances, weights, support = mean_distances(places, maps, limit=2 * volume.cell, middle=volume.middle)
    # A cell on the border between two pixels may get the other one.
    same = np.isclose(volume.weights.ravel(), weights, rtol=1e-3, atol=1e-5)
    assert same.mean() > 0.99
    assert np.isclose(volume.support.ravel(), support, atol=1e-5).mean() > 0.99
    np.testing.assert_allclose(volume.distances.ravel()[same], distances[same], atol=1e-4)


def test_the_surface_of_a_box_is_its_walls_seen_from_inside() -> None:
    volume = filled(capture(poses(3)))
    vertices, faces = volume.surface()
    assert np.median(wall_distances(vertices).min(axis=1)) < 0.02
    corners = vertices[faces].astype(np.float64)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (np.einsum("fi,fi->f", normals, -corners.mean(axis=1)) > 0).mean() > 0.99


def test_vertices_move_onto_walls_edges_and_corners() -> None:
    volume = filled(capture(poses(3)))
    surface = volume.surface()
    vertices, moved = on_planes(surface, WALLS, reach=0.15)
    assert moved.mean() > 0.95
    distances = np.sort(wall_distances(vertices[moved]), axis=1)
    assert distances[:, 0].max() < 1e-5
    assert (distances[:, 1] < 1e-5).sum() > 100
    assert (distances[:, 2] < 1e-5).sum() >= 8
    same, unmoved = on_planes(surface, NO_PLANES, reach=0.15)
    np.testing.assert_array_equal(same, surface[0])
    assert not unmoved.any()


def test_memory_does_not_grow_with_the_number_of_planes() -> None:
    surface = filled(capture(poses(3))).surface()
    away = np.tile(AXES, (20, 1)), np.repeat(np.arange(20.0) + 9, 6)
    many = np.concatenate([WALLS[0], away[0]]), np.concatenate([WALLS[1], away[1]])
    peaks, results = [], []
    for planes in (WALLS, many):
        tracemalloc.start()
        moved = on_planes(surface, planes, reach=0.15)
        results.append((*moved, plane_of_faces((moved[0], surface[1]), planes, tolerance=1e-3)))
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.1 * peaks[0]
    for few, same in zip(*results, strict=True):
        np.testing.assert_array_equal(few, same)


def test_a_long_thin_place_has_no_more_cells_than_allowed() -> None:
    """Two corridors that form an L, of which rounding up adds a large share."""
    maps = []
    for half, center in (((20, 1.3, 1), (20, 0, 0)), ((1, 1.3, 20), (0, 0, 20))):
        ranges = (np.array(half) / np.abs(ray_grid((32, 64)))).min(axis=-1).astype(np.float32)
        pose = Rigid3.from_center(np.eye(3), np.array(center, float))
        maps.append((RangeMap(ranges, np.full(ranges.shape, 200, np.uint8)), pose))
    assert 0.5 * 5000 < empty_volume(maps, max_cells=5000).distances.size <= 5000


def test_planes_continue_behind_a_board_and_not_beyond_the_walls() -> None:
    """Two cameras that mask a part of the wall +x, which has a hole without its plane."""
    shown = capture([Rigid3.from_center(np.eye(3), [0.1, 0, shift]) for shift in (-0.1, 0.1)])
    directions = ray_grid((64, 128))
    hidden = directions @ np.array([1.0, 0.0, 0.0]) > 0.97
    for idx, view in enumerate(shown.views):
        assert view.range_map is not None
        ranges = np.where(hidden, np.float32(np.nan), view.range_map.range)
        confidence = np.where(hidden, np.uint8(0), view.range_map.confidence)
        shown.views[idx] = replace(view, range_map=replace(view.range_map, range=ranges, confidence=confidence))

    def in_hole(volume: Volume) -> int:
        vertices, _ = volume.surface()
        return int(((vertices[:, 0] > 1.9) & (np.abs(vertices[:, 1:]) < 0.15).all(axis=1)).sum())

    volume = filled(shown)
    assert in_hole(volume) == 0
    volume.continue_planes(WALLS)
    assert in_hole(volume) >= 4
    assert (np.abs(volume.surface()[0]) < HALF + 3 * volume.cell).all()


def board_seen_from(*centers: tuple[float, float, float]) -> list[tuple[RangeMap, Rigid3]]:
    """Range maps of a square board without thickness in the plane z = 0, before walls at a distance of 4."""
    rays, maps = ray_grid((128, 256)), []
    for center in np.array(centers):
        with np.errstate(divide="ignore", invalid="ignore"):
            ranges = np.where(rays[..., 2] * center[2] < 0, -center[2] / rays[..., 2], np.inf)
            hit = (np.abs(center + ranges[..., None] * rays)[..., :2] < 0.5).all(axis=-1)
        found = np.where(hit, ranges, 4.0).astype(np.float32)
        pose = Rigid3.from_center(np.eye(3), center)
        maps.append((RangeMap(found, np.full(found.shape, 200, np.uint8)), pose))
    return maps


def area_near_board(maps: list[tuple[RangeMap, Rigid3]]) -> float:
    volume = empty_volume(maps, cell=0.06)
    for range_map, pose in maps:
        volume.add(range_map, pose, np.ones(range_map.range.shape, np.bool_))
    volume.carve()
    vertices, faces = volume.surface()
    corners = vertices[faces].astype(np.float64)
    near = (np.abs(corners[..., 2]) < 0.2).all(axis=1) & (np.abs(corners[..., :2]) < 0.6).all(axis=(1, 2))
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    return float(areas[near].sum())


@pytest.mark.slow
def test_a_thin_board_that_is_seen_from_both_sides_remains() -> None:
    """Both sides once cancelled each other, and smoothing removed what was left."""
    both = board_seen_from((0, 0, -1.5), (0.2, 0, 1.5), (-0.2, 0.1, -1.4), (0, -0.1, 1.6))
    assert area_near_board(both) > 1.6
    assert area_near_board(both[::2]) > 0.7


@pytest.mark.slow
def test_a_surface_is_removed_where_more_panoramas_look_through_it_than_measured_it() -> None:
    shown = board_seen_from((0, 0, -1.5), (0.2, 0, -1.5), (-0.2, 0.1, -1.4), (0, -0.1, -1.6))
    through = [(replace(item, range=np.full_like(item.range, 4)), pose) for item, pose in shown]
    unsure = [(replace(item, confidence=np.full_like(item.confidence, 60)), pose) for item, pose in through]
    assert area_near_board([shown[0], through[1]]) > 0.7
    assert area_near_board([shown[0], *through[1:3]]) < 0.1
    assert area_near_board([shown[0], *unsure[1:3]]) > 0.7


@pytest.mark.slow
def test_the_pane_of_a_window_remains_although_another_panorama_looks_through_it() -> None:
    shown = board_seen_from((0, 0, -1.5), (0.2, 0, -1.5))
    through = replace(shown[1][0], range=np.full_like(shown[1][0].range, 4)), shown[1][1]
    for confidence, remains in ((WINDOW_CONFIDENCE, True), (WEAK_CONFIDENCE[0], False)):
        item = replace(shown[0][0], confidence=np.full_like(shown[0][0].confidence, confidence))
        assert (area_near_board([(item, shown[0][1]), through]) > 0.7) == remains


def test_narrow_gaps_close() -> None:
    volume = filled(capture(poses(3)))
    complete = len(volume.surface()[1])
    volume.weights[:, :, volume.weights.shape[2] // 2] = 0
    assert len(volume.surface()[1]) < 0.98 * complete
    volume.close_gaps()
    assert len(volume.surface()[1]) > 0.98 * complete


def test_accurate_measured_ranges_replace_those_on_planes() -> None:
    shape = (4, 8)
    laid = RangeMap(
        np.full(shape, 2.0, np.float32), np.full(shape, 200, np.uint8), uncertainty=np.full(shape, 0.002, np.float16)
    )
    confidence = np.full(shape, 200, np.uint8)
    confidence[0] = 90
    uncertainty = np.full(shape, 0.005, np.float16)
    uncertainty[1] = 0.05
    measured = RangeMap(np.full(shape, 2.1, np.float32), confidence, uncertainty=uncertainty)
    np.testing.assert_allclose(most_certain(laid, measured).range[:, 0], [2.0, 2.0, 2.1, 2.1])
    assert most_certain(laid, replace(measured, uncertainty=None)) is laid


def test_reflections_do_not_replace_panes_of_mirrors() -> None:
    shape = (4, 8)
    pane = RangeMap(
        np.full(shape, 2.0, np.float32),
        np.full(shape, MIRROR_CONFIDENCE, np.uint8),
        uncertainty=np.full(shape, np.nan, np.float16),
    )
    reflection = RangeMap(
        np.full(shape, 5.0, np.float32), np.full(shape, 200, np.uint8), uncertainty=np.full(shape, 0.005, np.float16)
    )
    best = most_certain(pane, reflection)
    np.testing.assert_array_equal(best.range, pane.range)
    np.testing.assert_array_equal(best.confidence, pane.confidence)


def test_without_ranges_there_is_no_surface() -> None:
    nothing = RangeMap(np.full((4, 8), np.nan, np.float32), np.zeros((4, 8), np.uint8))
    with pytest.raises(InputError, match="no panorama measured a surface"):
        empty_volume([(nothing, Rigid3.identity())])


def test_what_no_panorama_sees_is_left_out_unless_it_is_kept() -> None:
    """The back of a wall 0.3 behind the walls of the box."""
    vertices, faces, _ = box(16)
    both = np.concatenate([vertices, vertices * np.float32(1.3)]), np.concatenate([faces, faces + len(vertices)])
    outer = np.arange(len(both[0])) >= len(vertices)
    np.testing.assert_array_equal(seen_triangles(both, poses(2), np.zeros_like(outer)), faces)
    np.testing.assert_array_equal(seen_triangles(both, poses(2), outer), both[1])
    assert not len(seen_triangles(both, [], np.zeros_like(outer)))


def test_triangles_know_their_plane() -> None:
    vertices, faces, wall = box(2)
    order = [0, 3, 1, 4, 2, 5]  # of the planes −x, −y, −z, +x, +y, +z by wall
    found = plane_of_faces((vertices, faces), (-WALLS[0], WALLS[1]), tolerance=1e-3)
    np.testing.assert_array_equal(found, np.array(order)[wall])
