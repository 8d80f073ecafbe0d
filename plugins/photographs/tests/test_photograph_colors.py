"""Photographs colour a cloud where they see it, and become those of pinhole cameras."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from pano_mvs_photographs.camera import PhotographCamera
from pano_mvs_photographs.colors import PhotographColors, PhotographColorSettings

from pano_mvs.algorithms.fusion.fuse import join_clouds
from pano_mvs.algorithms.undistortion import undistorted_photograph
from pano_mvs.geometry import Rigid3, rotation_from_rotvec
from pano_mvs.scene import PointCloud
from pano_mvs.testing.room import default_room
from tests.synthetic.photograph import render_photograph

SIZE_HW, FOCAL_PX = (240, 320), 300.0
CAMERA = PhotographCamera(Rigid3.identity(), FOCAL_PX, 0.0)


def wall(z: float, half_xy: tuple[float, float], step: float = 0.01) -> PointCloud:
    """Return a grey wall before the camera."""
    x, y = np.meshgrid(np.arange(-half_xy[0], half_xy[0], step), np.arange(-half_xy[1], half_xy[1], step))
    points = np.stack([x.ravel(), y.ravel(), np.full(x.size, z)], axis=-1).astype(np.float32)
    normals = np.tile(np.array([0, 0, -1], np.float32), (len(points), 1))
    return PointCloud(points, normals, np.full((len(points), 3), 128, np.uint8), np.full(len(points), 2, np.uint8))


def stripes() -> NDArray[np.uint8]:
    """Return a photograph with stripes that differ by 20 grey levels from their mean."""
    columns = np.where(np.arange(SIZE_HW[1]) // 8 % 2, 148, 108).astype(np.uint8)
    return np.broadcast_to(columns[None, :, None], (*SIZE_HW, 3)).copy()


def colored(cloud: PointCloud, photograph: NDArray[np.uint8], max_difference: float = 60.0) -> NDArray[np.int64]:
    colors = PhotographColors(cloud, PhotographColorSettings(max_difference=max_difference))
    colors.add(photograph, CAMERA)
    return colors.colors_rgb().astype(np.int64)


def test_points_get_the_detail_of_the_photograph() -> None:
    cloud = wall(2.0, (0.8, 0.6))
    pixels = CAMERA.project(cloud.points_in_world.astype(float), SIZE_HW)[0]
    true = stripes()[pixels[:, 1].astype(int), pixels[:, 0].astype(int)].astype(np.int64)
    colors = colored(cloud, stripes())
    middle = np.abs(pixels - 8 * np.rint(pixels / 8))[:, 0] > 3
    inner = middle & (np.abs(pixels - (160, 120)) < (120, 90)).all(axis=1)
    assert inner.sum() > 500
    assert np.median(np.abs(colors[inner] - true[inner])) <= 2
    assert np.median(np.abs(128 - true[inner])) == 20


def test_the_exposure_of_the_photograph_is_matched() -> None:
    cloud, rng = wall(2.0, (0.8, 0.6)), np.random.default_rng(0)
    levels = rng.integers(60, 200, (15, 20, 3)).repeat(16, axis=0).repeat(16, axis=1).astype(np.float64)
    pixels = CAMERA.project(cloud.points_in_world.astype(float), SIZE_HW)[0].astype(int)
    own = levels[pixels[:, 1].clip(0, 239), pixels[:, 0].clip(0, 319)]
    cloud = replace(cloud, colors_rgb=own.astype(np.uint8))
    darker = (255 * (levels / 255) ** 1.2 * np.array([0.7, 0.8, 0.6])).astype(np.uint8)
    assert np.median(np.abs(darker[pixels[:, 1].clip(0, 239), pixels[:, 0].clip(0, 319)] - own)) > 30
    assert np.median(np.abs(colored(cloud, darker) - own)) <= 2


def test_hidden_points_keep_their_colors() -> None:
    before, behind = wall(1.0, (0.2, 0.15)), wall(2.0, (0.3, 0.2))
    cloud = join_clouds([before, behind])
    colors = colored(cloud, stripes())
    assert (colors[: len(before)] != 128).any(axis=1).mean() > 0.8
    assert (colors[len(before) :] == 128).all()


def test_what_looks_different_keeps_its_color() -> None:
    photograph = stripes()
    photograph[80:160, 120:200] = (20, 240, 20)
    cloud = wall(2.0, (0.8, 0.6))
    pixels = CAMERA.project(cloud.points_in_world.astype(float), SIZE_HW)[0]
    covered = (np.abs(pixels - (160, 120)) < 30).all(axis=1)
    assert (colored(cloud, photograph)[covered] == 128).all()


@pytest.mark.parametrize("turned", [False, True])
def test_points_outside_or_seen_from_behind_keep_their_colors(turned: bool) -> None:
    cloud = wall(2.0, (0.8, 0.6))
    cloud = replace(cloud, normals_in_world=-cloud.normals_in_world) if turned else wall(-2.0, (0.8, 0.6))
    colors = PhotographColors(cloud, PhotographColorSettings())
    assert colors.add(stripes(), CAMERA) == 0
    assert colors.colored == 0
    assert (colors.colors_rgb() == 128).all()


TAKEN_HW, TAKEN_PX = (90, 120), 100.0
POSE = Rigid3.from_center(rotation_from_rotvec(np.array([0.1, 0.6, -0.2])), np.array([0.2, 0.1, 0.1]))


@pytest.mark.parametrize("radial", [-0.2, 0.15])
def test_the_result_is_what_a_pinhole_camera_shows(radial: float) -> None:
    taken = render_photograph(default_room(), POSE, TAKEN_HW, focal_px=TAKEN_PX, radial=radial)
    found, focal_px = undistorted_photograph(taken, focal_px=TAKEN_PX, radial=radial)
    expected = render_photograph(default_room(), POSE, TAKEN_HW, focal_px=focal_px).astype(float)
    assert found.shape == taken.shape
    assert np.abs(found - expected).mean() < 0.4 * np.abs(taken - expected).mean()
    moved = np.abs(found[:, 1:] - expected[:, :-1]).mean(), np.abs(found[:, :-1] - expected[:, 1:]).mean()
    assert np.abs(found - expected).mean() < 0.6 * min(moved)


@pytest.mark.parametrize("radial", [-0.25, -0.1, 0.1, 0.4])
@pytest.mark.parametrize("size_hw", [(90, 120), (120, 90)])
def test_every_pixel_is_inside_the_photograph_and_no_field_of_view_is_wasted(
    radial: float, size_hw: tuple[int, int]
) -> None:
    focal_px = undistorted_photograph(np.zeros((*size_hw, 3), np.uint8), focal_px=TAKEN_PX, radial=radial)[1]
    half = np.array(size_hw[::-1]) / 2
    sides = np.linspace(-1, 1, 101)
    border = np.concatenate([np.stack([sides, np.ones(101)], axis=1), np.stack([np.ones(101), sides], axis=1)])
    plane = border * half / focal_px
    seen = np.abs(TAKEN_PX * plane * (1 + radial * (plane**2).sum(axis=1, keepdims=True))) / half
    assert seen.max() <= 1 + 1e-9
    assert seen.max() > 1 - 1e-9


@pytest.mark.parametrize(("taken_px", "radial"), [(60.0, -0.5), (100.0, -0.5)])
def test_strong_distortion_does_not_fold_the_result(taken_px: float, radial: float) -> None:
    focal_px = undistorted_photograph(np.zeros((*TAKEN_HW, 3), np.uint8), focal_px=taken_px, radial=radial)[1]
    radii = np.linspace(0, np.hypot(*TAKEN_HW) / 2 / focal_px, 100)
    assert (np.diff(radii * (1 + radial * radii**2)) > 0).all()
    assert radii[-1] > 0.98 / np.sqrt(-3 * radial)  # as far as it can be used


def test_a_pinhole_photograph_stays_as_it_is() -> None:
    picture = np.random.default_rng(1).integers(0, 256, (8, 9, 3), np.uint8)
    found, focal_px = undistorted_photograph(picture, focal_px=12.0, radial=0.0)
    assert found is picture
    assert focal_px == 12.0
