"""Models of pycolmap's panorama_sfm: pinhole images of a rig for each panorama."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from pycolmap.panorama import PANO_RENDER_OPTIONS, PanoRenderType, get_virtual_rotations

from pano_mvs.core.errors import InputError
from pano_mvs.geometry import Rigid3, quat_wxyz_from_rotation, rotation_from_rotvec
from pano_mvs.io.poses.files import read_poses
from pano_mvs.stages.poses import known_groups
from pano_mvs.testing.room import capture_poses

POSES = dict(zip(("a/10.jpg", "a/2.jpg", "b.png"), capture_poses(3, seed=5), strict=True))


def virtual_cameras(kind: PanoRenderType) -> list[NDArray[np.float64]]:
    """The rotations of pycolmap itself."""
    options = PANO_RENDER_OPTIONS[kind]
    return [np.asarray(one) for one in get_virtual_rotations(options.num_steps_yaw, options.pitches_deg)]


def write_model(folder: Path, cameras: Mapping[int, NDArray[np.float64]], *, first: str = "") -> Path:
    """Write the images of the given virtual cameras; of the first panorama, those of camera 3 alone."""
    (folder / "cameras.txt").write_text("1 SIMPLE_PINHOLE 512 512 256 256 256\n")
    (folder / "points3D.txt").write_text("")
    lines = [first] if first else []
    for name, pose in POSES.items():
        for number, rotation in cameras.items():
            if name != "a/10.jpg" or number == 3:
                camera = Rigid3(rotation, np.zeros(3)) @ pose
                numbers = [*quat_wxyz_from_rotation(camera.rotation), *camera.translation]
                lines += [f"{len(lines) // 2 + 1} {' '.join(map(str, numbers))} 1 pano_camera{number}/{name}", ""]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    return folder


@pytest.mark.parametrize("kind", [PanoRenderType.PERSPECTIVE_OVERLAPPING, PanoRenderType.PERSPECTIVE_NON_OVERLAPPING])
@pytest.mark.parametrize("numbers", [None, (1, 3), (0, 1, 2, 3)])
def test_panoramas_have_the_pose_of_their_virtual_cameras(
    tmp_path: Path, kind: PanoRenderType, numbers: Sequence[int] | None
) -> None:
    cameras = dict(enumerate(virtual_cameras(kind)))
    found = read_poses(write_model(tmp_path, {number: cameras[number] for number in numbers or cameras}))
    found.check()
    assert found.names == ("a/2.jpg", "a/10.jpg", "b.png")
    for idx, name in enumerate(found.names):
        assert found.rotations[idx] == pytest.approx(POSES[name].rotation, abs=1e-6)
        assert found.translations[idx] == pytest.approx(POSES[name].translation, abs=1e-6)


def test_other_arrangements_are_refused(tmp_path: Path) -> None:
    cameras = dict(enumerate(virtual_cameras(PanoRenderType.PERSPECTIVE_OVERLAPPING)))
    turned = {number: rotation_from_rotvec([0, 0.01 * number, 0]) @ one for number, one in cameras.items()}
    for other in (turned, {3: cameras[3]}):
        with pytest.raises(InputError, match=r"not turned .* Give the model sparse_equirectangular/0"):
            read_poses(write_model(tmp_path, other))


def test_photographs_among_virtual_cameras_are_named(tmp_path: Path) -> None:
    """One photograph made the whole model unusable."""
    cameras = dict(enumerate(virtual_cameras(PanoRenderType.PERSPECTIVE_OVERLAPPING)))
    found = read_poses(write_model(tmp_path, cameras, first="900 1 0 0 0 0 0 0 1 photograph.jpg\n"))
    assert found.names == ("a/2.jpg", "a/10.jpg", "b.png")
    assert found.rejected == {"photograph.jpg": "it is not an image of a panorama's virtual camera (pano_camera0/…)"}
    notes: list[str] = []
    assert len(known_groups(tmp_path, ("a/2.jpg", "b.png"), notes).names) == 2
    assert "photograph.jpg (it is not an image of" in notes[0]
    (tmp_path / "images.txt").write_text("900 1 0 0 0 0 0 0 1 photograph.jpg\n\n")
    with pytest.raises(InputError, match="camera 1 is SIMPLE_PINHOLE, expected EQUIRECTANGULAR"):
        read_poses(tmp_path)
