"""Meshes: compiled loops equal plain numpy.

Texels have the colours of the walls on which they lie, whatever is in front of them or masked.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.mesh import atlas as atlas_module
from pano_mvs.algorithms.mesh.atlas import Atlas, Texels, texels_of, unwrapped
from pano_mvs.algorithms.mesh.surface import decimated
from pano_mvs.algorithms.mesh.texture import TexturedMesh, balanced_views, textured
from pano_mvs.algorithms.mesh.view_quality import PaintView, face_normals, surface_view
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3
from tests.algorithms.mesh.box import BOARD, BOARD_COLOR, HALF, WALL_COLORS, Capture, box, capture, poses
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
    mesh = pose.apply(vertices), face_normals(vertices, faces) @ pose.rotation.T, faces
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


def test_decimation_keeps_the_shape_and_reaches_its_number() -> None:
    vertices, faces, _ = box(16)
    fewer, triangles = decimated(vertices, faces, triangles=100)
    assert 12 <= len(triangles) <= 100
    np.testing.assert_allclose(np.abs(fewer).max(axis=0), np.abs(vertices).max(axis=0), atol=1e-4)
    assert triangles.max() == len(fewer) - 1
    same, unchanged = decimated(vertices, faces, triangles=10**6)
    np.testing.assert_array_equal(same[unchanged], vertices[faces])


TEXELS_PER_UNIT = 24.0


def painted(shown: Capture, *, threads: int = 1) -> TexturedMesh:
    vertices, faces, _ = shown.surface
    balance = balanced_views(vertices, faces, shown.load, views=len(shown.views), threads=threads)
    atlas = unwrapped(vertices, faces, texels_per_unit=TEXELS_PER_UNIT, max_px=512)
    return textured(vertices, faces, atlas, load=shown.load, balance=balance, threads=threads)


def texel_places(mesh: TexturedMesh) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
    """The triangle and the position in the world of each texel."""
    texels = texels_of(mesh.atlas)
    weights = np.column_stack([1 - texels.weights.sum(axis=1), texels.weights])
    return texels.triangle, np.einsum("tk,tkc->tc", weights, mesh.vertices_in_world[mesh.faces[texels.triangle]])


def texel_colors(mesh: TexturedMesh) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    pixel = texels_of(mesh.atlas).pixel
    return mesh.texture.reshape(-1, 3)[pixel].astype(np.int64), mesh.seen.ravel()[pixel]


def inside_wall(points: NDArray[np.float64], wall: NDArray[np.int64], margin: float) -> NDArray[np.bool_]:
    """Which points of the walls are not near another wall."""
    near = np.abs(points) > HALF - margin
    near[np.arange(len(points)), np.minimum(wall, 5) // 2] = False
    return np.asarray(~near.any(axis=1))


def test_texels_have_the_colors_of_their_walls() -> None:
    shown = capture(poses())
    mesh = painted(shown)
    triangle, points = texel_places(mesh)
    wall = shown.surface[2][triangle]
    colors, seen = texel_colors(mesh)
    assert seen.mean() > 0.99
    away = seen & inside_wall(points, wall, 0.35)
    off = np.abs(colors - WALL_COLORS[wall]).max(axis=1)
    assert off[away].max() <= 3
    assert np.median(off) <= 1


def test_a_wall_behind_a_board_is_not_painted_by_the_board() -> None:
    """The board is white; behind it is a part of the wall +z that only some cameras see, from the side."""
    shown = capture(poses(), board=True)
    mesh = painted(shown)
    triangle, points = texel_places(mesh)
    wall = shown.surface[2][triangle]
    colors, seen = texel_colors(mesh)
    behind = (wall == 5) & (np.abs(points[:, :2]) < (0.9, 0.8)).all(axis=1)
    assert (~seen[behind]).sum() > 20  # nobody sees these
    assert np.abs(colors[behind] - WALL_COLORS[5]).max() <= 8  # filled from the wall around
    on_board = (wall == BOARD) & (np.abs(points[:, :2]) < (0.35, 0.25)).all(axis=1)
    assert seen[on_board].mean() > 0.9
    assert np.abs(colors[on_board & seen] - BOARD_COLOR).max() <= 3


def with_tripod(view: PaintView, content: int) -> PaintView:
    """Mask what lies below 50° in the camera, and show something there."""
    picture, valid = view.picture.copy(), view.valid.copy()
    first = len(valid) * 140 // 180
    picture[first:], valid[first:] = content, False
    return replace(view, picture=picture, valid=valid)


@pytest.mark.parametrize("content", [0, 255])
def test_masked_content_is_never_painted(content: int) -> None:
    """All cameras mask their nadir: nobody sees the floor there, and it has the colour of the floor around."""
    upright = [pose.__class__.from_center(np.eye(3), pose.center) for pose in poses()]
    shown = capture(upright)
    shown.views[:] = [with_tripod(view, content) for view in shown.views]
    mesh = painted(shown)
    triangle, points = texel_places(mesh)
    wall = shown.surface[2][triangle]
    colors, seen = texel_colors(mesh)
    floor = (wall == 3) & inside_wall(points, wall, 0.35)
    assert (~seen[floor]).sum() > 100
    assert np.abs(colors[floor] - WALL_COLORS[3]).max() <= 3


def test_exposures_are_matched() -> None:
    """One camera with half the light: the walls have one colour each, without a seam."""
    shown = capture(poses(), steps=12)
    dark = shown.views[1]
    shown.views[1] = replace(dark, picture=np.rint(dark.picture * 0.6).astype(np.uint8))
    mesh = painted(shown)
    triangle, points = texel_places(mesh)
    wall = shown.surface[2][triangle]
    colors, seen = texel_colors(mesh)
    for number in range(6):
        own = seen & (wall == number) & inside_wall(points, wall, 0.35)
        assert np.ptp(colors[own], axis=0).max() <= 8
        ratio = colors[own].mean(axis=0).max() / 200
        assert 0.7 < ratio < 1.05


def test_a_passer_by_in_one_panorama_leaves_no_trace() -> None:
    """The panorama measured a near range where the mesh has the wall: others see the wall better."""
    shown = capture(poses())
    view = shown.views[0]
    assert view.range_map is not None
    picture, ranges = view.picture.copy(), view.range_map.range.copy()
    picture[20:44, 40:60], ranges[20:44, 40:60] = 0, 0.5
    shown.views[0] = replace(view, picture=picture, range_map=replace(view.range_map, range=ranges))
    mesh = painted(shown)
    triangle, points = texel_places(mesh)
    wall = shown.surface[2][triangle]
    colors, seen = texel_colors(mesh)
    away = seen & inside_wall(points, wall, 0.3)
    assert np.abs(colors - WALL_COLORS[wall]).max(axis=1)[away].max() < 40


def test_gaps_between_charts_continue_the_charts() -> None:
    shown = capture(poses(2))
    mesh = painted(shown)
    known = {tuple(color) for color in mesh.texture.reshape(-1, 3)[texels_of(mesh.atlas).pixel].tolist()}
    assert {tuple(color) for color in mesh.texture.reshape(-1, 3).tolist()} == known


@pytest.mark.parametrize("scale", [1e-4, 1e4])
def test_the_atlas_does_not_depend_on_the_unit(scale: float) -> None:
    """Surfaces in small units once had a texture of one texel."""
    vertices, faces, _ = capture([]).surface
    expected = unwrapped(vertices, faces, texels_per_unit=TEXELS_PER_UNIT, max_px=512)
    atlas = unwrapped(vertices * np.float32(scale), faces, texels_per_unit=TEXELS_PER_UNIT / scale, max_px=512)
    assert max(expected.size_hw) > 100
    np.testing.assert_allclose(atlas.size_hw, expected.size_hw, rtol=0.1)


@pytest.mark.parametrize("triangles_of_part", [50, 1000])
def test_the_atlas_keeps_the_triangles_and_its_limit(monkeypatch: pytest.MonkeyPatch, triangles_of_part: int) -> None:
    monkeypatch.setattr(atlas_module, "_TRIANGLES_OF_PART", triangles_of_part)
    vertices, faces, _ = capture([]).surface
    assert len(faces) > 150
    atlas = unwrapped(vertices, faces, texels_per_unit=1e4, max_px=100)
    assert max(atlas.size_hw) <= 100
    np.testing.assert_array_equal(atlas.vertex[atlas.faces], faces)
    assert atlas.uv.min() >= 0
    assert atlas.uv.max() <= 1
    assert isinstance(atlas, Atlas)
    assert set(texels_of(atlas).triangle) == set(range(len(faces)))


def test_pictures_and_ranges_must_have_one_size() -> None:
    shown = capture(poses(1))
    shown.views[0] = replace(shown.views[0], valid=np.ones((8, 16), np.bool_))
    with pytest.raises(UsageError, match=r"a picture of .* with a mask of"):
        painted(shown)
