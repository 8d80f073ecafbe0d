"""Photographs are localised among panoramas, and refused where that is not possible."""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np
import pytest
from pano_mvs_photographs.alignment import PanoramaPatches, PhotographPatches
from pano_mvs_photographs.localise import Localised, localise_photograph
from pano_mvs_photographs.panoramas import KnownPoints, has_sift, known_points, surface_points

from pano_mvs.algorithms.faces.render import face_image
from pano_mvs.algorithms.features.tangent import PhotographKeypoints, extract_orb, extract_sift, photograph_keypoints
from pano_mvs.core.arrays import Picture
from pano_mvs.geometry import PinholeView, Rigid3, geodesic_angle, rotation_from_rotvec
from pano_mvs.scene import RangeMap
from pano_mvs.testing.room import default_room, render
from tests.synthetic.photograph import render_photograph

SIZE_HW = (256, 512)
CENTERS = [(0.0, 0.0, 0.0), (0.5, 0.1, 0.2), (-0.3, 0.0, 0.6)]
PHOTO_HW, FOCAL_PX = (360, 480), 380.0


Model = tuple[dict[str, KnownPoints], PanoramaPatches]


@pytest.fixture(scope="module")
def model() -> Model:
    """The panoramas' key points, and their patches."""
    known, surfaces, pictures = {}, {}, {}
    for number, center in enumerate(CENTERS):
        pose = Rigid3.from_center(np.eye(3), np.array(center))
        picture, ranges = render(default_room(), pose, SIZE_HW, supersample=1)
        features = extract_sift(picture, np.ones(SIZE_HW, np.bool_))
        range_map = RangeMap(ranges.astype(np.float32), np.full(SIZE_HW, 255, np.uint8))
        name = f"{number}.png"
        known[name] = known_points(features, pose, range_map, min_confidence=128)
        surfaces[name] = surface_points(features, pose, range_map, min_confidence=128)
        pictures[name] = picture
    return known, PanoramaPatches(surfaces.__getitem__, pictures.__getitem__)


@pytest.fixture(scope="module")
def panoramas(model: Model) -> dict[str, KnownPoints]:
    return model[0]


def photograph(rotvec: tuple[float, float, float], center: tuple[float, float, float]) -> tuple[Picture, Rigid3]:
    """Return a picture of the room by a pinhole camera, and its pose."""
    pose = Rigid3.from_center(rotation_from_rotvec(np.array(rotvec)), np.array(center))
    panorama = render(default_room(), Rigid3.from_center(np.eye(3), np.array(center)), (512, 1024), supersample=1)[0]
    view = PinholeView(pose.rotation, FOCAL_PX, np.array(PHOTO_HW[::-1]) / 2, PHOTO_HW)
    return face_image(panorama, view), pose


def localised(
    picture: Picture,
    panoramas: Mapping[str, KnownPoints],
    *,
    focal_px: float | None = None,
    patches: PanoramaPatches | None = None,
    max_keypoints: int = 6000,
) -> Localised | str:
    size_hw = (picture.shape[0], picture.shape[1])
    return localise_photograph(
        photograph_keypoints(picture, max_keypoints=max_keypoints),
        size_hw,
        panoramas,
        focal_px=focal_px,
        patches=None if patches is None else PhotographPatches(picture, patches),
        rng=np.random.default_rng(0),
    )


@pytest.fixture(scope="module", params=[((0.1, 0.6, -0.2), (0.2, 0.1, 0.1)), ((-0.2, 2.8, 0.1), (-0.1, 0.2, 0.4))])
def taken(request: pytest.FixtureRequest) -> tuple[Picture, Rigid3]:
    return photograph(*request.param)


@pytest.mark.slow
@pytest.mark.parametrize("focal_px", [None, 1.1 * FOCAL_PX])
def test_a_photograph_is_localised(
    panoramas: dict[str, KnownPoints], taken: tuple[Picture, Rigid3], focal_px: float | None
) -> None:
    """With an unknown focal length, and with one that is off by a tenth, as EXIF's often is."""
    picture, pose = taken
    found = localised(picture, panoramas, focal_px=focal_px)
    assert isinstance(found, Localised), found
    assert np.degrees(geodesic_angle(found.cam_from_world.rotation, pose.rotation)) < 0.25
    assert np.linalg.norm(found.cam_from_world.center - pose.center) < 0.03
    assert found.focal_px == pytest.approx(FOCAL_PX, rel=0.015)
    assert abs(found.radial) < 0.02
    assert found.inliers > 60
    assert 0 < found.error_px < 2


@pytest.mark.slow
@pytest.mark.parametrize("focal_px", [None, 1.05 * FOCAL_PX])
def test_patches_refine_the_camera(model: Model, focal_px: float | None) -> None:
    """A sharp picture with distortion, as a phone takes it: a fifth of the error that key points alone may have."""
    pose = Rigid3.from_center(rotation_from_rotvec(np.array([0.1, 0.6, -0.2])), np.array([0.2, 0.1, 0.1]))
    picture = render_photograph(default_room(), pose, PHOTO_HW, focal_px=FOCAL_PX, radial=-0.05, supersample=1)
    found = localised(picture, model[0], focal_px=focal_px, patches=model[1])
    assert isinstance(found, Localised), found
    assert np.degrees(geodesic_angle(found.cam_from_world.rotation, pose.rotation)) < 0.05
    assert np.linalg.norm(found.cam_from_world.center - pose.center) < 0.006
    assert found.focal_px == pytest.approx(FOCAL_PX, rel=0.003)
    assert found.radial == pytest.approx(-0.05, abs=0.01)


@pytest.mark.slow
def test_a_photograph_that_was_cropped_on_one_side_is_refused(model: Model) -> None:
    """Its pose would be wrong by a degree for each 2 % of its width."""
    pose = Rigid3.from_center(rotation_from_rotvec(np.array([0.1, 0.6, -0.2])), np.array([0.2, 0.1, 0.1]))
    picture = render_photograph(default_room(), pose, PHOTO_HW, focal_px=FOCAL_PX, radial=-0.05, supersample=1)
    cropped = np.ascontiguousarray(picture[:, 60:])
    found = localised(cropped, model[0], focal_px=FOCAL_PX, patches=model[1])
    assert isinstance(found, str)
    assert "it seems to be cropped: its optical centre is" in found


@pytest.mark.slow
def test_patches_confirm_a_pose_of_few_key_points(model: Model, taken: tuple[Picture, Rigid3]) -> None:
    picture, pose = taken
    refused = localised(picture, model[0], focal_px=FOCAL_PX, max_keypoints=60)
    found = localised(picture, model[0], focal_px=FOCAL_PX, max_keypoints=60, patches=model[1])
    assert isinstance(refused, str)
    assert isinstance(found, Localised), found
    assert np.degrees(geodesic_angle(found.cam_from_world.rotation, pose.rotation)) < 0.1


@pytest.mark.slow
def test_patches_do_not_confirm_another_room(model: Model) -> None:
    pose = Rigid3.from_center(rotation_from_rotvec(np.array([0.1, 0.6, -0.2])), np.array([0.2, 0.1, 0.1]))
    picture = render_photograph(default_room(5), pose, PHOTO_HW, focal_px=FOCAL_PX, supersample=1)
    assert isinstance(localised(picture, model[0], focal_px=FOCAL_PX, patches=model[1]), str)


@pytest.mark.slow
def test_distortion_is_found(panoramas: dict[str, KnownPoints], taken: tuple[Picture, Rigid3]) -> None:
    """The picture is distorted so that its content moves by up to 12 pixels."""
    picture, pose = taken
    rows, columns = np.indices(PHOTO_HW)
    seen = np.stack([columns + 0.5, rows + 0.5], axis=-1) - np.array(PHOTO_HW[::-1]) / 2
    plane = seen / FOCAL_PX
    for _ in range(20):  # inverts x' = x (1 + k r²)
        plane = seen / FOCAL_PX / (1 - 0.1 * (plane**2).sum(axis=-1, keepdims=True))
    at = (plane * FOCAL_PX + np.array(PHOTO_HW[::-1]) / 2 - 0.5).astype(np.float32)
    distorted = np.asarray(cv2.remap(picture, at[..., 0], at[..., 1], cv2.INTER_CUBIC), np.uint8)
    found = localised(distorted, panoramas, focal_px=None)
    assert isinstance(found, Localised), found
    assert found.radial == pytest.approx(-0.1, abs=0.03)
    assert np.degrees(geodesic_angle(found.cam_from_world.rotation, pose.rotation)) < 0.3


def test_a_photograph_of_something_else_is_refused(panoramas: dict[str, KnownPoints]) -> None:
    noise = np.random.default_rng(5).integers(0, 256, (90, 120, 3)).astype(np.uint8)
    other = np.asarray(cv2.resize(noise, PHOTO_HW[::-1], interpolation=cv2.INTER_CUBIC), np.uint8)
    found = localised(other, panoramas)
    assert isinstance(found, str)
    assert "match" in found


def test_a_strip_is_refused(model: Model, taken: tuple[Picture, Rigid3]) -> None:
    """It has enough matches for a pose, but no patch fits into it."""
    keypoints = photograph_keypoints(taken[0])
    inside = np.abs(keypoints.pixels_px[:, 1] - 180) < 10
    strip = PhotographKeypoints(keypoints.pixels_px[inside] - [0, 170], keypoints.descriptors[inside])
    found = localise_photograph(
        strip,
        (20, PHOTO_HW[1]),
        model[0],
        focal_px=FOCAL_PX,
        patches=PhotographPatches(taken[0][170:190], model[1]),
        rng=np.random.default_rng(0),
    )
    assert found == "it is 480 × 20 pixels, which is too narrow to be compared with panoramas"


def test_a_blank_photograph_is_refused(panoramas: dict[str, KnownPoints]) -> None:
    assert localised(np.full((*PHOTO_HW, 3), 128, np.uint8), panoramas) == (
        "only 0 of its 0 key points match points of the panoramas"
    )


def test_matches_in_one_spot_are_refused(panoramas: dict[str, KnownPoints], taken: tuple[Picture, Rigid3]) -> None:
    keypoints = photograph_keypoints(taken[0])
    near = np.linalg.norm(keypoints.pixels_px - np.array([240, 180]), axis=1) < 25
    spot = PhotographKeypoints(keypoints.pixels_px[near], keypoints.descriptors[near])
    found = localise_photograph(
        spot, PHOTO_HW, panoramas, focal_px=FOCAL_PX, min_inliers=6, rng=np.random.default_rng(0)
    )
    assert isinstance(found, str), found


def test_a_key_point_counts_once_however_many_panoramas_match_it(
    panoramas: dict[str, KnownPoints], taken: tuple[Picture, Rigid3]
) -> None:
    keypoints = photograph_keypoints(taken[0])
    few = PhotographKeypoints(keypoints.pixels_px[:120], keypoints.descriptors[:120])
    copies = {f"{name} {copy}": known for name, known in panoramas.items() for copy in range(6)}
    found = localise_photograph(few, PHOTO_HW, copies, focal_px=FOCAL_PX, min_inliers=121, rng=np.random.default_rng(0))
    assert isinstance(found, str)
    assert "key points, agree with one pose" in found


@pytest.mark.slow
def test_key_points_keep_their_place_when_the_photograph_is_reduced(taken: tuple[Picture, Rigid3]) -> None:
    large = np.asarray(cv2.resize(taken[0], (3200, 2400), interpolation=cv2.INTER_CUBIC), np.uint8)
    pixels, reduced = photograph_keypoints(taken[0]).pixels_px, photograph_keypoints(large).pixels_px
    nearest = np.min(np.linalg.norm(reduced[:300, None] - pixels[None] * 3200 / PHOTO_HW[1], axis=2), axis=1)
    assert np.median(nearest) < 0.5 * 3200 / PHOTO_HW[1]


def test_only_continuous_surfaces_give_points() -> None:
    picture = render(default_room(), Rigid3.identity(), (64, 128), supersample=1)[0]
    features = extract_sift(picture, np.ones((64, 128), np.bool_))
    stepped = np.where(np.arange(128) < 64, 1.0, 2.0).astype(np.float32) * np.ones((64, 1), np.float32)
    confidence = np.where(np.arange(64)[:, None] < 32, 255, 100).astype(np.uint8) * np.ones((1, 128), np.uint8)
    found = known_points(features, Rigid3.identity(), RangeMap(stepped, confidence), min_confidence=128)
    ranges = np.linalg.norm(found.points_in_world, axis=1)
    assert len(ranges) > 5
    assert set(np.round(ranges, 6)) == {1.0, 2.0}
    azimuth = np.arctan2(found.points_in_world[:, 0], found.points_in_world[:, 2])
    assert np.abs(azimuth).min() > np.radians(360 / 128)
    assert (found.points_in_world[:, 1] <= 1e-9).all()


def test_only_sift_can_be_compared() -> None:
    picture = render(default_room(), Rigid3.identity(), (64, 128), supersample=1)[0]
    mask = np.ones((64, 128), np.bool_)
    assert has_sift(extract_sift(picture, mask))
    assert not has_sift(extract_orb(picture, mask))
