"""Meshes: compiled loops equal plain numpy, and parts that panoramas look through are removed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.mesh.atlas import Texels
from pano_mvs.algorithms.mesh.surface import FreeSpace, decimated
from pano_mvs.algorithms.mesh.view_quality import surface_view, vertex_normals
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3
from pano_mvs.scene import RangeMap
from tests.algorithms.mesh.box import BOARD, Capture, box, capture, poses
from tests.oracles.surfaces import nearest_triangles, texel_looks

SIZE = (16, 32)


@pytest.mark.kernel("mesh.kernels_mesh")
@pytest.mark.parametrize("threads", [1, 2])
def test_nearest_triangles_are_those_of_ray_casting(threads: int) -> None:
    """Also across the seam and at the poles, which are inside triangles for the first camera."""
    vertices, faces, _ = box(2, board=True)
    for pose in [Rigid3.identity(), *poses(2)]:
        view = surface_view(vertices, faces, pose, size_hw=SIZE, threads=threads)
        corners = pose.apply(vertices)[faces]
        ranges, triangle = nearest_triangles(corners, SIZE)
        np.testing.assert_allclose(view.ranges, ranges, rtol=1e-5)
        on = view.triangle >= 0
        assert on.all()
        weights = np.concatenate([1 - view.weights.sum(axis=-1, keepdims=True), view.weights], axis=-1)
        points = np.einsum("hwk,hwkc->hwc", weights, corners[view.triangle])
        np.testing.assert_allclose(np.linalg.norm(points, axis=-1), ranges, rtol=1e-5)
        assert (view.triangle == triangle).mean() > 0.9  # the others are at common edges


@pytest.mark.kernel("mesh.kernels_mesh")
def test_without_a_surface_the_range_is_infinite() -> None:
    vertices, faces, wall = box(1)
    view = surface_view(vertices, faces[wall == 5], Rigid3.identity(), size_hw=SIZE)
    assert np.isinf(view.ranges[0]).all()
    assert np.isfinite(view.ranges[SIZE[0] // 2, SIZE[1] // 2])
    np.testing.assert_array_equal(np.isinf(view.ranges), view.triangle < 0)


@pytest.mark.kernel("mesh.kernels_mesh")
def test_looks_are_those_of_numpy() -> None:
    from pano_mvs.algorithms.mesh.kernels_mesh import look_at_texels

    shown = capture(poses(1), board=True, size_hw=SIZE, steps=2)
    vertices, faces, _ = shown.surface
    pose = shown.views[0].cam_from_world
    rng = np.random.default_rng(2)
    count = 300
    weights = rng.dirichlet([1, 1, 1], count)[:, 1:].astype(np.float32)
    texels = Texels(np.arange(count, dtype=np.int32), rng.integers(0, len(faces), count).astype(np.int32), weights)
    ranges = surface_view(vertices, faces, pose, size_hw=SIZE).ranges
    quality = rng.uniform(0.1, 1, SIZE).astype(np.float32)
    quality[rng.random(SIZE) < 0.02] = 0
    picture = rng.integers(0, 256, (*SIZE, 3)).astype(np.uint8)
    smooth = rng.uniform(0, 255, (*SIZE, 3)).astype(np.float32)
    mesh = pose.apply(vertices), vertex_normals(vertices, faces) @ pose.rotation.T, faces
    view = ranges, quality, picture, smooth
    out = np.ones(count, np.float32), np.zeros((count, 3), np.float32), np.zeros((count, 3), np.float32)
    look_at_texels((texels.triangle, texels.weights), mesh, view, (0, count), out)
    expected = texel_looks(texels, mesh, view)
    np.testing.assert_allclose(out[0], expected[0], rtol=1e-4, atol=1e-7)
    seen = out[0] > 0
    assert 0.3 < seen.mean() < 0.95
    for found, wanted in zip(out[1:], expected[1:], strict=True):
        np.testing.assert_allclose(found[seen], wanted[seen], atol=0.01)


def test_only_full_spheres_are_drawn() -> None:
    vertices, faces, _ = box(1)
    with pytest.raises(UsageError, match="a panorama is twice as wide as high"):
        surface_view(vertices, faces, Rigid3.identity(), size_hw=(16, 16))


def free(shown: Capture, maps: list[RangeMap]) -> NDArray[np.bool_]:
    """Which vertices of the box with the board are free, by panoramas of the box without it."""
    vertices, _, _ = box(4, board=True)
    space = FreeSpace(vertices)
    for view, range_map in zip(shown.views, maps, strict=True):
        space.add(range_map, view.cam_from_world, view.valid)
    return space.free()


def given_maps(shown: Capture) -> list[RangeMap]:
    return [view.range_map for view in shown.views if view.range_map is not None]


def on_board() -> NDArray[np.bool_]:
    vertices, faces, wall = box(4, board=True)
    on = np.zeros(len(vertices), np.bool_)
    on[faces[wall == BOARD]] = True
    return on


def test_a_board_that_is_not_there_is_removed_and_walls_stay() -> None:
    shown = capture(poses(3))
    found = free(shown, given_maps(shown))
    assert found[on_board()].all()
    assert not found[~on_board()].any()


def test_one_panorama_or_weak_ranges_remove_nothing() -> None:
    shown = capture(poses(3))
    maps = given_maps(shown)
    weak = [replace(one, confidence=np.full_like(one.confidence, 90)) for one in maps]
    assert not free(shown, weak).any()
    assert not free(shown, [maps[0], *weak[1:]]).any()


def test_one_panorama_that_sees_the_sky_is_enough() -> None:
    """The board is between the camera and the sky."""
    shown = capture(poses(1))
    size_hw = shown.views[0].valid.shape
    sky = RangeMap(np.full(size_hw, np.nan, np.float32), np.zeros(size_hw, np.uint8), sky=np.ones(size_hw, np.bool_))
    assert free(shown, [sky]).all()


def test_what_a_panorama_confirms_stays() -> None:
    """Two panoramas look through the board, a third one sees it."""
    shown = capture(poses(3))
    with_board = capture(poses(3), board=True)
    maps = [*given_maps(shown)[:2], given_maps(with_board)[2]]
    assert free(shown, maps)[on_board()].mean() < 0.5


def test_masks_must_fit() -> None:
    shown = capture(poses(1))
    with pytest.raises(UsageError, match="a mask of"):
        FreeSpace(box(1)[0]).add(given_maps(shown)[0], shown.views[0].cam_from_world, np.ones((4, 8), np.bool_))


def test_decimation_keeps_the_shape_and_reaches_its_number() -> None:
    vertices, faces, _ = box(16)
    fewer, triangles = decimated(vertices, faces, triangles=100)
    assert 12 <= len(triangles) <= 100
    np.testing.assert_allclose(np.abs(fewer).max(axis=0), np.abs(vertices).max(axis=0), atol=1e-4)
    assert triangles.max() == len(fewer) - 1
    same, unchanged = decimated(vertices, faces, triangles=10**6)
    np.testing.assert_array_equal(same[unchanged], vertices[faces])
