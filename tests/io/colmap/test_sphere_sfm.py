"""SphereSfM's models, text and binary, made by hand: COLMAP's own reader cannot read them."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from pano_mvs.core.errors import InputError
from pano_mvs.geometry import Rigid3, quat_wxyz_from_rotation
from pano_mvs.io.poses.files import read_poses
from pano_mvs.scene import Poses
from pano_mvs.testing.room import capture_poses

POSES = dict(zip(("a 10.jpg", "a 2.jpg", "ä.png"), capture_poses(3, seed=5), strict=True))
ORDER = ("a 2.jpg", "a 10.jpg", "ä.png")


def numbers(pose: Rigid3) -> list[float]:
    return [*quat_wxyz_from_rotation(pose.rotation), *pose.translation]


def write_text(folder: Path, camera: str = "SPHERE 1024 512 1 512 256") -> None:
    (folder / "cameras.txt").write_text(f"# Camera list\n1 {camera}\n")
    lines = ["# Image list", "# two lines each"]
    for idx, (name, pose) in enumerate(POSES.items(), 1):
        keypoints = "" if idx == 2 else "1.5 2.5 -1 3 4 7"
        lines += [" ".join([str(idx), *(repr(float(n)) for n in numbers(pose)), "1", name]), keypoints]
    (folder / "images.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    (folder / "points3D.txt").write_text("")


def write_binary(folder: Path, camera_id: int = 11) -> None:
    (folder / "cameras.bin").write_bytes(struct.pack("<QIiQQ3d", 1, 1, camera_id, 1024, 512, 1.0, 512.0, 256.0))
    data = struct.pack("<Q", len(POSES))
    for idx, (name, pose) in enumerate(POSES.items(), 1):
        data += struct.pack("<I7dI", idx, *numbers(pose), 1) + name.encode() + b"\0"
        data += struct.pack("<Q", idx) + struct.pack("<ddq", 1.5, 2.5, -1) * idx
    (folder / "images.bin").write_bytes(data)
    (folder / "points3D.bin").write_bytes(struct.pack("<Q", 0))


def assert_same(found: Poses) -> None:
    found.check()
    assert found.names == ORDER
    assert not found.metric
    for idx, name in enumerate(ORDER):
        assert found.rotations[idx] == pytest.approx(POSES[name].rotation, abs=1e-12)
        assert found.translations[idx] == pytest.approx(POSES[name].translation, abs=1e-12)


def test_text_and_binary_are_read(tmp_path: Path) -> None:
    write_text(tmp_path)
    assert_same(read_poses(tmp_path))
    write_binary(tmp_path)
    (tmp_path / "images.txt").write_text("the binary files go first, as in COLMAP")
    assert_same(read_poses(tmp_path))


def test_the_same_number_with_other_parameters_is_colmaps_own(tmp_path: Path) -> None:
    """Only SphereSfM gives number 11 three parameters; anything else is left to COLMAP itself."""
    write_binary(tmp_path)
    camera = struct.pack("<QIiQQ4d", 1, 1, 11, 1024, 512, 1.0, 512.0, 256.0, 0.0)
    (tmp_path / "cameras.bin").write_bytes(camera)
    with pytest.raises(InputError, match="RAD_TAN_THIN_PRISM_FISHEYE, expected"):
        read_poses(tmp_path)


@pytest.mark.parametrize("keep", [6, 100, 250])
def test_a_truncated_file_is_named(tmp_path: Path, keep: int) -> None:
    write_binary(tmp_path)
    (tmp_path / "images.bin").write_bytes((tmp_path / "images.bin").read_bytes()[:keep])
    with pytest.raises(InputError, match=r"images\.bin: .*complete"):
        read_poses(tmp_path)


@pytest.mark.parametrize(
    ("line", "what"),
    [
        ("1 1 0 0 0 0 0 0 1", "expected an id, a quaternion"),
        ("1 0 0 0 0 1 2 3 1 a.jpg", "its quaternion is not a rotation"),
        ("1 1 0 0 0 nan 2 3 1 a.jpg", "NaN or infinite"),
        ("1 one 0 0 0 1 2 3 1 a.jpg", "could not convert"),
        ("", "contains no poses"),
    ],
)
def test_a_malformed_text_is_named(tmp_path: Path, line: str, what: str) -> None:
    write_text(tmp_path)
    (tmp_path / "images.txt").write_text(f"# Image list\n{line}\n\n")
    with pytest.raises(InputError, match=rf"images\.txt.*{what}"):
        read_poses(tmp_path)


def test_text_models_of_other_cameras_are_not_taken_for_spheres(tmp_path: Path) -> None:
    write_text(tmp_path, camera="PINHOLE 4 4 2 2 2 2")
    with pytest.raises(InputError, match="PINHOLE, expected EQUIRECTANGULAR"):
        read_poses(tmp_path)


def test_identity_looks_along_z(tmp_path: Path) -> None:
    write_text(tmp_path)
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 2 1 a.jpg\n\n")
    pose = read_poses(tmp_path).cam_from_world(0)
    np.testing.assert_array_equal(pose.apply((0, 0, 0)), (0, 0, 2))
