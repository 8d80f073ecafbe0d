"""Planes on plain surfaces: recovered from their outline, never carried on beyond it, never laid across texture."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.filters.planes import fit_plane, lay_planes, plain_surfaces
from pano_mvs.geometry import Rigid3, ray_grid, rotation_from_rotvec
from pano_mvs.scene import RangeMap
from pano_mvs.testing.room import default_room, render
from tests.algorithms.range_scenes import TRUSTED, as_map
from tests.synthetic.scenes import white_room

Wall = tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.bool_], RangeMap]

SIZE = (128, 256)
HIDDEN = 90


def rng() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.fixture(scope="module")
def white() -> Wall:
    """A view of the white room, its ranges, and the map that chance makes of plain paint; the outline is seen."""
    image, ranges = white_room(turned=False).view(0, SIZE, supersample=1)
    _, bare = plain_surfaces(image, 8.0)
    noise = np.random.default_rng(1)
    found = np.where(bare, noise.uniform(1, 6, SIZE), ranges * (1 + 0.004 * noise.standard_normal(SIZE)))
    chance = bare & (noise.random(SIZE) < 0.3)  # confirmed by chance
    return image, ranges, bare, as_map(found, np.where(bare & ~chance, HIDDEN, TRUSTED))


def bad_share(ranges: NDArray[np.float32], truth: NDArray[np.float32], where: NDArray[np.bool_]) -> float:
    return float((~(np.abs(ranges / truth - 1) < 0.05))[where].mean())


def test_a_plane_is_found_among_outliers() -> None:
    noise = rng()
    rays = noise.normal(size=(400, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    plane = np.array([0.3, -0.5, 0.2])
    rays = rays[rays @ plane > 0.1]
    inverse = rays @ plane * (1 + 0.003 * noise.standard_normal(len(rays)))
    outlier = np.arange(len(rays)) % 5 < 3
    inverse[outlier] = noise.uniform(0.1, 1, outlier.sum())
    found, on_plane = fit_plane(rays, inverse, max_relative_error=0.02, rng=rng())
    np.testing.assert_allclose(found, plane, atol=5e-3)
    assert on_plane[~outlier].all()
    degenerate = fit_plane(np.tile([0.0, 0, 1], (9, 1)), np.ones(9), max_relative_error=0.02, rng=rng())
    assert not degenerate[1].any()


def test_the_ceiling_of_a_white_room_is_found_from_its_outline(white: Wall) -> None:
    image, truth, bare, found = white
    laid = lay_planes(found, image, rng=rng())
    laid.check()
    ceiling = bare & (np.arange(SIZE[0])[:, None] < 25)
    assert bad_share(found.range, truth, ceiling) > 0.8
    assert bad_share(laid.range, truth, ceiling) < 0.02
    assert bad_share(laid.range, truth, bare) < 0.8 * bad_share(found.range, truth, bare)
    moved = laid.range != found.range
    assert not moved[~bare].any(), "what shows texture stays as it is"
    assert set(np.unique(laid.confidence[moved])) <= {63, HIDDEN, TRUSTED}
    wrong = moved & (np.abs(laid.range / found.range - 1) > 0.1)
    assert np.all(laid.confidence[wrong] == 63)


@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (1.4, 0.3, -0.2), (0.2, 2.0, 1.0)])
def test_it_does_not_matter_how_the_camera_is_turned(turn: tuple[float, float, float]) -> None:
    """The ceiling may lie about a pole or across the seam."""
    scene = white_room(turned=False)
    pose = Rigid3(rotation_from_rotvec(turn), np.zeros(3))
    image, truth = render(scene.room, pose, SIZE, supersample=1)
    _, bare = plain_surfaces(image, 8.0)
    ceiling = bare & ((ray_grid(SIZE) @ pose.rotation)[..., 1] < -0.85)
    found = as_map(np.where(bare, 1.9, truth), np.where(bare, HIDDEN, TRUSTED))
    laid = lay_planes(found, image, rng=rng())
    assert bad_share(laid.range, truth, ceiling) < 0.03


def test_textured_surfaces_and_balls_are_left_alone() -> None:
    image, truth = render(default_room(), Rigid3.identity(), SIZE, supersample=1)
    found = as_map(truth * (1 + 0.05 * rng().standard_normal(SIZE)), TRUSTED)
    np.testing.assert_array_equal(lay_planes(found, image, rng=rng()).range, found.range)
    plain = np.full((*SIZE, 3), 128, np.uint8)
    sphere = as_map(np.full(SIZE, 2.0), TRUSTED)
    np.testing.assert_array_equal(lay_planes(sphere, plain, rng=rng()).range, sphere.range)


def test_an_unclear_ceiling_is_parallel_to_the_floor() -> None:
    """Of its reliable pixels, 31 % lie on a tilted plane by chance, and 29 % on the true one."""
    noise = np.random.default_rng(3)
    image = noise.integers(0, 256, (*SIZE, 3), np.uint8)
    floor, ceiling = (slice(92, 116), slice(60, 200)), (slice(12, 36), slice(60, 200))
    for patch in (floor, ceiling):
        image[patch] = 150
    rays = ray_grid(SIZE)
    found = np.full(SIZE, np.nan)
    found[80:], found[:48] = 1 / (rays[80:] @ (0.0, 1 / 1.5, 0.0)), 1 / (rays[:48] @ (0.0, -1 / 2.0, 0.0))
    truth, kind = found.copy(), noise.random(SIZE)
    tilted = 1 / (rays @ (0.05, -0.4, 0.0))
    upper = np.arange(SIZE[0])[:, None] < 48
    found = np.where(upper & (kind < 0.31), tilted, found)
    found = np.where(upper & (kind > 0.6), noise.uniform(2.5, 12, SIZE), found)

    def bad_ceiling(**settings: Any) -> float:
        laid = lay_planes(as_map(found, TRUSTED), image, rng=rng(), **settings)
        inner = np.zeros(SIZE, bool)
        inner[15:33, 64:196] = True
        return bad_share(laid.range, truth, inner)

    assert bad_ceiling(parallel_share=0.0) > 0.5
    assert bad_ceiling() < 0.02
    assert bad_ceiling(parallel_share=0.2) > 0.5, "planes with a larger share are left alone"


def test_a_wall_is_not_carried_on_into_the_sky() -> None:
    """A plain patch above a wall: all that is seen around it lies on one plane, but on one side of it alone."""
    image = np.random.default_rng(2).integers(0, 256, (*SIZE, 3), np.uint8)
    image[30:46, 104:152] = 200
    wall = np.full(SIZE, np.nan)
    wall[24:70, 98:158] = 1 / (ray_grid(SIZE) @ (0.0, 0.0, 1 / 8.0))[24:70, 98:158]
    sky = np.zeros(SIZE, bool)
    sky[34:42, 108:148] = True
    below, around = wall.copy(), np.where(sky, np.nan, wall)
    below[:42] = np.nan
    assert not lay_planes(as_map(below, TRUSTED), image, rng=rng(), max_hole_deg=0).valid[sky].any()
    laid = lay_planes(as_map(around, TRUSTED), image, rng=rng(), max_hole_deg=0)
    np.testing.assert_allclose(laid.range[sky], wall[sky], rtol=1e-3)


def test_small_holes_of_a_plane_are_filled_and_large_ones_only_when_asked(white: Wall) -> None:
    image, truth, bare, _ = white
    hole = bare & (np.arange(SIZE[0])[:, None] < 25)
    found = as_map(np.where(hole, np.nan, truth), TRUSTED)
    assert not lay_planes(found, image, rng=rng()).valid[hole].all()
    filled = lay_planes(found, image, rng=rng(), max_hole_deg=0)
    assert bad_share(filled.range, truth, hole) < 0.02
    assert np.all(filled.confidence[hole & filled.valid] == 63)
