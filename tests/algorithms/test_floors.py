"""Floors found before the sweep, and the sweep with windows on them."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from pano_mvs.algorithms.structure.floors import floors_of_groups
from pano_mvs.algorithms.structure.planes import find_floors
from pano_mvs.algorithms.structure.view import PlaneView
from pano_mvs.algorithms.sweep.numba.arguments import sweep_arguments
from pano_mvs.algorithms.sweep.numba.kernels_guided import lower_at_candidates, raise_beyond
from pano_mvs.algorithms.sweep.numba.slanted import add_planes
from pano_mvs.algorithms.sweep.preparation import planes_before
from pano_mvs.algorithms.sweep.sweep import SweepSettings, sweep_input, sweep_range
from pano_mvs.core.arrays import FloatArray, Picture
from pano_mvs.geometry import Rigid3, pixel_solid_angle, ray_grid, rotation_from_rotvec
from pano_mvs.scene import FilePart, Panorama, Poses, WorldAxes
from pano_mvs.scene.surfaces import Structure
from pano_mvs.testing.room import capture_poses, default_room, render
from tests.algorithms.range_scenes import TRUSTED, box_range

SIZE = (128, 256)
FLOOR, CEILING = 1.3, -1.5


@functools.cache
def _room() -> tuple[list[Picture], list[Rigid3], list[NDArray[np.float32]]]:
    """Return pictures, poses and true ranges of a room whose views are as far apart as they can be."""
    poses = capture_poses(4, spread=0.7, tilt_deg=5.0)
    views = [render(default_room(), pose, SIZE, supersample=1) for pose in poses]
    return [picture for picture, _ in views], poses, [truth for _, truth in views]


def _floors(axes: WorldAxes, folder: Path, missing: int = 0) -> Structure:
    pictures, cameras, _ = _room()
    named = {f"{idx}.png": picture for idx, picture in enumerate(pictures)}
    poses = Poses.without_points(dict(zip(named, cameras, strict=True)), frame="", scale="", metric=True, axes=axes)
    images = {}
    for name, picture in list(named.items())[missing:]:
        Image.fromarray(picture).save(folder / name)
        images[name] = Panorama(FilePart(folder / name), SIZE, SIZE)
    return floors_of_groups(poses, images, rng=np.random.default_rng(0))


@pytest.mark.slow
def test_the_floor_is_found_in_small_sweeps(tmp_path: Path) -> None:
    found = _floors(WorldAxes.LEVEL, tmp_path)
    heights = found.offsets * found.normals_in_world[:, 1]
    assert np.abs(heights - FLOOR).min() < 0.03 * FLOOR
    assert (found.normals_in_world[:, 1] < 0).all()
    assert heights.max() < 1.05 * FLOOR


def test_views_without_an_image_are_left_out(tmp_path: Path) -> None:
    assert len(_floors(WorldAxes.LEVEL, tmp_path, missing=1)) >= 1
    assert len(_floors(WorldAxes.LEVEL, tmp_path, missing=3)) == 0


def test_without_known_gravity_nothing_is_level(tmp_path: Path) -> None:
    assert len(_floors(WorldAxes.UNKNOWN, tmp_path)) == 0


def test_planes_before_a_camera_give_the_ranges_of_its_rays() -> None:
    _, cameras, _ = _room()
    floors = Structure(
        np.array([[0, -1.0, 0], [0, 1.0, 0], [0, -1.0, 0]]),
        np.array([-FLOOR, CEILING, 2.0]),  # the last one is above all cameras, which are behind it
        np.full(3, 0.02),
        np.zeros(3, np.int32),
    )
    camera = cameras[1]
    planes = planes_before(floors, camera, 0)
    assert planes.shape == (2, 3)
    rays = ray_grid(SIZE)
    inverse = (rays @ planes.T).max(axis=-1)
    points = camera.inverse().apply(rays / inverse[..., None])
    assert np.allclose(np.where(points[..., 1] > 0, points[..., 1] - FLOOR, points[..., 1] - CEILING), 0, atol=1e-9)
    assert len(planes_before(floors, camera, 1)) == 0


def _view(ranges: NDArray[np.float32], center: Sequence[float]) -> PlaneView:
    size = (ranges.shape[0], ranges.shape[1])
    return PlaneView(
        lambda: np.full((*size, 3), 128, np.uint8),
        Rigid3.from_center(np.eye(3), np.array(center)),
        ray_grid(size),
        ranges.astype(np.float64),
        np.full(size, TRUSTED, np.uint8),
        np.full(size, 0.003),
        np.broadcast_to(pixel_solid_angle(size)[:, None], size),
    )


def test_a_table_does_not_bound_what_its_views_see() -> None:
    centers = ((0.4, -0.3, 0.2), (-0.6, -0.1, 0.5))
    views = []
    for center in centers:
        ranges, _ = box_range(SIZE, (3.0, 1.4, 2.5), center)
        rays = ray_grid(SIZE)
        with np.errstate(divide="ignore", invalid="ignore"):
            table = np.where(rays[..., 1] > 0, (0.7 - center[1]) / rays[..., 1], np.inf)
        at = np.array(center) + rays * np.where(np.isfinite(table), table, 0)[..., None]
        on_table = np.isfinite(table) & (np.abs(at[..., 0]) < 0.9) & (np.abs(at[..., 2]) < 0.6)
        views.append(_view(np.where(on_table, table, ranges).astype(np.float32), center))
    found = find_floors(views, rng=np.random.default_rng(0))
    floors = [plane.y for plane in found if plane.normal[1] < 0]
    assert floors == [pytest.approx(1.4, rel=0.01)]


@functools.cache
def _far_apart() -> tuple[list[Picture], list[Rigid3], NDArray[np.float32]]:
    """Return pictures, source_from_reference and the true range of view 0: the floor is seen from two sides."""
    centers = ((0.0, 0.0, 0.0), (2.2, -0.1, 0.4), (-2.2, 0.1, -0.9))
    poses = [Rigid3.from_center(rotation_from_rotvec((0, idx, 0)), center) for idx, center in enumerate(centers)]
    views = [render(default_room(), pose, SIZE, supersample=1) for pose in poses]
    return [picture for picture, _ in views], poses[1:], views[0][1]


def _swept(planes: FloatArray | None, **chosen: Any) -> NDArray[np.float32]:
    pictures, poses, _ = _far_apart()
    settings = SweepSettings(planes=64, no_match="keep", **chosen)
    return sweep_range(pictures[0], pictures[1:], poses, near=0.4, far=6.0, settings=settings, planes=planes).range


@pytest.mark.parametrize("chosen", [{}, {"cost": "sad", "window": 1}], ids=["census", "single pixels"])
def test_windows_on_the_floor_find_it_where_others_do_not(chosen: dict[str, Any]) -> None:
    truth = _far_apart()[2]
    floor = np.abs(truth * ray_grid(SIZE)[..., 1] - FLOOR) < 1e-3
    known = np.array([[0.0, 1 / FLOOR, 0.0]])
    without, with_floor = (np.abs(_swept(planes, **chosen) / truth - 1) for planes in (None, known))
    assert (with_floor < 0.05)[floor].mean() > (without < 0.05)[floor].mean() + 0.2
    assert (with_floor < 0.05).mean() > (without < 0.05).mean() + 0.05


def test_a_floor_bounds_no_ray_that_meets_a_lower_one_beyond_all_hypotheses() -> None:
    """Towards the horizon, rays meet the upper floor within the last hypothesis, and the lower one beyond it."""
    picture = np.full((*SIZE, 3), 128, np.uint8)
    planes = np.array([[0, 1 / 1.6, 0], [0, 1 / 4.6, 0]])
    settings = SweepSettings(planes=128)
    work = sweep_input(picture, [picture], [_far_apart()[1][0]], near=0.4, far=20.0, settings=settings)
    volume = np.zeros((SIZE[0], 128, SIZE[1]), np.uint8)
    add_planes(volume, replace(work, planes=planes), sweep_arguments(work), top=0)
    down = ray_grid(SIZE)[:, 0, 1]
    raised = volume[:, -1, 0] > 0
    assert raised[down > 0.9].all()
    assert not raised[down < 4.6 / 20].any()


def test_no_plane_changes_nothing() -> None:
    np.testing.assert_array_equal(_swept(None), _swept(np.zeros((0, 3))))


def test_costs_are_lowered_at_candidates() -> None:
    rng = np.random.default_rng(0)
    rows, planes, width = 3, 9, 5
    volume = rng.integers(0, 256, (rows, planes, width)).astype(np.uint8)
    costs = rng.integers(0, 256, (rows, 7, width)).astype(np.uint8)
    guide = rng.uniform(0, planes - 1, (rows, width)).astype(np.float32)
    guide[0, 0] = -np.inf
    expected = volume.copy()
    for j, i in np.ndindex(rows, width):
        offsets = np.arange(planes) - guide[j, i]
        near = np.abs(offsets) < 3
        between = np.interp(offsets[near], np.arange(-3, 4), costs[j, :, i].astype(float))
        expected[j, near, i] = np.minimum(expected[j, near, i], between + 10 * np.abs(offsets[near]) + 0.5)
    lowered = volume.copy()
    lower_at_candidates(costs, guide, lowered)
    np.testing.assert_array_equal(lowered, expected)


def test_costs_beyond_a_floor_rise_but_where_most_rays_match_better_there() -> None:
    rng = np.random.default_rng(0)
    rows, planes, width = 3, 9, 40
    volume = rng.integers(0, 256, (rows, planes, width)).astype(np.uint8)
    farthest = rng.uniform(2, planes, (rows, width)).astype(np.float32)
    volume[1, -1, 12:24], farthest[1, 12:24] = 0, 5  # a hole
    half_width = np.array([1, 3, 19])
    raised = volume.copy()
    for row in range(rows):
        raise_beyond(farthest, half_width, raised, row)
    better = volume.argmin(1) > farthest
    expected = volume.copy()
    for j, i in np.ndindex(rows, width):
        half = int(half_width[j])
        around = better[j, np.arange(i - half, i + half + 1) % width]
        if around.mean() <= 0.5:
            beyond = np.arange(planes) > farthest[j, i]
            expected[j, beyond, i] = np.minimum(volume[j, beyond, i].astype(int) + 40, 255)
    np.testing.assert_array_equal(raised, expected)
    np.testing.assert_array_equal(raised[1, :, 14:22], volume[1, :, 14:22])
