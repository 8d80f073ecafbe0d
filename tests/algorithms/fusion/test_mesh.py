"""The surface through a cloud: near the walls, closed, and cut off where no points are."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import pyvista

from pano_mvs.algorithms.mesh import surface
from pano_mvs.algorithms.mesh.surface import (
    Mesh,
    point_spacings,
    poisson_depth,
    solve_poisson,
    trimmed_mesh,
    without_crumbs,
)
from pano_mvs.api import Context, InputError, PointCloud
from pano_mvs.io.ply import read_ply_mesh, write_ply, write_ply_mesh
from pano_mvs.stages.exports.mesh import MeshParams, mesh

HALF_SIZE = np.array([2.0, 1.2, 1.6])
WINDOW = np.array([2.0, 0.0, 0.0]), 0.7  # the middle of a wall, and how far around it there are no points


def room_cloud(count: int = 6_000, *, window: bool = True) -> PointCloud:
    """Points on the inner walls of a box, each wall of its own colour; none in a window; normals look inwards."""
    rng = np.random.default_rng(1)
    areas = np.repeat(np.prod(HALF_SIZE) / HALF_SIZE, 2)
    wall = rng.choice(6, count, p=areas / areas.sum())
    axis, sign = wall // 2, np.where(wall % 2, 1.0, -1.0)
    points = rng.uniform(-1, 1, (count, 3)) * HALF_SIZE
    each = np.arange(count)
    points[each, axis] = sign * HALF_SIZE[axis]
    normals = np.zeros((count, 3))
    normals[each, axis] = -sign
    colors = np.array([[200, 0, 0], [0, 200, 0], [0, 0, 200], [200, 200, 0], [0, 200, 200], [200, 0, 200]], np.uint8)
    seen = np.abs(points - WINDOW[0]).max(axis=1) > (WINDOW[1] if window else -1)
    return PointCloud(
        points[seen].astype(np.float32),
        normals[seen].astype(np.float32),
        colors[wall[seen]],
        np.full(seen.sum(), 3, np.uint8),
        np.full(seen.sum(), 200, np.uint8),
    )


def distance_to_walls(points: np.ndarray) -> np.ndarray:
    beyond = np.abs(points) - HALF_SIZE
    outside = np.linalg.norm(np.maximum(beyond, 0), axis=1)
    result: np.ndarray = np.where(outside > 0, outside, -beyond.max(axis=1))
    return result


def context(folder: Path) -> Context:
    return Context(np.random.default_rng(0), folder)


@pytest.fixture(scope="module")
def trimmed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("mesh")
    return mesh(room_cloud(), None, MeshParams(), context(folder)).files["mesh.ply"]


def test_vertices_lie_on_the_walls_and_none_in_the_window(trimmed: Path) -> None:
    vertices, colors, faces = read_ply_mesh(trimmed)
    off = distance_to_walls(vertices)
    assert np.median(off) < 0.01
    assert np.quantile(off, 0.95) < 0.03
    in_window = np.abs(vertices - WINDOW[0]).max(axis=1) < 0.5 * WINDOW[1]
    assert not in_window.any()
    corners = vertices[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2
    walls = 8 * (np.prod(HALF_SIZE) / HALF_SIZE).sum() - (2 * WINDOW[1]) ** 2
    assert 0.93 < area / walls < 1.04
    near_left = vertices[:, 0] < -1.9
    assert np.median(np.abs(colors[near_left].astype(int) - (200, 0, 0)).sum(axis=1)) < 12


def test_triangles_face_the_side_that_was_seen(trimmed: Path) -> None:
    vertices, _, faces = read_ply_mesh(trimmed)
    corners = vertices[faces].astype(np.float64)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inwards = (normals * -corners.mean(axis=1)).sum(axis=1) > 0
    assert inwards.mean() > 0.99


def test_another_program_reads_it_and_finds_one_hole(trimmed: Path) -> None:
    """VTK: all open edges are those around the window."""
    read = pyvista.read(trimmed)
    vertices, colors, faces = read_ply_mesh(trimmed)
    np.testing.assert_array_equal(read.points, vertices[:, [0, 2, 1]] * [1, 1, -1])  # the file has z up
    np.testing.assert_array_equal(read.regular_faces, faces)
    np.testing.assert_array_equal(read["RGB"], colors)
    edges = read.extract_feature_edges(
        boundary_edges=True, non_manifold_edges=True, feature_edges=False, manifold_edges=False
    )
    assert edges.n_points > 0
    assert np.abs(edges.points - WINDOW[0]).max(axis=1).max() < 1.5 * WINDOW[1]


@pytest.mark.slow
def test_untrimmed_it_is_closed(tmp_path: Path) -> None:
    params = MeshParams(trim=0, depth=5, max_points=3000)
    read = pyvista.read(mesh(room_cloud(window=False), None, params, context(tmp_path)).files["mesh.ply"])
    assert read.is_manifold
    assert read.n_open_edges == 0


@pytest.mark.parametrize("count", [0, 1, 99])
def test_too_few_points_are_refused_with_the_remedy(tmp_path: Path, count: int) -> None:
    with pytest.raises(InputError, match=r"\d+ of \d+ points (is|are) left for a mesh; 100 are needed"):
        mesh(room_cloud(count), None, MeshParams(), context(tmp_path))


@pytest.mark.slow
def test_points_without_a_surface_are_refused(tmp_path: Path) -> None:
    """All in one place: the solver gives a file without faces."""
    count = 200
    same = PointCloud(
        np.ones((count, 3), np.float32),
        np.tile(np.array([0, 0, 1], np.float32), (count, 1)),
        np.zeros((count, 3), np.uint8),
        np.full(count, 3, np.uint8),
    )
    with pytest.raises(InputError, match="the mesh has no faces"):
        mesh(same, None, MeshParams(max_points=0), context(tmp_path))


def test_a_solver_that_crashes_is_an_error_of_ours(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Natively, as COLMAP's own trimming does on an empty surface: the process goes on."""
    monkeypatch.setattr(surface, "_SOLVE", "import os, signal; os.kill(os.getpid(), signal.SIGKILL)")
    write_ply(tmp_path / "cloud.ply", room_cloud(200))
    with pytest.raises(InputError, match=r"the Poisson solver ended with code -9 at depth 6: try another `depth`"):
        solve_poisson(tmp_path / "cloud.ply", tmp_path, depth=6, point_weight=1.0)


def test_the_depth_follows_the_spacing() -> None:
    points = np.stack(np.meshgrid(*[np.arange(33, dtype=np.float32)] * 3), axis=-1).reshape(-1, 3)
    assert poisson_depth(points, 1.0) == 6
    assert poisson_depth(100 * points, 100.0) == 6
    assert poisson_depth(points, 1e-9) == 12
    assert poisson_depth(points, 1e9) == 5


def test_trimming_follows_the_density_and_strays_keep_little() -> None:
    line = np.zeros((101, 3), np.float32)
    line[:100, 0] = np.arange(100)
    line[100] = (0, 1e6, 0)
    assert point_spacings(line)[50] == 2
    assert point_spacings(line)[100] == 20
    vertices = np.array([[50, 3, 0], [51, 3, 0], [50.5, 3.9, 0], [50, 9, 0], [39, 1e6, 0], [41, 1e6, 0]], np.float32)
    whole = Mesh(vertices, np.zeros((6, 3), np.uint8), np.array([[0, 1, 2], [0, 1, 3], [4, 4, 4], [5, 5, 5]], np.int32))
    kept = trimmed_mesh(whole, line, max_spacings=2)
    np.testing.assert_array_equal(kept.vertices_in_world, vertices[[0, 1, 2, 4]])
    np.testing.assert_array_equal(kept.faces, [[0, 1, 2], [3, 3, 3]])


def test_crumbs_go() -> None:
    faces = np.array([[0, 1, 2], [1, 2, 3], [2, 3, 4], [5, 6, 7]], np.int32)
    whole = Mesh(np.zeros((9, 3), np.float32), np.zeros((9, 3), np.uint8), faces)
    np.testing.assert_array_equal(without_crumbs(whole, smallest_share=0.5).faces, faces[:3])
    assert len(without_crumbs(whole, smallest_share=0.2).faces) == 4
    none = Mesh(whole.vertices_in_world, whole.colors_rgb, faces[:0])
    assert len(without_crumbs(none, smallest_share=0.2).faces) == 0


def test_other_files_are_no_meshes(tmp_path: Path) -> None:
    arrays = np.zeros((3, 3), np.float32), np.zeros((3, 3), np.uint8), np.array([[0, 1, 2]], np.int32)
    write_ply_mesh(tmp_path / "a.ply", arrays)
    whole = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "cut.ply").write_bytes(whole[:-1])
    (tmp_path / "quad.ply").write_bytes(whole[:-13] + b"\x04" + whole[-12:])
    write_ply(tmp_path / "cloud.ply", room_cloud(10))
    for name, what in (
        ("gone", "cannot be read"),
        ("cut", "states 3 vertices and 1 faces"),
        ("quad", "not all of its faces"),
        ("cloud", "not a PLY mesh"),
    ):
        with pytest.raises(InputError, match=rf"{name}\.ply: .*{what}"):
            read_ply_mesh(tmp_path / f"{name}.ply")
