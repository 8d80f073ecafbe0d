"""Texels have the colours of the walls on which they lie, whatever is in front of them or masked."""

from __future__ import annotations

import hashlib
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.mesh import atlas as atlas_module
from pano_mvs.algorithms.mesh.atlas import Atlas, texels_of, unwrapped
from pano_mvs.algorithms.mesh.texture import TexturedMesh, balanced_views, textured
from pano_mvs.algorithms.mesh.view_quality import PaintView
from pano_mvs.core.errors import UsageError
from tests.algorithms.mesh.box import BOARD, BOARD_COLOR, HALF, WALL_COLORS, Capture, capture, poses

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


def test_the_result_is_the_same_again_and_with_threads() -> None:
    shown = capture(poses(2))
    digests = {
        hashlib.sha256(mesh.texture.tobytes() + mesh.seen.tobytes() + mesh.atlas.uv.tobytes()).hexdigest()
        for mesh in (painted(shown), painted(shown), painted(shown, threads=3))
    }
    assert len(digests) == 1


def test_gaps_between_charts_continue_the_charts() -> None:
    shown = capture(poses(2))
    mesh = painted(shown)
    known = {tuple(color) for color in mesh.texture.reshape(-1, 3)[texels_of(mesh.atlas).pixel].tolist()}
    assert {tuple(color) for color in mesh.texture.reshape(-1, 3).tolist()} == known


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
