"""Pixels get the plane that the pictures show, where ranges do not tell planes apart."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pano_mvs.algorithms.structure.kernels_labels import add_paths
from pano_mvs.algorithms.structure.labels import plane_labels
from pano_mvs.algorithms.structure.laid import OtherView
from pano_mvs.algorithms.structure.lay import lay_structure
from pano_mvs.algorithms.structure.matched import mismatch
from pano_mvs.algorithms.structure.view import grid_rows, on_grid, plane_ranges
from pano_mvs.geometry import Rigid3, ray_grid
from pano_mvs.scene.range_map import FILLED_CONFIDENCE
from pano_mvs.scene.surfaces import Structure
from pano_mvs.testing.room import Room, render
from pano_mvs.testing.surfaces import Cuboid
from tests.algorithms.range_scenes import TRUSTED, as_map

SIZE = (256, 512)
HALF = (3.0, 1.4, 2.5)
BEAM_Y = -1.15
CENTERS = ((0.5, -0.1, 0.2), (-0.4, 0.0, 0.6), (0.1, -0.2, -0.6))
WHITE, GREY = ((0.8, 0.8, 0.8),) * 2, ((0.7, 0.7, 0.7),) * 2
ROOM = Room(
    (
        Cuboid((-3.0, -1.4, -2.5), (3.0, 1.4, 2.5), WHITE),
        Cuboid((-0.6, -1.4, -2.5), (-0.2, BEAM_Y, 2.5), GREY),
    ),
    textures=("faint", "faint"),
)
POSES = tuple(Rigid3.from_center(np.eye(3), center) for center in CENTERS)
NORMALS = np.concatenate([np.eye(3), -np.eye(3), [[0.0, 1.0, 0.0]]])
OFFSETS = np.array([-3.0, -1.4, -2.5, -3.0, -1.4, -2.5, BEAM_Y])
PLANES = Structure(NORMALS, OFFSETS, np.full(7, 0.003), np.zeros(7, np.int32))


@pytest.mark.kernel("structure.kernels_labels")
@pytest.mark.parametrize("step", [(0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)])
def test_paths_have_the_least_costs(step: tuple[int, int]) -> None:
    rng = np.random.default_rng(0)
    costs, penalties = rng.random((4, 6, 3)).astype(np.float32), rng.random((4, 6)).astype(np.float32)
    sums = np.ones_like(costs)
    add_paths(costs, penalties, step, sums)
    expected = np.zeros_like(costs)
    for row, column in np.ndindex(4, 6):
        # The path to a pixel, from its beginning: twelve pixels of a row, or all rows up to a pole.
        length = 6 + column + 1 if step == (0, 1) else 12 - column if step == (0, -1) else 0
        length = length or (row + 1 if step[0] > 0 else 4 - row)
        path = [(row - step[0] * back, (column - step[1] * back) % 6) for back in range(length)][::-1]
        total = costs[path[0]].astype(np.float64)
        for at in path[1:]:
            total = total - total.min()
            total = costs[at] + np.minimum(total, penalties[at])
        expected[row, column] = total
    np.testing.assert_allclose(sums - 1, expected, rtol=1e-5)


@pytest.mark.slow
def test_a_beam_is_told_from_the_ceiling_by_its_edges() -> None:
    """All ranges of ceiling and beam lie halfway between the two, as those of plain surfaces can in every view."""
    views = [render(ROOM, pose, SIZE, supersample=1) for pose in POSES]
    rays = ray_grid(SIZE)
    level = [plane_ranges(rays, POSES[0].center, normal=NORMALS[at], offset=OFFSETS[at]) for at in (1, 6)]
    ceiling, beam = (np.abs(views[0][1] / plane - 1) < 1e-3 for plane in level)
    assert ceiling.mean() > 0.1
    assert beam.mean() > 0.01
    halfway = np.where(ceiling | beam, np.sqrt(level[0] * level[1]), views[0][1])
    unsure = as_map(halfway, np.where(ceiling | beam, FILLED_CONFIDENCE[1], TRUSTED))
    laid, _ = lay_structure(
        unsure,
        views[0][0],
        PLANES,
        cam_from_world=POSES[0],
        sources=[OtherView(as_map(views[at][1], TRUSTED), POSES[at], views[at][0]) for at in (1, 2)],
    )
    error = np.abs(laid.range / views[0][1] - 1)
    assert np.mean(error[beam] < 0.01) > 0.9
    assert np.mean(error[ceiling] < 0.01) > 0.9


@pytest.mark.parametrize("edge", [20, 0])
def test_labels_change_where_colours_do(edge: int) -> None:
    """Two plain areas, one of them across the seam: each shows its plane only in a few of its columns."""
    size = (32, 64)
    first = (np.arange(64) - edge) % 64 < 30
    guide = np.full((*size, 3), 120, np.uint8)
    guide[:, first] = 140
    ranges = np.full(size, np.nan, np.float32)
    for area, near in ((first, 2.0), (~first, 3.0)):
        ranges[:, np.flatnonzero(area)[::9]] = near
    labels = plane_labels(
        [np.full(size, 2.0), np.full(size, 3.0)],
        ranges,
        np.where(np.isnan(ranges), 0, TRUSTED).astype(np.uint8),
        outlined=None,
        matched=None,
        textured=np.isfinite(ranges),
        tolerance=np.full(size, 0.08),
        guide=guide,
    )
    np.testing.assert_array_equal(labels, np.broadcast_to(~first, size))


@pytest.mark.slow
@pytest.mark.parametrize("rows", [256, 770])
def test_pictures_match_best_where_surfaces_are(rows: int) -> None:
    """Panoramas of 770 rows are matched at 512, whose pixels are not those of the grid; ranges are exact at both."""
    size = rows, 2 * rows
    views = [render(replace(ROOM, textures=("strong", "strong")), pose, size, supersample=1) for pose in POSES]
    sources = [OtherView(as_map(views[at][1], TRUSTED), POSES[at], views[at][0]) for at in (1, 2)]
    offsets = np.array([-1.4, -1.25, -1.55])
    shifted = Structure(np.tile(NORMALS[1], (3, 1)), offsets, np.full(3, 0.003), np.zeros(3, np.int32))
    rays = ray_grid(size)
    ceiling, nearer = (plane_ranges(rays, POSES[0].center, normal=NORMALS[1], offset=offset) for offset in offsets[:2])
    here = np.abs(views[0][1] / ceiling - 1) < 1e-3
    own = as_map(np.where(here, nearer, views[0][1]), TRUSTED)
    found = mismatch(own, views[0][0], shifted, planes=np.arange(3), cam_from_world=POSES[0], sources=sources)
    assert found is not None
    on_ceiling = on_grid(here, grid_rows(rows))
    best = found.on_planes[0][on_ceiling]
    for other in (*found.on_planes[1:], found.own):
        assert np.mean(best < other[on_ceiling] - 0.1) > 0.8
    normals = np.broadcast_to(NORMALS[1].astype(np.float16), (*size, 3))
    truth = replace(as_map(views[0][1], TRUSTED), normals_in_cam=normals)
    exact = mismatch(truth, views[0][0], shifted, planes=np.arange(3), cam_from_world=POSES[0], sources=sources)
    assert exact is not None
    assert np.median(np.abs(exact.own[on_ceiling] - best)) < 0.1


def test_views_from_the_same_place_are_no_evidence() -> None:
    view = render(ROOM, POSES[0], SIZE, supersample=1)
    same = OtherView(as_map(view[1], TRUSTED), POSES[0], view[0])
    own, planes = as_map(view[1], TRUSTED), np.arange(len(PLANES))
    assert mismatch(own, view[0], PLANES, planes=planes, cam_from_world=POSES[0], sources=[same]) is None
