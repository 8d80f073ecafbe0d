"""Of stereo panoramas, the left eye is used, whether their metadata or their shape says that they are such."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from pano_mvs.core.arrays import Picture
from pano_mvs.core.errors import InputError
from pano_mvs.engine.stages.context import Context
from pano_mvs.engine.stages.stage import SourceItem
from pano_mvs.geometry import Rigid3
from pano_mvs.io.images.video import describe_video
from pano_mvs.scene import Panorama
from pano_mvs.scene.stereo import is_stereo, one_eye
from pano_mvs.stages.source import FolderParams, folder
from pano_mvs.stages.source_video import VideoParams, list_frames, video
from pano_mvs.testing.room import capture_poses, default_room, render
from tests.io.images.pictures import app1
from tests.io.images.videos import write_video

SIZE_HW = (64, 128)
EYES_M = 0.065
XMP = b'http://ns.adobe.com/xap/1.0/\0<x:xmpmeta><rdf:Description GSpherical:StereoMode="%s"/></x:xmpmeta>'


@pytest.fixture(scope="module", name="eyes")
def rendered_eyes() -> list[Picture]:
    """What two places as far apart as eyes see in a room."""
    pose = capture_poses(2, seed=3)[1]
    right = Rigid3.from_center(pose.rotation, pose.center + pose.rotation.T @ [EYES_M, 0, 0])
    return [render(default_room(), one, size_hw=SIZE_HW)[0] for one in (pose, right)]


def read(path: Path, tmp_path: Path, **settings: Any) -> tuple[Panorama, list[str]]:
    scratch = tmp_path / "scratch"
    scratch.mkdir(exist_ok=True)
    context = Context(np.random.default_rng(0), scratch, 1)
    params = FolderParams.model_validate({"path": path.parent, **settings})
    return folder(SourceItem(path.name, {"image": path}), params, context), context.notes


def written(path: Path, picture: Picture, mode: bytes = b"") -> Path:
    data = cv2.imencode(path.suffix, picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 100])[1].tobytes()
    path.write_bytes(data[:2] + app1(XMP % mode) + data[2:] if mode else data)
    return path


@pytest.mark.parametrize(("axis", "note"), [(0, "the upper half is used"), (1, "the left half is used")])
def test_nearly_equal_halves_are_stereo(tmp_path: Path, eyes: list[Picture], axis: int, note: str) -> None:
    panorama, notes = read(written(tmp_path / "a.png", np.concatenate(eyes, axis=axis)), tmp_path)
    panorama.check()
    assert panorama.size_hw == SIZE_HW
    assert np.array_equal(panorama.load(), eyes[0])
    assert note in notes[0]


def test_other_square_pictures_are_refused_with_the_remedy(tmp_path: Path, eyes: list[Picture]) -> None:
    """The lower half is turned, so that it shows something else; or it is half of a picture with a gradient."""
    other = np.concatenate([eyes[0], eyes[1][::-1]])
    gradient = np.repeat(np.tile(np.arange(128, dtype=np.uint8), (128, 1))[..., None], 3, axis=2)
    for picture in (other, gradient):
        assert not is_stereo(picture, "top_bottom")
        with pytest.raises(InputError, match="set `stereo`"):
            read(written(tmp_path / "a.png", picture), tmp_path)


def test_metadata_and_the_setting_say_what_the_shape_does_not(tmp_path: Path, eyes: list[Picture]) -> None:
    squeezed = np.concatenate([cv2.resize(eye, (128, 32), interpolation=cv2.INTER_AREA) for eye in eyes])
    panorama, notes = read(written(tmp_path / "a.jpg", squeezed, b"top-bottom"), tmp_path)
    assert panorama.size_hw == SIZE_HW
    stretched = cv2.resize(squeezed[:32], (128, 64), interpolation=cv2.INTER_CUBIC)
    assert np.abs(panorama.load().astype(int) - stretched).mean() < 3
    assert "stereo" in notes[0]
    (tmp_path / "set").mkdir()
    same, _ = read(written(tmp_path / "set/a.png", squeezed), tmp_path / "set", stereo="top_bottom")
    assert np.array_equal(same.load(), stretched)
    (tmp_path / "mono").mkdir()
    square = written(tmp_path / "mono/a.jpg", np.concatenate(eyes), b"mono")
    with pytest.raises(InputError, match="not a full sphere"):
        read(square, tmp_path / "mono")


def test_half_spheres_are_refused(tmp_path: Path, eyes: list[Picture]) -> None:
    with pytest.raises(InputError, match=r"VR180.*set stereo: left_right"):
        read(written(tmp_path / "a.jpg", eyes[0], b"left-right"), tmp_path)


def stereo_frame(eyes: list[Picture]) -> Picture:
    return np.concatenate(eyes)[..., ::-1].copy()


def test_a_square_video_of_both_eyes_is_read(tmp_path: Path, eyes: list[Picture]) -> None:
    path = write_video(tmp_path / "walk.mp4", 20, lambda _: stereo_frame(eyes))
    params = VideoParams.model_validate({"path": path, "every_s": 0.5})
    items = list(list_frames(params))
    assert len(items) == 2
    (tmp_path / "scratch").mkdir()
    context = Context(np.random.default_rng(0), tmp_path / "scratch", 1)
    panorama = video(items[0], params, context)
    assert panorama.size_hw == SIZE_HW
    assert np.abs(panorama.load().astype(int) - eyes[0]).mean() < 8
    assert "the upper half is used" in context.notes[0]
    with pytest.raises(InputError, match="not equirectangular"):
        describe_video(path, "none")


def test_the_header_of_a_video_says_how_its_eyes_are_arranged(tmp_path: Path, eyes: list[Picture]) -> None:
    path = write_video(tmp_path / "walk.mp4", 3, lambda _: eyes[0])
    assert describe_video(path).stereo == "none"
    data = path.read_bytes()
    at = data.index(b"moov") - 4
    size = struct.unpack(">I", data[at : at + 4])[0]
    box = struct.pack(">I4sIB", 13, b"st3d", 0, 1)
    path.write_bytes(
        data[:at] + struct.pack(">I", size + len(box)) + data[at + 4 : at + size] + box + data[at + size :]
    )
    info = describe_video(path)
    assert (info.stereo, info.size_hw) == ("top_bottom", SIZE_HW), "squeezed eyes are stretched"


def test_an_eye_is_twice_as_wide_as_high() -> None:
    picture = np.arange(8 * 16 * 3, dtype=np.uint8).reshape(8, 16, 3)
    assert one_eye(picture, "none") is picture
    assert one_eye(picture, "left_right").shape == (8, 16, 3)
    assert one_eye(picture, "top_bottom").shape == (8, 16, 3)
    assert np.array_equal(one_eye(np.concatenate([picture, picture + 1]), "top_bottom"), picture)
