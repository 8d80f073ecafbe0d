"""Panoramic videos: their headers, and their frames between two times.

Times are the container's time stamps, so that the frame rate may vary. Frames are not addressed by number. Choosing
keyframes decodes the whole video, but every command has to list them: their times are among the user's caches.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import InputError
from pano_mvs.core.paths import is_file, is_folder, problem_of
from pano_mvs.core.text import shortened_list
from pano_mvs.io.images.captures import (
    UNSTITCHED_SUFFIXES,
    VIDEO_SUFFIXES,
    files_below,
    natural_key,
    unstitched_reason,
)
from pano_mvs.io.kept_file import KeptFile
from pano_mvs.scene.stereo import StereoLayout, StereoSetting, eye_size_hw, one_eye, stereo_layout

os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # our own errors replace FFmpeg's messages

_UNSTITCHED = "export it as an equirectangular video with the camera maker's program first"
_SLACK_S = 0.0015  # some containers round time stamps to milliseconds


@dataclass(frozen=True)
class VideoInfo:
    """The header of a video."""

    size_hw: tuple[int, int]  # (height, width) of a frame as stored
    frames: int
    frames_per_s: float  # average frame rate
    is_turned: bool  # whether the header asks players to rotate the frames
    # how a frame shows both eyes. Then `size_hw` is that of the picture of one eye.
    stereo: StereoLayout = "none"


def list_videos(path: Path, notes: list[str] | None = None) -> list[Path]:
    """Return a video, or all videos in a folder and its subfolders in natural order.

    Raises:
        InputError: if there is no video, or only recordings that must be stitched first.
    """
    if is_file(path):
        if path.suffix.lower() in UNSTITCHED_SUFFIXES:
            raise InputError(f"{path.parent}: the video is {unstitched_reason(path)}")
        return [path]
    if not is_folder(path):
        raise InputError(
            f"{path}: no such video or folder ({problem_of(path) or 'it is neither'}). Give a video, "
            "several, or the folder that holds them"
        )
    notes = [] if notes is None else notes
    files = list(files_below(path, notes))
    videos = [file for file in files if file.suffix.lower() in VIDEO_SUFFIXES]
    unstitched = [file for file in files if file.suffix.lower() in UNSTITCHED_SUFFIXES]
    if not videos and unstitched:
        raise InputError(f"{path}: no videos here that can be used, but {unstitched_reason(unstitched[0])}")
    if not videos:
        kinds = ", ".join(sorted(suffix.lstrip(".") for suffix in VIDEO_SUFFIXES))
        raise InputError(f"{path}: no videos here; supported formats: {kinds}. For images, use source.folder")
    if unstitched:
        names = shortened_list([file.name for file in unstitched])
        notes.append(f"{path}: recordings that are not stitched yet are skipped: {names}")
    return sorted(videos, key=lambda file: natural_key(file.relative_to(path).as_posix()))


def describe_video(path: Path, stereo: StereoSetting = "auto") -> VideoInfo:
    """Return the header of a video after checking that its frames may be panoramas.

    Args:
        stereo: how its frames show both eyes; "auto": as its metadata say, else if square frames, or frames four times
            as wide as high, have two halves that are nearly equal.

    Raises:
        InputError: if it cannot be opened, or its frames are not twice as wide as high.
    """
    with _opened(path) as capture:
        height, width = (int(capture.get(key)) for key in (cv2.CAP_PROP_FRAME_HEIGHT, cv2.CAP_PROP_FRAME_WIDTH))
        rate, count = capture.get(cv2.CAP_PROP_FPS), capture.get(cv2.CAP_PROP_FRAME_COUNT)
        is_turned = int(capture.get(cv2.CAP_PROP_ORIENTATION_META)) % 360 != 0
    if not (np.isfinite(rate) and rate > 0 and count >= 1):
        raise InputError(
            f"{path}: does not say how long it lasts ({count:.0f} frames at {rate:g} a second): the "
            "recording was not finished. Copy it into an .mp4 with a video program"
        )
    layout = stereo
    if layout == "auto":
        frames = (frame for _, frame in frames_between(path, 0.0, np.inf))
        layout = stereo_layout(path, (height, width), _movie_header(path), picture=lambda: next(frames, None))
    if layout != "none":
        height, width = eye_size_hw((height, width), layout)
    if width != 2 * height:
        raise InputError(
            f"{path}: {width}×{height} px frames are not equirectangular, which are twice as wide as high. If it is "
            f"unstitched (two fisheye images, or cube faces), {_UNSTITCHED}; of a stereo video, set "
            "`stereo` to top_bottom or left_right"
        )
    return VideoInfo((height, width), int(count), float(rate), is_turned, layout)


def _movie_header(path: Path) -> bytes:
    """Return the box `moov` of an MP4 file, in which its metadata are; nothing for other files."""
    with path.open("rb") as file:
        length = file.seek(0, os.SEEK_END)
        file.seek(0)
        while len(head := file.read(16)) == 16:
            size, kind = int.from_bytes(head[:4], "big"), head[4:8]
            size = int.from_bytes(head[8:], "big") if size == 1 else size
            if kind == b"moov":
                return head + file.read(min(size, 64 << 20))
            if not 8 <= size <= length:  # it ends with the file, or is damaged
                break
            file.seek(size - 16, os.SEEK_CUR)
    return b""


def frames_between(
    path: Path,
    begin_s: float,
    end_s: float,
    *,
    min_step_s: float = 0.0,
    threads: int = 1,
    stereo: StereoLayout = "none",
) -> Iterator[tuple[float, NDArray[np.uint8]]]:
    """Yield the time in seconds and the frame, (H, W, 3) uint8 BGR, of frames between two times, inclusive.

    Iteration ends at a frame that cannot be decoded.

    Args:
        begin_s: the first time, from the start of the video.
        min_step_s: minimum time between two frames; frames in between are left out. 0 yields all.
        threads: number of threads of the decoder, each of which may hold a frame in memory.
        stereo: how a frame shows both eyes, of which one is returned.

    Raises:
        InputError: if the video cannot be opened, or its time stamps do not increase.
    """
    with _opened(path, threads) as capture:
        previous, yielded = -1.0, -np.inf
        has_frame = _seek(capture, begin_s)
        while has_frame:
            time_s = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
            if time_s <= previous:
                raise InputError(
                    f"{path}: its time stamps do not increase ({previous:.3f} s, then {time_s:.3f} s). "
                    "Copy it into an .mp4 with a video program"
                )
            if time_s > end_s + _SLACK_S:
                return
            if time_s >= max(begin_s, yielded + min_step_s) - _SLACK_S:
                is_decoded, frame = capture.retrieve()
                if not is_decoded:
                    return
                yielded = time_s
                yield time_s, one_eye(frame, stereo)
            previous = time_s
            has_frame = capture.grab()


def frame_on_display(
    path: Path, time_s: float, *, threads: int = 1, stereo: StereoLayout = "none"
) -> tuple[float, NDArray[np.uint8]] | None:
    """Return the time and image of the frame that a player shows at a time between two frames, as `frames_between`.

    Returns:
        None if no later frame can be decoded: then the video is damaged, or ends before.
    """
    shown_s = None
    with _opened(path, threads) as capture:
        has_frame = _seek(capture, time_s)
        while has_frame and (next_s := capture.get(cv2.CAP_PROP_POS_MSEC) / 1000) <= time_s + _SLACK_S:
            shown_s = next_s
            has_frame = capture.grab()
    if shown_s is None or not has_frame:
        return None
    return next(frames_between(path, shown_s, shown_s, threads=threads, stereo=stereo), None)


def _seek(capture: cv2.VideoCapture, time_s: float) -> bool:
    """Seek a frame at or before a time; return whether it exists.

    OpenCV assumes a constant frame rate and may arrive behind the time. Then an earlier time is tried.
    """
    ahead_s = 0.0
    while True:
        begin_s = max(0.0, time_s - ahead_s)
        capture.set(cv2.CAP_PROP_POS_MSEC, begin_s * 1000)
        has_frame = capture.grab()
        if begin_s == 0.0 or (has_frame and capture.get(cv2.CAP_PROP_POS_MSEC) / 1000 <= time_s + _SLACK_S):
            return bool(has_frame)
        ahead_s = max(1.0, 4 * ahead_s)


@contextmanager
def _opened(path: Path, threads: int = 1) -> Iterator[cv2.VideoCapture]:
    if not is_file(path):
        raise InputError(f"{path}: no such video ({problem_of(path) or 'it is not a file'})")
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG, [cv2.CAP_PROP_N_THREADS, threads])
    try:
        if not capture.isOpened():
            raise InputError(
                f"{path}: cannot be opened as a video: it is not a video, is damaged, or its recording was not "
                "finished. Copy it again from the camera, or repair it with a video program"
            )
        capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
        yield capture
    finally:
        capture.release()


def read_times(kept: KeptFile) -> list[float] | None:
    """Return the stored times in seconds; None if there are none, or the file is damaged."""
    try:
        times = json.loads(kept.read())
    except (ValueError, RecursionError):
        return None
    if not isinstance(times, list) or not all(isinstance(time, float) and math.isfinite(time) for time in times):
        return None
    return times
