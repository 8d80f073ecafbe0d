"""Compiled loops for meshes equal plain numpy."""

from __future__ import annotations

import numpy as np
import pytest

from pano_mvs.algorithms.mesh.atlas import Texels
from pano_mvs.algorithms.mesh.visibility import surface_view, vertex_normals
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3
from tests.algorithms.mesh.box import box, capture, poses
from tests.oracles.mesh import nearest_triangles, texel_looks

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
