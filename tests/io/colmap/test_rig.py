"""Dense workspaces: COLMAP's maps, and models of panoramas that were cut into faces."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pycolmap
import pytest

from pano_mvs.algorithms.faces.layout import Face, panorama_faces
from pano_mvs.core.errors import InputError, UsageError
from pano_mvs.io.colmap.workspace import (
    read_colmap_map,
    write_depth_map,
    write_normal_map,
    write_picture,
    write_stereo_configs,
)
from pano_mvs.io.colmap.writer import CutPanorama, write_rig_model
from pano_mvs.scene.files import FaceLayout
from pano_mvs.scene.image_file import decode_image
from tests.io.colmap.test_model import NAMES, noisy_poses

LAYOUTS: tuple[FaceLayout, ...] = ("cube", "icosahedron")


@cache
def faces_of(layout: FaceLayout) -> tuple[Face, ...]:
    return panorama_faces((512, 1024), layout=layout, fov_deg=100, size_px=240)


def cuts(layout: FaceLayout = "cube", names: Sequence[str] = NAMES) -> dict[str, CutPanorama]:
    faces = faces_of(layout)
    views = [face.view for face in faces]
    return {name: CutPanorama(views, [f"{name}_{face.name}.jpg" for face in faces]) for name in names}


@pytest.mark.slow
def test_opencv_is_loaded_before_pycolmap() -> None:
    """The other way round OpenCV's PNG writer frees with pycolmap's zlib what it got from its own, and dies."""
    code = (
        "import sys, pano_mvs.api; assert 'cv2' in sys.modules and 'pycolmap' not in sys.modules;"
        "import numpy as np, pycolmap; from pathlib import Path; from pano_mvs.api import write_png;"
        "[write_png(Path(sys.argv[1]), np.random.default_rng(n).integers(0, 255, (300, 300, 3)).astype(np.uint8))"
        " for n in range(9)]"
    )
    subprocess.run([sys.executable, "-c", code, os.devnull], check=True)


@pytest.mark.parametrize("shape", [(3, 5), (3, 5, 3)])
def test_maps_have_colmaps_layout(tmp_path: Path, shape: tuple[int, ...]) -> None:
    """Text `width&height&channels&`, then planes; read here as COLMAP's own script does, column by column."""
    values = np.random.default_rng(1).normal(size=shape).astype(np.float32)
    values[1, 2] = np.nan
    path = tmp_path / "map.bin"
    (write_depth_map if len(shape) == 2 else write_normal_map)(path, values)
    data = path.read_bytes()
    width, height, channels = (int(text) for text in data.split(b"&", 3)[:3])
    assert (width, height, channels) == (5, 3, 1 if len(shape) == 2 else 3)
    planes = np.frombuffer(data.split(b"&", 3)[3], "<f4").reshape((width, height, channels), order="F")
    expected = np.nan_to_num(values.reshape(3, 5, channels), nan=0)
    np.testing.assert_array_equal(planes.transpose(1, 0, 2), expected)
    np.testing.assert_array_equal(read_colmap_map(path).reshape(3, 5, channels), expected)


@pytest.mark.parametrize("data", [b"", b"5&3&1&", b"5&3&1&" + bytes(59), b"5&3&x&" + bytes(60), b"-5&3&1&" + bytes(60)])
def test_broken_maps_are_named(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "map.bin"
    path.write_bytes(data)
    with pytest.raises(InputError, match="not a complete depth or normal map"):
        read_colmap_map(path)
    with pytest.raises(InputError, match="cannot be read"):
        read_colmap_map(tmp_path / "none.bin")


def test_other_arrays_are_no_maps(tmp_path: Path) -> None:
    doubles: Any = np.zeros((3, 4))
    with pytest.raises(UsageError, match="a depth map is"):
        write_depth_map(tmp_path / "a", doubles)
    with pytest.raises(UsageError, match="a normal map is"):
        write_normal_map(tmp_path / "a", np.zeros((3, 4), np.float32))


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("form", ["bin", "txt"])
def test_pycolmap_reads_rigs_frames_and_poses(tmp_path: Path, layout: FaceLayout, form: Literal["bin", "txt"]) -> None:
    poses, faces = noisy_poses(), faces_of(layout)
    write_rig_model(tmp_path, poses, cuts(layout), form=form)
    files = {"cameras", "images", "points3D", "rigs", "frames"}
    assert {path.name for path in tmp_path.iterdir()} == {f"{name}.{form}" for name in files}
    model = pycolmap.Reconstruction(str(tmp_path))
    assert (model.num_rigs(), model.num_cameras(), model.num_frames()) == (1, len(faces), 4)
    assert model.num_reg_images() == 4 * len(faces)
    by_name = {f"{name}_{face.name}.jpg": (face.view, idx) for face in faces for idx, name in enumerate(NAMES)}
    assert {image.name for image in model.images.values()} == set(by_name)
    for image in model.images.values():
        view, idx = by_name[image.name]
        camera = model.cameras[image.camera_id]
        assert (camera.model_name, camera.width, camera.height) == ("PINHOLE", 240, 240)
        assert camera.calibration_matrix() == pytest.approx(view.calibration)
        pose = image.cam_from_world()
        assert pose.rotation.matrix() == pytest.approx(view.view_from_cam @ poses.rotations[idx], abs=1e-9)
        assert pose.translation == pytest.approx(view.view_from_cam @ poses.translations[idx], abs=1e-9)
    rig = model.rigs[1]
    assert all(np.all(pose.translation == 0) for pose in rig.non_ref_sensors.values())


@pytest.mark.parametrize("layout", LAYOUTS)
def test_tracks_lie_in_the_faces_and_project_onto_their_key_points(tmp_path: Path, layout: FaceLayout) -> None:
    poses = noisy_poses()
    seen = write_rig_model(tmp_path, poses, cuts(layout))
    model = pycolmap.Reconstruction(str(tmp_path))
    assert model.num_points3D() == len(poses.points_in_world)
    assert sum(seen.values()) == model.compute_num_observations() == len(poses.track_point_idx)
    errors = []
    for image in model.images.values():
        assert image.num_points2D() == seen[image.name]
        for key_point in image.points2D:
            assert (key_point.xy >= 0).all()
            assert (key_point.xy < 240).all()
            errors.append(np.linalg.norm(image.project_point(model.points3D[key_point.point3D_id].xyz) - key_point.xy))
    assert np.median(errors) < 0.3
    assert max(errors) < 2
    expected = sorted(map(tuple, poses.points_in_world.tolist()))
    assert sorted(tuple(point.xyz.tolist()) for point in model.points3D.values()) == expected
    colors = {tuple(point.xyz.tolist()): tuple(point.color) for point in model.points3D.values()}
    assert all(
        colors[tuple(xyz.tolist())] == tuple(color)
        for xyz, color in zip(poses.points_in_world, poses.point_colors_rgb, strict=True)
    )


def test_panoramas_cut_otherwise_have_a_rig_of_their_own(tmp_path: Path) -> None:
    mixed = cuts("cube", NAMES[:2]) | cuts("icosahedron", NAMES[2:])
    write_rig_model(tmp_path, noisy_poses(), mixed)
    model = pycolmap.Reconstruction(str(tmp_path))
    assert (model.num_rigs(), model.num_cameras(), model.num_reg_images()) == (2, 26, 52)
    assert len({image.camera_id for image in model.images.values()}) == 26


def test_panoramas_without_faces_and_points_that_nobody_sees_are_left_out(tmp_path: Path) -> None:
    """OpenMVS reads points3D.txt as far as the first point without a track."""
    poses = noisy_poses()
    write_rig_model(tmp_path, poses, cuts(names=NAMES[2:]))
    model = pycolmap.Reconstruction(str(tmp_path))
    assert model.num_frames() == 2
    seen = set(poses.track_point_idx[poses.track_image_idx >= 2].tolist())
    assert 0 < model.num_points3D() == len(seen) < 200
    assert min(point.track.length() for point in model.points3D.values()) >= 1


def test_the_text_model_is_what_openmvs_reads(tmp_path: Path) -> None:
    """InterfaceCOLMAP: PINHOLE and four numbers; two lines an image, the second may be empty; points with tracks."""
    write_rig_model(tmp_path, noisy_poses(), cuts())
    lines = {
        name: [line for line in (tmp_path / f"{name}.txt").read_text().splitlines() if not line.startswith("#")]
        for name in ("cameras", "images", "points3D")
    }
    assert all(line.split()[1] == "PINHOLE" and len(line.split()) == 8 for line in lines["cameras"])
    assert len(lines["images"]) == 2 * 24
    assert all(len(line.split()) == 10 for line in lines["images"][::2])
    assert all(len(line.split()) % 3 == 0 for line in lines["images"][1::2])
    assert all(len(line.split()) >= 10 and len(line.split()) % 2 == 0 for line in lines["points3D"])


def test_configurations_name_every_picture(tmp_path: Path) -> None:
    names = ["front/a b/1.jpg", "up/ä.jpg"]
    files = write_stereo_configs(tmp_path, names)
    match, fusion = (files[f"colmap_dense/stereo/{name}.cfg"].read_text("utf-8") for name in ("patch-match", "fusion"))
    assert match.splitlines() == [names[0], "__auto__, 20", names[1], "__auto__, 20"]
    assert fusion.splitlines() == names


@pytest.mark.parametrize(
    ("suffix", "largest"), [(".png", 0), (".jpg", 12), (".JPEG", 12), (".webp", 20), (".heic", 12)]
)
def test_pictures_keep_their_colors(tmp_path: Path, suffix: str, largest: int) -> None:
    smooth = np.indices((40, 40)).sum(axis=0).astype(np.uint8) * 3
    picture = np.stack([smooth, smooth[::-1], 255 - smooth], axis=-1)
    write_picture(tmp_path / f"a{suffix}", picture)
    assert np.abs(decode_image(tmp_path / f"a{suffix}").astype(int) - picture).max() <= largest
