"""Scores of rendered meshes: equal pictures, known noise, and a mesh with coloured vertices against a textured one."""

from __future__ import annotations

import numpy as np
import pytest
from held_out_meshes import held_out_scores, picture_scores, rendered_panorama
from numpy.typing import NDArray

from pano_mvs.algorithms.mesh.atlas import unwrapped
from pano_mvs.algorithms.mesh.surface import Mesh
from pano_mvs.algorithms.mesh.texture import balanced_views, textured
from pano_mvs.algorithms.mesh.view_quality import PaintView
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3, pixel_from_ray, roll_panorama, sample_panorama
from pano_mvs.testing.room import Room, render
from pano_mvs.testing.surfaces import Cuboid
from tests.algorithms.mesh.box import HALF, WALL_COLORS, box, poses


def noisy(picture: NDArray[np.uint8], sigma: float) -> NDArray[np.uint8]:
    noise = np.random.default_rng(3).normal(0, sigma, picture.shape)
    return np.clip(np.rint(picture + noise), 0, 255).astype(np.uint8)


def grey(value: int = 128) -> NDArray[np.uint8]:
    return np.full((64, 128, 3), value, np.uint8)


def test_equal_pictures_have_the_highest_scores() -> None:
    picture = noisy(grey(), 30)
    scores = picture_scores(picture, picture)
    assert scores.psnr_db == np.inf
    assert scores.ssim == pytest.approx(1)
    assert scores.share == pytest.approx(1)


def test_the_psnr_is_that_of_the_noise() -> None:
    """20 log10(255 / σ), and 1/12 of rounding: σ = 8."""
    assert picture_scores(noisy(grey(), 8), grey()).psnr_db == pytest.approx(30.07, abs=0.1)
    assert picture_scores(grey(138), grey()).psnr_db == pytest.approx(20 * np.log10(25.5))


def test_the_ssim_is_that_of_its_definition() -> None:
    """On constant pictures it is (2ab + c) / (a² + b² + c); unrelated noise has none."""
    c = (0.01 * 255) ** 2
    expected = (2 * 100 * 150 + c) / (100**2 + 150**2 + c)
    assert picture_scores(grey(100), grey(150)).ssim == pytest.approx(expected, abs=1e-6)
    other = np.random.default_rng(9).integers(0, 256, (64, 128, 3)).astype(np.uint8)
    assert abs(picture_scores(noisy(grey(), 60), other).ssim) < 0.2


def test_pixels_that_do_not_count_change_nothing_but_the_share() -> None:
    picture, counted = grey(), np.ones((64, 128), np.bool_)
    picture[:32], counted[:32] = 0, False
    scores = picture_scores(picture, grey(), compared=counted)
    assert scores.psnr_db == np.inf
    assert scores.share == pytest.approx(0.5)
    with pytest.raises(UsageError, match="no pixel is compared"):
        picture_scores(picture, grey(), compared=~counted & counted)
    with pytest.raises(UsageError, match="pictures of one size are compared"):
        picture_scores(picture, grey()[:32])


def test_scores_do_not_see_the_seam() -> None:
    first, second = noisy(grey(), 40), noisy(grey(140), 45)
    rolled = picture_scores(roll_panorama(first, 31)[0], roll_panorama(second, 31)[0])
    scores = picture_scores(first, second)
    assert rolled.ssim == pytest.approx(scores.ssim)
    assert rolled.psnr_db == pytest.approx(scores.psnr_db)


def test_a_mesh_with_one_color_per_wall_is_rendered_exactly() -> None:
    vertices, faces, wall = box(2)
    colors = np.zeros((len(vertices), 3), np.uint8)
    colors[faces] = WALL_COLORS[wall][:, None]
    picture, covered = rendered_panorama(
        Mesh(vertices, colors, faces), Rigid3.identity(), size_hw=(32, 64), supersampling=2
    )
    assert covered.all()
    assert picture[0, 0].tolist() == WALL_COLORS[2].tolist()
    assert picture[31, 0].tolist() == WALL_COLORS[3].tolist()
    assert picture[16, 32].tolist() == WALL_COLORS[5].tolist()
    assert picture[16, 48].tolist() == WALL_COLORS[1].tolist()
    hole = Mesh(vertices, colors, faces[wall != 5])
    scores = held_out_scores(hole, Rigid3.identity(), picture)
    assert scores.covered is not None
    assert scores.covered.psnr_db > 40
    assert 0.7 < scores.covered.share < 0.95
    assert scores.everywhere.psnr_db < 25


def test_texture_shows_more_than_vertices() -> None:
    """A room with strong texture, the true surface with few triangles, at a pose without a panorama."""
    half = tuple(HALF)
    room = Room((Cuboid((-half[0], -half[1], -half[2]), half, ((0.9, 0.2, 0.2), (0.1, 0.3, 0.8))),))
    vertices, faces, _ = box(8)
    views = [
        PaintView(pose, render(room, pose, (64, 128), supersample=2)[0], np.ones((64, 128), np.bool_))
        for pose in poses(4)
    ]
    balance = balanced_views(vertices, faces, views[:3].__getitem__, views=3)
    atlas = unwrapped(vertices, faces, texels_per_unit=1.5 * balance.density, max_px=512)
    made = textured(vertices, faces, atlas, load=views[:3].__getitem__, balance=balance)
    pose, truth = views[3].cam_from_world, views[3].picture
    at_vertices = sample_panorama(truth, pixel_from_ray(pose.apply(vertices), (64, 128)))
    plain = Mesh(vertices, np.rint(at_vertices).astype(np.uint8), faces)
    with_texture, with_vertices = (held_out_scores(mesh, pose, truth) for mesh in (made, plain))
    assert with_texture.everywhere.psnr_db > with_vertices.everywhere.psnr_db + 3
    assert with_texture.everywhere.ssim > with_vertices.everywhere.ssim + 0.1
