"""Faces of a panorama: where they look, and what is seen in them.

Faces of a cube are put in the order in which the picture continues across their edges.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.faces.layout import arranged_faces, covers_sphere, default_face_size, panorama_faces
from pano_mvs.algorithms.faces.render import (
    face_confidence,
    face_image,
    face_mask,
    face_normals,
    face_source,
    face_z_depth,
    render_face,
)
from pano_mvs.algorithms.faces.sampling import CUBE
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import PinholeView, Rigid3, ray_grid, rotation_from_rotvec
from pano_mvs.scene import RangeMap
from pano_mvs.scene.files import FaceLayout
from pano_mvs.testing.room import capture_poses, default_room, range_along, render
from tests.oracles.surfaces import z_depth as slow_z_depth
from tests.synthetic.tour_files import face_of

View = tuple[NDArray[np.uint8], NDArray[np.float32], Rigid3]

SIZE = (128, 256)
LAYOUTS = ("cube", "octagon", "icosahedron")


@pytest.fixture(scope="module")
def panorama() -> View:
    """Picture, true ranges and pose of a tilted camera in the room."""
    pose = capture_poses(2, seed=3)[1]
    return *render(default_room(), pose, SIZE, supersample=1), pose


def smooth_panorama(size_hw: tuple[int, int] = SIZE) -> NDArray[np.uint8]:
    """A picture whose colours are linear in the ray, so that every place has a known one."""
    return np.rint(128 + 100 * ray_grid(size_hw)).astype(np.uint8)


def unit_rays(view: PinholeView) -> NDArray[np.float64]:
    rays = view.rays()
    result: NDArray[np.float64] = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    return result


def valid_but_for_a_disc(center: tuple[float, float, float], radius_deg: float = 12.0) -> NDArray[np.bool_]:
    result: NDArray[np.bool_] = ray_grid(SIZE) @ (np.array(center) / np.linalg.norm(center)) < np.cos(
        np.radians(radius_deg)
    )
    return result


@pytest.mark.parametrize("layout", LAYOUTS)
def test_faces_are_right_handed_named_and_cover_the_sphere(layout: FaceLayout) -> None:
    faces = panorama_faces(SIZE, layout=layout)
    assert len({face.name for face in faces}) == len(faces) == {"cube": 6, "octagon": 10, "icosahedron": 20}[layout]
    for face in faces:
        rotation = face.view.view_from_cam
        assert rotation @ rotation.T == pytest.approx(np.eye(3), abs=1e-12)
        assert np.linalg.det(rotation) == pytest.approx(1)
    assert covers_sphere(faces)
    assert covers_sphere(panorama_faces(SIZE, layout=layout, fov_deg=90))
    assert not covers_sphere(panorama_faces(SIZE, layout=layout, fov_deg=70))


def test_faces_look_where_their_names_say() -> None:
    axes = {face.name: face.view.view_from_cam[2] for face in panorama_faces(SIZE)}
    assert axes["front"] == pytest.approx((0, 0, 1))
    assert axes["right"] == pytest.approx((1, 0, 0))
    assert axes["up"] == pytest.approx((0, -1, 0))
    around = {face.name: face.view.view_from_cam for face in panorama_faces(SIZE, layout="octagon")}
    assert around["front-right"][2] == pytest.approx(np.array([1, 0, 1]) / np.sqrt(2))
    assert all(around[name][1] == pytest.approx((0, 1, 0)) for name in ("front", "right", "back-left"))


def test_the_camera_is_colmaps_pinhole_camera() -> None:
    view = panorama_faces(SIZE, fov_deg=96, size_px=300)[3].view
    camera = pycolmap.Camera(model="PINHOLE", width=300, height=300, params=[view.focal_px, view.focal_px, 150, 150])
    assert view.calibration == pytest.approx(camera.calibration_matrix())
    points = np.random.default_rng(1).normal(size=(200, 3)) + 2 * view.view_from_cam[2]
    in_face = points @ view.view_from_cam.T
    before = in_face[:, 2] > 0
    pixels = view.pixels_from_rays(points)
    assert pixels[before] == pytest.approx(camera.img_from_cam(in_face[before]), abs=1e-9)
    assert np.isnan(pixels[~before]).all()
    left = view.bearings_from_pixels((0, 150)) @ view.view_from_cam.T
    assert np.degrees(np.arctan2(left[0], left[2])) == pytest.approx(-48)


def test_pixels_and_rays_are_each_others_inverse() -> None:
    for face in panorama_faces(SIZE, layout="icosahedron", fov_deg=80, size_px=24):
        x, y = np.meshgrid(np.arange(24) + 0.5, np.arange(24) + 0.5)
        assert face.view.pixels_from_rays(face.view.rays()) == pytest.approx(np.stack([x, y], axis=-1), abs=1e-9)
        assert face.view.contains(face.view.pixels_from_rays(face.view.rays())).all()


def test_the_default_size_keeps_the_resolution() -> None:
    for fov_deg in (60.0, 90.0, 96.0, 120.0):
        faces = panorama_faces((512, 1024), fov_deg=fov_deg)
        assert faces[0].view.size_hw[0] == default_face_size((512, 1024), fov_deg=fov_deg)
        assert 0 <= faces[0].view.focal_px / (1024 / (2 * np.pi)) - 1 < 0.02


@pytest.mark.parametrize("layout", LAYOUTS)
def test_colors_are_those_of_the_rays(layout: FaceLayout) -> None:
    image = smooth_panorama()
    for face in panorama_faces(SIZE, layout=layout, fov_deg=100):
        expected = 128 + 100 * unit_rays(face.view)
        assert np.abs(face_image(image, face.view) - expected).max() < 2, face.name


def test_a_coarse_face_averages_and_does_not_alias() -> None:
    """Every second column black: a face with half the pixels is grey, where single samples would be stripes."""
    stripes = np.zeros((*SIZE, 3), np.uint8)
    stripes[:, ::2] = 255
    view = panorama_faces(SIZE, size_px=24)[0].view
    middle = face_image(stripes, view)[8:16, 8:16].astype(float)
    assert np.abs(middle - 127.5).max() < 40


def test_z_depths_are_the_true_ones_between_steps(panorama: View) -> None:
    _, ranges, pose = panorama
    errors = []
    for face in panorama_faces(SIZE, size_px=64):
        rays = unit_rays(face.view).reshape(-1, 3)
        true = range_along(default_room(), pose.center, rays @ pose.rotation) * (rays @ face.view.view_from_cam[2])
        errors.append(np.abs(face_z_depth(ranges, face.view).ravel() / true - 1))
    assert np.median(errors) < 2e-4
    assert np.mean(np.concatenate(errors) < 0.01) > 0.94


@pytest.mark.slow
@pytest.mark.kernel("ranges.kernels_agreement")
@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_compiled_loop_is_the_plain_one(panorama: View, layout: FaceLayout) -> None:
    ranges = panorama[1].copy()
    ranges[np.random.default_rng(2).random(SIZE) < 0.02] = np.nan
    turn = rotation_from_rotvec((0.11, 0.23, 0.05))  # so that no ray lies exactly between two pixels
    for face in panorama_faces(SIZE, layout=layout, size_px=20):
        view = replace(face.view, view_from_cam=face.view.view_from_cam @ turn)
        expected = slow_z_depth(ranges, view)
        one, three = (face_z_depth(ranges, view, threads=threads) for threads in (1, 3))
        np.testing.assert_array_equal(one, three)
        np.testing.assert_array_equal(np.isnan(one), np.isnan(expected))
        np.testing.assert_allclose(one, expected, rtol=1e-6)


def test_no_depth_lies_between_two_surfaces_and_no_hole_is_closed() -> None:
    ranges = np.full(SIZE, 2.0, np.float32)
    ranges[:, ::2] = 5.0
    ranges[:, 60:80] = np.nan
    for face in panorama_faces(SIZE):
        depth_along_ray = face_z_depth(ranges, face.view) / (unit_rays(face.view) @ face.view.view_from_cam[2])
        known = depth_along_ray[np.isfinite(depth_along_ray)]
        assert (np.isclose(known, 2.0) | np.isclose(known, 5.0)).all()
    left = next(face for face in panorama_faces(SIZE) if face.name == "left")
    assert np.isnan(face_z_depth(ranges, left.view)).mean() > 0.15


def test_normals_turn_into_the_faces_frame() -> None:
    """All normals of a sphere around the camera look back along the rays, in any face."""
    for face in panorama_faces(SIZE, layout="octagon"):
        normals = face_normals(-ray_grid(SIZE).astype(np.float32), face.view)
        in_face = unit_rays(face.view) @ face.view.view_from_cam.T
        assert np.einsum("hwc,hwc->hw", normals, -in_face).min() > np.cos(np.radians(1.5))
        assert np.linalg.norm(normals, axis=-1) == pytest.approx(np.ones(face.view.size_hw), abs=1e-5)


@pytest.mark.parametrize("size_px", [20, 64, 160])
@pytest.mark.parametrize("center", [(0, 0, -1), (0, 1, 0), (1, -0.2, 1)], ids=["seam", "nadir", "edge"])
def test_nothing_masked_is_seen(center: tuple[int, float, int], size_px: int) -> None:
    """What is masked may have any colour and any range: no face changes where its mask is True."""
    valid = valid_but_for_a_disc(center)
    image, ranges = smooth_panorama(), np.full(SIZE, 3.0, np.float32)
    confidence = np.where(valid, 200, 0).astype(np.uint8)
    painted, moved = image.copy(), np.where(valid, ranges, np.float32(0.5))
    painted[~valid] = (255, 0, 255)
    range_maps = [RangeMap(ranges, np.full(SIZE, 200, np.uint8)), RangeMap(moved, np.full(SIZE, 200, np.uint8))]
    sources = [face_source(image, valid, range_maps[0]), face_source(painted, valid, range_maps[1])]
    masked = 0
    for face in panorama_faces(SIZE, size_px=size_px):
        one, other = (render_face(source, face.view) for source in sources)
        np.testing.assert_array_equal(one.image[one.mask], other.image[one.mask])
        np.testing.assert_array_equal(one.z_depth, other.z_depth)
        np.testing.assert_array_equal(one.normals_in_face, other.normals_in_face)
        np.testing.assert_array_equal(one.mask, face_mask(valid, face.view))
        assert not (np.isfinite(one.z_depth) & ~one.mask).any()
        assert ((one.confidence == 0) == np.isnan(one.z_depth)).all()
        # What is far enough from the mask is not lost.
        away = unit_rays(face.view) @ (np.array(center) / np.linalg.norm(center)) < np.cos(np.radians(22))
        assert one.mask[away].all()
        masked += int((~one.mask).sum())
    assert masked
    assert face_confidence(confidence, face.view).shape == face.view.size_hw


def test_doubtful_ranges_have_no_depth(panorama: View) -> None:
    image, ranges, _ = panorama
    confidence = np.full(SIZE, 200, np.uint8)
    confidence[:, :100] = 40
    source = face_source(image, np.ones(SIZE, np.bool_), RangeMap(ranges, confidence))
    rendered = render_face(source, panorama_faces(SIZE)[3].view)
    assert set(np.unique(rendered.confidence)) <= {0, 200}
    assert (rendered.confidence == 0).mean() > 0.3


def test_normals_are_given_or_fitted_and_face_the_camera(panorama: View) -> None:
    image, ranges, _ = panorama
    valid, view = np.ones(SIZE, np.bool_), panorama_faces(SIZE)[0].view
    confidence = np.full(SIZE, 200, np.uint8)
    fitted = render_face(face_source(image, valid, RangeMap(ranges, confidence)), view)
    turned = np.broadcast_to(rotation_from_rotvec((0.1, 0, 0)) @ (0, 0, -1), (*SIZE, 3)).astype(np.float16)
    given = render_face(face_source(image, valid, RangeMap(ranges, confidence, turned)), view)
    assert np.linalg.norm(fitted.normals_in_face, axis=-1) == pytest.approx(np.ones(view.size_hw), abs=1e-3)
    assert (np.einsum("hwc,hwc->hw", fitted.normals_in_face, view.rays() @ view.view_from_cam.T) < 0.05).all()
    assert given.normals_in_face == pytest.approx(np.broadcast_to(turned[0, 0], (*view.size_hw, 3)), abs=1e-3)


def test_arrays_that_do_not_fit_are_named(panorama: View) -> None:
    image, ranges, _ = panorama
    view = panorama_faces(SIZE)[0].view
    with pytest.raises(UsageError, match="differ in size"):
        face_source(image[::2], np.ones(SIZE, np.bool_), RangeMap(ranges, np.full(SIZE, 200, np.uint8)))
    with pytest.raises(UsageError, match="a panorama is"):
        face_image(image.astype(float), view)
    with pytest.raises(UsageError, match="ranges are"):
        face_z_depth(ranges.astype(float), view)


Faces = dict[str, NDArray[np.uint8]]


def rendered() -> Faces:
    return {name: face_of(name) for name in CUBE}


def test_a_cube_in_order_stays() -> None:
    faces, rearranged = arranged_faces(rendered())
    assert not rearranged
    assert all(np.array_equal(faces[name], face) for name, face in rendered().items())


@pytest.mark.parametrize("seed", range(12))
def test_any_order_and_quarter_turns_are_undone(seed: int) -> None:
    """The face in front stays, as it says where the middle of the panorama is."""
    rng = np.random.default_rng(seed)
    names = list(CUBE)
    order = ["f", *rng.permutation(names[1:]).tolist()]
    mixed = {name: rendered()[other] for name, other in zip(names, order, strict=True)}
    turned = {name: np.rot90(face, 0 if name == "f" else int(rng.integers(4))) for name, face in mixed.items()}
    faces, rearranged = arranged_faces(turned)
    assert rearranged
    for name, face in rendered().items():
        assert np.array_equal(faces[name], face), name


def test_faces_that_fit_nowhere_stay() -> None:
    rng = np.random.default_rng(5)
    noise = {name: rng.integers(0, 255, (64, 64, 3)).astype(np.uint8) for name in CUBE}
    faces, rearranged = arranged_faces(noise)
    assert not rearranged
    assert all(np.array_equal(faces[name], face) for name, face in noise.items())


def test_faces_of_one_colour_stay() -> None:
    plain = {name: np.full((8, 8, 3), 200, np.uint8) for name in CUBE}
    assert not arranged_faces(plain)[1]
