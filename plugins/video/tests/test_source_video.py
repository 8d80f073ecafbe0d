"""Panoramas from videos: the right frames, the sharpest of them, and clear words for what is no panoramic video.

Of stereo panoramas, the left eye is used, whether their metadata or their shape says that they are such.
"""

from __future__ import annotations

import shutil
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from pano_mvs_video.keyframes import select_keyframes
from pano_mvs_video.source import VideoParams, list_frames, video
from pano_mvs_video.video_files import describe_video, frames_between, list_videos
from walked_room import grey_from

from pano_mvs.core.arrays import Picture
from pano_mvs.core.errors import InputError
from pano_mvs.engine.stages.context import Context
from pano_mvs.engine.stages.stage import SourceItem
from pano_mvs.geometry import Rigid3
from pano_mvs.scene import Panorama
from pano_mvs.scene.image_file import decode_image
from pano_mvs.scene.stereo import is_stereo, one_eye
from pano_mvs.stages.source import FolderParams, folder
from pano_mvs.testing.room import capture_poses, default_room, render
from tests.io.images.pictures import app1
from tests.synthetic.video_files import counted, number_of, retimed, write_video


def params(path: Path | list[Path], **more: Any) -> VideoParams:
    return VideoParams.model_validate({"path": path, **more})


def taken(settings: VideoParams, tmp_path: Path) -> dict[str, tuple[int, Context, Panorama]]:
    """Return, by name, the number in each frame that the source takes, what it reported, and the panorama."""
    found = {}
    for idx, item in enumerate(list_frames(settings)):
        context = Context(np.random.default_rng(0), tmp_path / f"scratch{idx}")
        context.scratch.mkdir()
        panorama = video(item, settings, context)
        panorama.check()
        found[item.name] = number_of(decode_image(panorama.image.path)), context, panorama
    return found


def test_frames_come_at_even_steps_under_names_with_their_time(tmp_path: Path) -> None:
    path = write_video(tmp_path / "walk.avi", 60)
    found = taken(params(path, every_s=0.5, pick="nearest"), tmp_path)
    assert list(found) == [f"walk_{ms:08d}ms.png" for ms in range(0, 3000, 500)]
    assert [number for number, _, _ in found.values()] == [0, 10, 20, 30, 40, 50]
    times = [context.metrics["time_s"] for _, context, _ in found.values()]
    assert times == pytest.approx([0, 0.5, 1, 1.5, 2, 2.5])
    panorama = found["walk_00000500ms.png"][2]
    assert (panorama.size_hw, panorama.source_size_hw) == ((64, 128), (64, 128))


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"every_frames": 20}, [0, 20, 40]),
        ({"start_s": 0.25, "end_s": 1.6}, [5, 25]),
        ({"every_s": 0.1, "max_frames": 4}, [0, 20, 39, 59]),
        ({"every_frames": 1, "start_s": 2.9}, [58, 59]),
    ],
)
def test_steps_in_frames_a_part_of_the_video_and_a_limit(
    tmp_path: Path, settings: dict[str, Any], expected: list[int]
) -> None:
    path = write_video(tmp_path / "walk.avi", 60)
    found = taken(params(path, pick="nearest", **settings), tmp_path)
    numbers = [number for number, _, _ in found.values()]
    assert numbers == pytest.approx(expected, abs=1)  # a limit puts steps between two frames
    assert len(set(numbers)) == len(expected)


def test_the_sharpest_frame_within_a_quarter_of_a_step_is_taken(tmp_path: Path) -> None:
    blur = {10: 1, 28: 1, 1: 2, 18: 2, 44: 2}  # the sharpest of all, 10 and 28, are near no step

    def shaken(number: int) -> Picture:
        frame = counted(number)
        shake = cv2.blur(frame, (blur.get(number, 5), 1))
        result: Picture = np.clip(shake * (0.6 if number == 18 else 1.0), 0, 255).astype(np.uint8)
        return result  # in a dark moment

    path = write_video(tmp_path / "walk.avi", 50, shaken, per_s=10)
    found = taken(params(path, every_s=2.0), tmp_path)
    assert [number for number, _, _ in found.values()] == [1, 18, 44]
    context = found["walk_00002000ms.png"][1]
    assert context.metrics["time_s"] == pytest.approx(1.8)


def test_frames_are_kept_without_loss(tmp_path: Path) -> None:
    path = write_video(tmp_path / "walk.mp4", 10)
    capture = cv2.VideoCapture(str(path))
    decoded = [capture.read()[1] for _ in range(10)]
    found = taken(params(path, every_frames=5), tmp_path)
    for number, _, panorama in found.values():
        np.testing.assert_array_equal(decode_image(panorama.image.path)[..., ::-1], decoded[number])


@pytest.mark.parametrize("suffix", [".mp4", ".avi"])
def test_seeking_finds_what_reading_through_finds(tmp_path: Path, suffix: str) -> None:
    path = write_video(tmp_path / f"walk{suffix}", 60)
    through = [(time_s, number_of(frame)) for time_s, frame in frames_between(path, 0, 99)]
    assert [number for _, number in through] == list(range(60))
    for begin, end in ((0.0, 0.0), (0.72, 0.93), (1.0, 1.3), (2.9, 9.0), (5.0, 6.0)):
        found = [number_of(frame) for _, frame in frames_between(path, begin, end)]
        assert found == [number for time_s, number in through if begin - 0.001 <= time_s <= end + 0.001]


def test_frames_can_be_left_out_while_reading(tmp_path: Path) -> None:
    path = write_video(tmp_path / "walk.mp4", 40)
    found = [number_of(frame) for _, frame in frames_between(path, 0.5, 1.6, min_step_s=0.2)]
    assert found == [10, 14, 18, 22, 26, 30]


def test_a_frame_rate_that_varies_does_no_harm(tmp_path: Path) -> None:
    """OpenCV seeks as if frames came evenly; the container's own time stamps decide."""
    path = write_video(tmp_path / "walk.mp4", 60)
    durations = np.random.default_rng(0).uniform(0.02, 0.25, 60)
    durations[30] = 3.0  # nothing moved, so nothing was recorded
    retimed(path, durations.tolist())
    times = np.concatenate([[0], np.cumsum(durations)[:-1]])
    for begin in (0.5, 2.0, times[30] - 0.3, times[31], times[50]):
        found = [number_of(frame) for _, frame in frames_between(path, begin, begin + 0.6)]
        expected = np.flatnonzero((times >= begin - 0.001) & (times <= begin + 0.601))
        assert found == expected.tolist()


@pytest.mark.parametrize("every_s", [0.1, 0.5])
def test_between_two_frames_the_one_on_display_is_used(tmp_path: Path, every_s: float) -> None:
    """Times without a frame nearby were refused: the video was said to be damaged."""
    path = write_video(tmp_path / "walk.mp4", 60)
    durations = np.random.default_rng(0).uniform(0.02, 0.25, 60)
    durations[30] = 3.0  # nothing moved, so nothing was recorded
    retimed(path, durations.tolist())
    times = np.concatenate([[0], np.cumsum(durations)[:-1]])
    begin_s = round(float(times[30]), 1) + 0.5
    found = taken(params(path, pick="nearest", start_s=begin_s, end_s=begin_s + 3.1, every_s=every_s), tmp_path)
    for idx, (number, context, _) in enumerate(found.values()):
        wanted_s = begin_s + idx * every_s
        shown = int(np.searchsorted(times, wanted_s + 0.001, side="right")) - 1
        assert number == pytest.approx(shown, abs=1), "a frame nearby, or the one on display"
        assert context.metrics["time_s"] == pytest.approx(times[number], abs=0.002)
        assert any("the frame rate of the video varies" in note for note in context.notes) == (
            times[number] < wanted_s - max(every_s / 4, 0.51 * durations.mean()) - 0.001
        )
    assert [number for number, _, _ in found.values()][:5] == [30] * 5


def test_several_videos_and_folders_of_them(tmp_path: Path) -> None:
    (tmp_path / "walks/day 2").mkdir(parents=True)
    for name in ("walks/b.avi", "walks/a10.avi", "walks/a2.AVI", "walks/day 2/b.avi"):
        write_video((tmp_path / name).with_suffix(".avi"), 12)
    (tmp_path / "walks/a2.avi").rename(tmp_path / "walks/a2.AVI")
    for ignored in ("notes.txt", ".trash/b.avi", "masks/b.avi", "out/b.avi", "out/.pano-mvs-output"):
        (tmp_path / "walks" / ignored).parent.mkdir(exist_ok=True)
        (tmp_path / "walks" / ignored).write_text("x")
    names = [item.name for item in list_frames(params(tmp_path / "walks", every_s=0.5))]
    assert [name.rpartition("_")[0] for name in names[::2]] == ["a2", "a10", "b", "day 2/b"]
    both = params([tmp_path / "walks/b.avi", tmp_path / "walks/a10.avi"], every_s=0.5)
    assert [item.name for item in list_frames(both)][::2] == ["b_00000000ms.png", "a10_00000000ms.png"]


def test_videos_of_one_name_are_told_apart_or_refused(tmp_path: Path) -> None:
    """They ended in "listed twice", without a word of which videos, and what to do."""
    for name in ("walk.avi", "a/way.avi", "b/way.avi"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        write_video(tmp_path / name, 30)
    shutil.copy(tmp_path / "walk.avi", tmp_path / "walk.mp4")  # FFmpeg looks at the contents
    names = [item.name for item in list_frames(params(tmp_path, start_s=0.0, end_s=0.5))]
    assert names == [f"{name}_00000000ms.png" for name in ("a/way", "b/way", "walk.avi", "walk.mp4")]
    listed = [tmp_path / "a/way.avi", tmp_path / "b/way.avi"]
    with pytest.raises(InputError, match=r"way\.avi and .*way\.avi: frames of both would be called after way\.avi"):
        list(list_frames(params(listed)))


def test_mask_and_cuts_are_as_for_pictures(tmp_path: Path) -> None:
    keep = np.full((64, 128), 255, np.uint8)
    keep[:, :32] = 0
    cv2.imwrite(str(tmp_path / "mask.png"), keep)
    path = write_video(tmp_path / "walk.avi", 20)
    found = taken(params(path, every_s=0.5, mask=tmp_path / "mask.png", nadir_deg=30, max_width=64), tmp_path)
    panorama = next(iter(found.values()))[2]
    assert panorama.size_hw == (32, 64)
    valid = panorama.load_mask()
    assert not valid[:, :15].any()
    assert not valid[-5:].any()
    assert valid[5:20, 20:60].all()


def fisheyes(number: int) -> Picture:
    frame = np.zeros((64, 128, 3), np.uint8)
    for left in (32, 96):
        cv2.circle(frame, (left, 32), 30, (150, 120, 90 + number), -1)
    return frame


@pytest.mark.parametrize(
    ("name", "picture", "what"),
    [
        ("square.avi", lambda number: counted(number, (128, 128)), "128×128 px frames are not equirectangular"),
        ("flat.avi", lambda number: counted(number, (72, 128)), "128×72 px frames are not equirectangular"),
        ("two.avi", fisheyes, "two fisheye images side by side"),
    ],
)
def test_what_is_no_panorama_must_be_stitched_first(tmp_path: Path, name: str, picture: Any, what: str) -> None:
    path = write_video(tmp_path / name, 12, picture)
    with pytest.raises(InputError, match=rf"{name}: .*{what}.*export|{name}: {what}.*Export"):
        list(list_frames(params(path, every_s=0.2)))


def test_what_the_camera_records_before_stitching_is_known_by_its_name(tmp_path: Path) -> None:
    (tmp_path / "VID_1.insv").write_bytes(b"x")
    for path in (tmp_path, tmp_path / "VID_1.insv"):
        with pytest.raises(InputError, match=r"VID_1\.insv, which a camera .*equirectangular video"):
            list(list_frames(params(path)))


@pytest.mark.parametrize("damage", ["unfinished", "text", "empty"])
def test_what_cannot_be_opened_is_named(tmp_path: Path, damage: str, capfd: pytest.CaptureFixture[str]) -> None:
    path = write_video(tmp_path / "walk.mp4", 20)
    data = path.read_bytes()
    path.write_bytes({"unfinished": data[: len(data) // 2], "text": b"hello", "empty": b""}[damage])
    with pytest.raises(InputError, match=r"walk\.mp4: cannot be opened as a video.* or repair it"):
        list(list_frames(params(path)))
    assert capfd.readouterr() == ("", ""), "FFmpeg's own messages are not for people"


def test_a_video_that_cannot_be_used_does_not_stop_the_others(tmp_path: Path) -> None:
    write_video(tmp_path / "good.avi", 30)
    (tmp_path / "bad.avi").write_bytes(b"hello")
    *frames, bad = list_frames(params(tmp_path, every_s=0.5))
    assert len(frames) >= 2
    assert {item.problem for item in frames} == {""}
    assert bad.name == "bad"
    assert "bad.avi: cannot be opened as a video" in bad.problem
    with pytest.raises(InputError, match=r"bad\.avi: cannot be opened"):
        list(list_frames(params(tmp_path, every_s=50)))


def test_a_video_that_ends_early_gives_what_it_has(tmp_path: Path) -> None:
    path = write_video(tmp_path / "walk.avi", 60)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    assert describe_video(path).frames == 60
    items = list(list_frames(params(path, every_s=0.5)))
    context = Context(np.random.default_rng(0), tmp_path)
    assert number_of(decode_image(video(items[1], params(path, every_s=0.5), context).image.path)) in range(8, 13)
    with pytest.raises(InputError, match=r"no frame from 2\.375 s on can be decoded.*ends before its header says"):
        video(items[5], params(path, every_s=0.5), context)


def walk_and_turn(number: int) -> Picture:
    """A camera that walks for a second, turns for a second, and walks on."""
    x = 0.09 * (min(number, 10) + max(0, number - 20)) - 0.9
    grey = grey_from(x, (0, 18.0 * min(max(number - 10, 0), 10), 0), seed=number)
    result: Picture = np.repeat(grey[..., None], 3, axis=2)
    return result


def test_keyframes_by_motion_leave_out_where_the_camera_only_turns(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "caches"))
    path = write_video(tmp_path / "walk.avi", 30, walk_and_turn, per_s=10)
    settings = params(path, keyframes="motion", motion_deg=6.0)
    items = list(list_frames(settings))
    times_ms = [int(item.name[5:13]) for item in items]
    assert len(times_ms) == pytest.approx(5, abs=1)
    assert sum(1150 < time < 1950 for time in times_ms) <= 1
    fewer = [item.name for item in list_frames(params(path, keyframes="motion", motion_deg=6.0, max_frames=3))]
    assert (fewer[0], fewer[-1], len(fewer)) == (items[0].name, items[-1].name, 3)
    context = Context(np.random.default_rng(0), tmp_path)
    video(items[1], settings, context)
    assert context.metrics["time_s"] == pytest.approx(times_ms[1] / 1000, abs=0.06)


def test_keyframes_by_motion_are_chosen_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "caches"))
    path = write_video(tmp_path / "walk.avi", 12, walk_and_turn, per_s=10)
    chosen: list[Any] = []

    def counted_choice(*given: Any) -> Any:
        chosen.append(given)
        return select_keyframes(*given)

    monkeypatch.setattr("pano_mvs_video.source.select_keyframes", counted_choice)
    settings = params(path, keyframes="motion", motion_deg=4.0)
    first = [item.name for item in list_frames(settings)]
    assert [item.name for item in list_frames(settings)] == first
    assert len(chosen) == 1
    (stored,) = (tmp_path / "caches").rglob("*.json")
    stored.write_text("[NaN]")
    assert [item.name for item in list_frames(settings)] == first
    assert len(chosen) == 2
    list(list_frames(params(path, keyframes="motion", motion_deg=5.0)))
    write_video(path, 13, walk_and_turn, per_s=10)
    list(list_frames(settings))
    assert len(chosen) == 4


def test_a_camera_that_never_moves_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "caches"))
    path = write_video(tmp_path / "walk.avi", 12, lambda _: walk_and_turn(0), per_s=10)
    with pytest.raises(InputError, match=r"walk\.avi: gives 1 frame; .*hardly moves"):
        list(list_frames(params(path, keyframes="motion")))


@pytest.mark.parametrize(
    ("settings", "what"),
    [
        ({"every_s": 1, "keyframes": "motion"}, "steps in time: use motion_deg"),
        ({"min_s": 2, "max_s": 1}, "max_s must not be less than min_s"),
        ({"every_s": 1, "every_frames": 3}, "give every_s or every_frames, not both"),
        ({"start_s": 2, "end_s": 1}, "end_s must be greater than start_s"),
    ],
)
def test_settings_that_contradict_each_other(tmp_path: Path, settings: dict[str, Any], what: str) -> None:
    with pytest.raises(ValueError, match=what):
        params(tmp_path, **settings)


def test_too_few_frames_are_told(tmp_path: Path) -> None:
    path = write_video(tmp_path / "walk.avi", 10)
    with pytest.raises(InputError, match=r"walk\.avi: gives 1 frame; .*every_s"):
        list(list_frames(params(path, every_s=5)))
    with pytest.raises(InputError, match=r"no such video or folder"):
        list(list_frames(params(tmp_path / "gone.mp4")))
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"no videos here.*source\.folder"):
        list(list_frames(params(tmp_path / "empty")))


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


@pytest.mark.parametrize(("name", "rig"), [("VID_1.insv", True), ("GS010001.360", False)])
def test_recordings_that_are_not_stitched_say_so(tmp_path: Path, name: str, rig: bool) -> None:
    (tmp_path / name).touch()
    for path in (tmp_path, tmp_path / name):
        with pytest.raises(InputError, match=rf"{name}, which a camera .* recorded .*Export it as") as caught:
            list_videos(path)
        assert ("source.dual_fisheye" in str(caught.value)) == rig
