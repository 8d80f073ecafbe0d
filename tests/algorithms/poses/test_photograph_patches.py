"""Patches of a panorama are found in a photograph where its camera sees them."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.features.tangent import extract_sift
from pano_mvs.algorithms.poses.photograph_alignment import PanoramaPatches, PhotographPatches
from pano_mvs.algorithms.poses.photograph_camera import (
    FocalPrior,
    PhotographCamera,
    Sightings,
    optical_center_offset,
    refine_by_sightings,
)
from pano_mvs.algorithms.poses.photograph_patches import MIN_SIDE_PX, panorama_levels, photograph_levels, sight_points
from pano_mvs.algorithms.poses.photograph_surface import SurfacePoints, surface_points
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3, geodesic_angle, rotation_from_rotvec
from pano_mvs.scene import RangeMap
from pano_mvs.testing.room import default_room, range_along, render
from tests.synthetic.photograph import render_photograph

SIZE_HW, PHOTO_HW, FOCAL_PX = (256, 512), (240, 320), 260.0
POSE = Rigid3.from_center(rotation_from_rotvec(np.array([0.1, 0.6, -0.1])), np.array([0.2, 0.1, 0.1]))
TRUE = PhotographCamera(POSE, FOCAL_PX, -0.03)

Given = tuple[SurfacePoints, NDArray[np.uint8], NDArray[np.uint8]]


@pytest.fixture(scope="module")
def given() -> Given:
    """Points of a panorama, the panorama, and a photograph."""
    panorama, ranges = render(default_room(), Rigid3.identity(), SIZE_HW, supersample=1)
    features = extract_sift(panorama, np.ones(SIZE_HW, np.bool_))
    range_map = RangeMap(ranges.astype(np.float32), np.full(SIZE_HW, 255, np.uint8))
    photograph = render_photograph(default_room(), POSE, PHOTO_HW, focal_px=FOCAL_PX, radial=-0.03, supersample=1)
    return surface_points(features, Rigid3.identity(), range_map, min_confidence=128), panorama, photograph


def sightings(given: Given, camera: PhotographCamera) -> Sightings:
    surface, panorama, photograph = given
    levels = photograph_levels(cv2.cvtColor(photograph, cv2.COLOR_RGB2GRAY))
    return sight_points(surface, panorama_levels(panorama, 1)[0], levels, camera=camera, size_hw=PHOTO_HW)


def test_surface_points_are_on_the_surfaces(given: Given) -> None:
    surface = given[0]
    true = range_along(default_room(), np.zeros(3), surface.bearings)
    assert len(true) > 200
    assert np.median(np.abs(surface.ranges / true - 1)) < 1e-3
    assert np.quantile(np.abs(surface.ranges / true - 1), 0.95) < 0.01
    assert ((surface.normals_in_cam * surface.bearings).sum(axis=1) < 0).all()


def test_patches_are_seen_where_the_camera_projects_them(given: Given) -> None:
    """A pixel of the panorama is three pixels of the photograph wide."""
    seen = sightings(given, TRUE)
    assert 0.7 * seen.tested < len(seen.pixels_px) > 40
    away = np.linalg.norm(seen.pixels_px - TRUE.project(seen.points_in_world, PHOTO_HW)[0], axis=1)
    assert np.median(away) < 0.8
    assert 0.1 < np.median(np.linalg.norm(seen.errors(TRUE, PHOTO_HW), axis=1)) < 2.0


def test_a_camera_is_recovered_from_sightings(given: Given) -> None:
    seen = sightings(given, TRUE)
    exact = Sightings(
        TRUE.project(seen.points_in_world, PHOTO_HW)[0], seen.points_in_world, seen.whitening, seen.tested
    )
    turn = rotation_from_rotvec(np.radians([0.4, -0.3, 0.2]))
    start = PhotographCamera(Rigid3.from_center(turn @ POSE.rotation, POSE.center + 0.03), 1.02 * FOCAL_PX, 0.0)
    found = refine_by_sightings(start, exact, size_hw=PHOTO_HW, prior=FocalPrior(FOCAL_PX, 0.5))
    found = refine_by_sightings(found, exact, size_hw=PHOTO_HW, prior=FocalPrior(FOCAL_PX, 0.5))
    assert np.degrees(geodesic_angle(found.cam_from_world.rotation, POSE.rotation)) < 0.1
    assert np.linalg.norm(found.cam_from_world.center - POSE.center) < 0.015
    assert found.focal_px == pytest.approx(FOCAL_PX, rel=0.01)


@pytest.mark.parametrize(("shape_hw", "levels"), [((21, 640), 0), ((22, 640), 1), ((240, 320), 4)])
def test_no_level_is_smaller_than_a_patch(shape_hw: tuple[int, int], levels: int) -> None:
    found = photograph_levels(np.zeros(shape_hw, np.uint8))
    assert [min(level.shape) >= MIN_SIDE_PX for level in found] == [True] * levels


@pytest.mark.parametrize(("shape_hw", "too_narrow"), [((21, 640), True), ((640, 22), False), ((100, 12000), True)])
def test_a_strip_cannot_be_aligned(given: Given, shape_hw: tuple[int, int], too_narrow: bool) -> None:
    strip = PhotographPatches(
        np.zeros((*shape_hw, 3), np.uint8), PanoramaPatches(lambda _: given[0], lambda _: given[1])
    )
    assert strip.too_narrow is too_narrow
    if too_narrow:
        with pytest.raises(UsageError, match="smaller than a patch"):
            strip.aligned(TRUE, ["a"], prior=FocalPrior(FOCAL_PX, 0.1))


@pytest.mark.parametrize(("offset", "std"), [((0.0, 0.0), 0.3), ((0.05, -0.03), 0.3), ((0.004, 0.0), 3.0)])
def test_the_optical_centre_is_found(given: Given, offset: tuple[float, float], std: float) -> None:
    """Sightings with known errors: as far from the middle as they were moved, within the deviations that it states."""
    seen = sightings(given, TRUE)
    noise = np.random.default_rng(3).normal(0, std, seen.pixels_px.shape)
    pixels = TRUE.project(seen.points_in_world, PHOTO_HW)[0] + 320 * np.array(offset) + noise
    moved = Sightings(pixels, seen.points_in_world, np.broadcast_to(np.eye(2) / std, seen.whitening.shape), seen.tested)
    found, stds = optical_center_offset(TRUE, moved, size_hw=PHOTO_HW, prior=FocalPrior(FOCAL_PX, 0.1))
    assert (np.abs(found - offset) < 4 * stds).all(), (found, stds)
    assert (stds < 0.003 * std / 0.3).all()


@pytest.mark.parametrize("left", [0, 32])
def test_alignment_tells_whether_a_photograph_was_cropped(given: Given, left: int) -> None:
    surface, panorama, photograph = given
    cropped = np.ascontiguousarray(photograph[:, left:])
    patches = PhotographPatches(cropped, PanoramaPatches(lambda _: surface, lambda _: panorama))
    turn = rotation_from_rotvec(np.array([0.0, -np.arctan(left / 2 / FOCAL_PX), 0.0]))
    start = PhotographCamera(Rigid3.from_center(turn @ POSE.rotation, POSE.center), FOCAL_PX, 0.0)
    aligned = patches.aligned(start, ["a"], prior=FocalPrior(FOCAL_PX, 0.1))
    assert aligned.confirmed > 40
    assert aligned.off_center == pytest.approx(left / 2 / (320 - left), abs=0.02)


def test_alignment_improves_a_camera_and_confirms_it(given: Given) -> None:
    surface, panorama, photograph = given
    patches = PhotographPatches(photograph, PanoramaPatches(lambda _: surface, lambda _: panorama))
    turn = rotation_from_rotvec(np.radians([0.5, -0.4, 0.3]))
    start = PhotographCamera(Rigid3.from_center(turn @ POSE.rotation, POSE.center + 0.03), 1.01 * FOCAL_PX, 0.0)
    aligned = patches.aligned(start, ["a"], prior=FocalPrior(FOCAL_PX, 0.1))
    assert np.degrees(geodesic_angle(aligned.camera.cam_from_world.rotation, POSE.rotation)) < 0.2
    assert np.linalg.norm(aligned.camera.cam_from_world.center - POSE.center) < 0.02
    assert aligned.share > 0.5
    away = rotation_from_rotvec(np.array([0.0, 0.8, 0.0]))
    wrong = patches.aligned(
        PhotographCamera(Rigid3.from_center(away @ POSE.rotation, POSE.center), FOCAL_PX, 0.0),
        ["a"],
        prior=FocalPrior(FOCAL_PX, 0.1),
    )
    assert wrong.share < 0.15
