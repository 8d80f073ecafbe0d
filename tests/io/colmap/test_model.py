"""COLMAP models: pycolmap reads what we write, and we read what COLMAP writes."""

from __future__ import annotations

import dataclasses
import json
import os
import struct
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import pycolmap
import pytest

from pano_mvs.core.errors import InputError, UsageError
from pano_mvs.io.colmap.reader import read_colmap_model
from pano_mvs.io.colmap.writer import write_colmap_model
from pano_mvs.io.poses.files import read_poses
from pano_mvs.scene import Poses
from pano_mvs.scene.photographs import Photographs
from pano_mvs.testing.room import capture_poses
from tests.foreign import pip_packages

NAMES = ("b/1.jpg", "b/2.jpg", "b/10.jpg", "c.png")
SIZES = {"b/1.jpg": (512, 1024), "b/2.jpg": (512, 1024), "b/10.jpg": (512, 1024), "c.png": (300, 600)}
FILES = ("cameras", "frames", "images", "points3D", "rigs")
NOISE_RAD = 1e-3


def noisy_poses(points: int = 200) -> Poses:
    """Poses whose points are seen by two to four cameras, with a little noise; some beside the seam and the poles."""
    rng = np.random.default_rng(7)
    cameras = capture_poses(4, seed=2)
    xyz = rng.normal(size=(points, 3)) * (2, 4, 2) + (0, 0, 0)
    seen = [(image, point) for image in range(4) for point in range(points) if image < 2 or (point + image) % 3 == 0]
    bearings = np.array([cameras[image].apply(xyz[point]) for image, point in seen])
    bearings /= np.linalg.norm(bearings, axis=1, keepdims=True)
    bearings += NOISE_RAD * rng.normal(size=bearings.shape)
    bearings /= np.linalg.norm(bearings, axis=1, keepdims=True)
    poses = Poses(
        names=NAMES,
        rotations=np.array([camera.rotation for camera in cameras]),
        translations=np.array([camera.translation for camera in cameras]),
        points_in_world=xyz,
        point_colors_rgb=rng.integers(0, 256, (points, 3)).astype(np.uint8),
        point_errors_rad=np.full(points, NOISE_RAD, np.float32),
        track_point_idx=np.array([point for _, point in seen], np.int32),
        track_image_idx=np.array([image for image, _ in seen], np.int32),
        track_bearings=bearings,
        rejected={"d.png": "too few matches"},
    )
    poses.check()
    return poses


@pytest.fixture(scope="module")
def model_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("model") / "sparse" / "0"
    write_colmap_model(folder, noisy_poses(), SIZES)
    return folder


def test_pycolmap_reads_cameras_images_and_names(model_folder: Path) -> None:
    model = pycolmap.Reconstruction(str(model_folder))
    cameras = {camera.camera_id: camera for camera in model.cameras.values()}
    assert [(c.model_name, c.height, c.width, list(c.params)) for _, c in sorted(cameras.items())] == [
        ("EQUIRECTANGULAR", 512, 1024, [1024, 512]),
        ("EQUIRECTANGULAR", 300, 600, [600, 300]),
    ]
    assert {image.name: image.camera_id for image in model.images.values()} == dict(
        zip(NAMES, (1, 1, 1, 2), strict=True)
    )
    assert model.num_reg_images() == 4
    assert model.num_points3D() == 200
    for image in model.images.values():
        pose = noisy_poses().cam_from_world(NAMES.index(image.name))
        assert image.cam_from_world().translation == pytest.approx(pose.translation)
        assert image.cam_from_world().rotation.matrix() == pytest.approx(pose.rotation)


def test_the_points_project_onto_their_observations(model_folder: Path) -> None:
    """COLMAP's own projection: keypoints, tracks and poses belong together, at either picture size."""
    model = pycolmap.Reconstruction(str(model_folder))
    angles, count = [], 0
    for image in model.images.values():
        camera = model.cameras[image.camera_id]
        for element in image.points2D:
            count += 1
            point_in_cam = image.cam_from_world() * model.points3D[element.point3D_id].xyz
            ray = camera.cam_ray_from_img(element.xy)
            angles.append(np.linalg.norm(np.cross(ray, point_in_cam)) / np.linalg.norm(point_in_cam))
    assert count == len(noisy_poses().track_point_idx)
    assert max(angles) < 5 * NOISE_RAD
    assert model.compute_num_observations() == count
    assert model.compute_mean_reprojection_error() == pytest.approx(NOISE_RAD * 1000 / (2 * np.pi), rel=0.2)


def test_reading_gives_back_what_was_written(model_folder: Path) -> None:
    poses, expected = read_colmap_model(model_folder), noisy_poses()
    poses.check()
    for name in ("names", "point_colors_rgb", "track_point_idx", "track_image_idx"):
        np.testing.assert_array_equal(getattr(poses, name), getattr(expected, name))
    for name in ("rotations", "translations", "points_in_world", "track_bearings"):
        assert getattr(poses, name) == pytest.approx(getattr(expected, name), abs=1e-12), name
    assert poses.point_errors_rad == pytest.approx(expected.point_errors_rad, rel=1e-6)
    assert not poses.metric


def test_models_of_before_rigs_are_read(model_folder: Path, tmp_path: Path) -> None:
    assert read_colmap_model(copied(model_folder, tmp_path, "", bytes)).names == NAMES
    assert read_poses(model_folder.parents[1]).names == NAMES


def test_poses_without_points_survive(tmp_path: Path) -> None:
    expected = Poses.without_points(
        dict(zip("ab", capture_poses(2), strict=True)), frame="any", scale="any", metric=False
    )
    write_colmap_model(tmp_path, expected, {"a": (8, 16), "b": (8, 16)})
    poses = read_colmap_model(tmp_path)
    poses.check()
    assert poses.rotations == pytest.approx(expected.rotations)
    assert len(poses.points_in_world) == len(poses.track_bearings) == 0


@pytest.mark.slow
def test_the_same_poses_are_the_same_bytes_in_another_process(model_folder: Path, tmp_path: Path) -> None:
    code = (
        "import sys; from pathlib import Path; from tests.io.colmap.test_model import *; "
        "write_colmap_model(Path(sys.argv[1]), noisy_poses(), SIZES)"
    )
    subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=True)
    for name in FILES:
        assert (tmp_path / f"{name}.bin").read_bytes() == (model_folder / f"{name}.bin").read_bytes(), name


def test_a_size_that_is_not_given_is_named(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"the size of c\.png is not given"):
        write_colmap_model(tmp_path, noisy_poses(), dict.fromkeys(NAMES[:3], (8, 16)))


def test_photographs_are_in_the_model_and_left_out_of_the_poses(tmp_path: Path) -> None:
    poses, pose = noisy_poses(), capture_poses(5, seed=4)[4]
    photographs = Photographs(
        names=("phone/7.jpg",),
        sizes_hw=np.array([[3000, 4000]], np.int32),
        focals_px=np.array([3100.0]),
        radials=np.array([0.05]),
        rotations=pose.rotation[None],
        translations=pose.translation[None],
        inliers=np.array([50], np.int32),
        errors_px=np.array([0.5], np.float32),
    )
    write_colmap_model(tmp_path, poses, SIZES, photographs=photographs)
    model = pycolmap.Reconstruction(tmp_path)
    image = next(image for image in model.images.values() if image.name == "phone/7.jpg")
    assert image.camera.model.name == "SIMPLE_RADIAL"
    point = pose.inverse().apply(np.array([0.3, -0.2, 1.0]))
    expected = 3100 * (1 + 0.05 * 0.13) * np.array([0.3, -0.2]) + [2000, 1500]
    np.testing.assert_allclose(image.project_point(point), expected, atol=1e-6)
    back = read_colmap_model(tmp_path)
    assert back.names == NAMES
    np.testing.assert_allclose(back.translations, poses.translations, atol=1e-12)
    assert len(back.points_in_world) == len(poses.points_in_world)


def test_other_cameras_are_refused(tmp_path: Path) -> None:
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(camera_id=1, model="PINHOLE", width=4, height=4, params=[2, 2, 2, 2])
    )
    model.write_binary(str(tmp_path))
    with pytest.raises(InputError, match="camera 1 is PINHOLE, expected EQUIRECTANGULAR"):
        read_colmap_model(tmp_path)


def test_a_model_without_images_is_refused(tmp_path: Path) -> None:
    pycolmap.Reconstruction().write_binary(str(tmp_path))
    with pytest.raises(InputError, match="registers no image"):
        read_colmap_model(tmp_path)


def test_a_folder_without_a_model_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no COLMAP model here"):
        read_colmap_model(tmp_path)


def test_points_that_no_image_sees_are_kept(tmp_path: Path) -> None:
    poses = noisy_poses()
    kept = poses.track_point_idx != 3
    tracks = {name: getattr(poses, name)[kept] for name in ("track_point_idx", "track_image_idx", "track_bearings")}
    write_colmap_model(tmp_path, dataclasses.replace(poses, **tracks), SIZES)
    back = read_colmap_model(tmp_path)
    assert back.points_in_world == pytest.approx(poses.points_in_world)
    assert 3 not in back.track_point_idx


@pytest.mark.parametrize(("form", "suffixes"), [("bin", ["bin"]), ("txt", ["txt"]), ("both", ["bin", "txt"])])
def test_models_are_written_as_text_binary_or_both(
    tmp_path: Path, form: Literal["bin", "txt", "both"], suffixes: Sequence[str]
) -> None:
    write_colmap_model(tmp_path / "model", noisy_poses(), SIZES, form=form)
    files = [f"{name}.{suffix}" for name in FILES for suffix in suffixes]
    assert sorted(path.name for path in (tmp_path / "model").iterdir()) == sorted(files)
    model = pycolmap.Reconstruction()
    (model.read_text if form == "txt" else model.read_binary)(str(tmp_path / "model"))
    assert (model.num_rigs(), model.num_frames(), model.num_reg_images()) == (2, 4, 4)
    colors = {tuple(point.xyz.round(9)): tuple(point.color) for point in model.points3D.values()}
    expected = zip(noisy_poses().points_in_world, noisy_poses().point_colors_rgb, strict=True)
    assert colors == {tuple(xyz.round(9)): tuple(color) for xyz, color in expected}
    assert {point.track.length() for point in model.points3D.values()} == {2, 3}


def test_what_we_read_is_what_colmaps_own_reader_reads(model_folder: Path, tmp_path: Path) -> None:
    model = pycolmap.Reconstruction(str(model_folder))
    model.write_text(str(tmp_path))
    for folder in (model_folder, tmp_path):
        poses = read_colmap_model(folder)
        images = sorted((image for image in model.images.values()), key=lambda image: NAMES.index(image.name))
        for idx, image in enumerate(images):
            assert poses.rotations[idx] == pytest.approx(image.cam_from_world().rotation.matrix(), abs=1e-12)
            assert poses.translations[idx] == pytest.approx(image.cam_from_world().translation, abs=1e-12)
        points = [point for _, point in sorted(model.points3D.items())]
        np.testing.assert_allclose(poses.points_in_world, [point.xyz for point in points], atol=1e-12)
        np.testing.assert_array_equal(poses.point_colors_rgb, [point.color for point in points])
        lengths = np.bincount(poses.track_point_idx, minlength=len(points))
        np.testing.assert_array_equal(lengths, [point.track.length() for point in points])


def copied(model_folder: Path, folder: Path, name: str, change: Callable[[bytes], bytes]) -> Path:
    """A copy of the binary model in which one file is changed."""
    for file in ("cameras", "images", "points3D"):
        data = (model_folder / f"{file}.bin").read_bytes()
        (folder / f"{file}.bin").write_bytes(change(data) if file == name else data)
    return folder


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
@pytest.mark.parametrize("count", [10**6, 2**40, 2**64 - 1])
def test_a_count_beyond_the_file_is_refused_before_it_takes_memory(
    model_folder: Path, tmp_path: Path, name: str, count: int
) -> None:
    """An absurd count of points filled all memory once: the reader made room for what the file promised."""
    folder = copied(model_folder, tmp_path, name, lambda data: struct.pack("<Q", count) + data[8:])
    with pytest.raises(InputError, match=rf"{name}\.bin: the COLMAP model cannot be read: it states {count} entries"):
        read_colmap_model(folder)


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
@pytest.mark.parametrize("share", [0, 0.5])
def test_a_truncated_file_is_named(model_folder: Path, tmp_path: Path, name: str, share: float) -> None:
    with pytest.raises(InputError, match=rf"{name}\.bin: the COLMAP model cannot be read"):
        read_colmap_model(copied(model_folder, tmp_path, name, lambda data: data[: int(share * len(data))]))


def test_points_that_images_observe_but_the_model_lacks_are_named(model_folder: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"images\.bin \(b/1\.jpg\): observes point \d+, which points3D\.bin does not"):
        read_colmap_model(copied(model_folder, tmp_path, "points3D", lambda data: bytes(8)))


@pytest.mark.parametrize("place", [4, 36, 52])
def test_a_pose_that_is_no_number_is_named_when_it_is_read(model_folder: Path, tmp_path: Path, place: int) -> None:
    change = lambda data: data[: 8 + place] + struct.pack("<d", np.nan) + data[16 + place :]  # noqa: E731
    with pytest.raises(InputError, match=r"images\.bin \(.*\.\w+\): the pose holds NaN or infinite numbers"):
        read_colmap_model(copied(model_folder, tmp_path, "images", change))


@pytest.mark.parametrize(
    ("file", "line", "what"),
    [
        ("cameras", "1 EQUIRECTANGULAR 1024", "expected an id, a camera model"),
        ("cameras", "1 EQUIRECTANGULAR 1024 0 1024 0", "camera 1 has 1024×0 px"),
        ("cameras", f"1 EQUIRECTANGULAR {'9' * 5000} 512", "is not a number from 0"),
        ("images", "1 1 0 0 0 0 0 0 9 a.jpg\n", "its camera 9 is not in cameras.txt"),
        ("images", "1 1 0 0 0 0 0 0 1 a.jpg\n1 2", "are not three numbers each"),
        ("images", "1 1 0 0 0 0 0 0 1 a.jpg\nnan 2 1", "a key point without a finite position"),
        ("images", "1 1 0 0 0 0 0 0 1 a.jpg\n1 2 7", "observes point 7"),
        ("points3D", "1 0 0 0 0 0 0", "expected an id, a position"),
        ("points3D", "1 0 0 nan 0 0 0 1", "point 1 has no finite position"),
        ("points3D", "1 0 0 0 0 0 256 1", "is not a number from 0 to 255"),
        ("points3D", "1 0 0 0 0 0 0 1 8 0", "observed by image 8, which is not in the model"),
        ("points3D", "1 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1", "point 1 is listed twice"),
    ],
)
def test_a_malformed_text_is_named(tmp_path: Path, file: str, line: str, what: str) -> None:
    lines = {"cameras": "1 EQUIRECTANGULAR 1024 512 1024 512", "images": "1 1 0 0 0 0 0 0 1 a.jpg\n", "points3D": ""}
    for name, text in (lines | {file: line}).items():
        (tmp_path / f"{name}.txt").write_text(text + "\n")
    with pytest.raises(InputError, match=what):
        read_colmap_model(tmp_path)


@pytest.mark.slow
def test_pycolmap_4_1_0_opens_the_model(model_folder: Path, tmp_path: Path) -> None:
    """The first version with this camera. It projects the points on the pixels that the model states."""
    script = f"""
import json, numpy as np, pycolmap
model = pycolmap.Reconstruction({str(model_folder)!r})
errors = [
    float(np.linalg.norm(image.project_point(model.points3D[seen.point3D_id].xyz) - seen.xy))
    for image in model.images.values() for seen in image.points2D
]
cameras = [[camera.model.name, camera.height, camera.width] for _, camera in sorted(model.cameras.items())]
print(json.dumps([pycolmap.__version__, cameras, len(model.reg_image_ids()), len(model.points3D), errors]))
"""
    site = pip_packages(tmp_path / "site", "pycolmap==4.1.0")
    command = [sys.executable, "-c", script]
    done = subprocess.run(
        command, check=True, capture_output=True, text=True, env=os.environ | {"PYTHONPATH": str(site)}
    )
    version, cameras, images, points, errors = json.loads(done.stdout)
    assert version == "4.1.0"
    assert cameras == [["EQUIRECTANGULAR", 512, 1024], ["EQUIRECTANGULAR", 300, 600]]
    assert (images, points) == (4, 200)
    assert len(errors) == len(noisy_poses().track_point_idx)
    assert np.median(errors) < 2 * NOISE_RAD * 1024 / (2 * np.pi)
