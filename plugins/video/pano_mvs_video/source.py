"""Panoramas from videos: frames at equally spaced times, or wherever the camera has moved."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from pano_mvs.algorithms.panoramas import sharpness
from pano_mvs.algorithms.stitching import is_dual_fisheye
from pano_mvs.api import NOT_IN_KEY, Context, FilePart, InputError, Panorama, Params, SourceItem, SourcePath, source
from pano_mvs.core.digest import digest_from_file
from pano_mvs.core.paths import is_folder
from pano_mvs.core.text import plural
from pano_mvs.io.images.names import printable_name
from pano_mvs.io.kept_file import KeptFile
from pano_mvs.scene.files import item_stems
from pano_mvs.scene.image_file import write_png
from pano_mvs.scene.stereo import StereoSetting
from pano_mvs.stages.source import STEREO, masked_panorama, stereo_note, working_size
from pano_mvs_video import keyframes
from pano_mvs_video.keyframes import REDUCED_HW, KeyframeSettings, SmallFrame, reduced_grey, select_keyframes
from pano_mvs_video.video_files import (
    VideoInfo,
    describe_video,
    frame_on_display,
    frames_between,
    list_videos,
    read_times,
)

# Motion is measured in at most this number of frames per second.
_MEASURED_PER_S = 15.0
_TOO_FEW = {
    "time": "Set a smaller every_s",
    "motion": "The camera hardly moves. Set a smaller motion_deg, keyframes: time",
}
_TIME_IN_NAME = re.compile(r".*_(\d{8,})ms\.png")


class VideoParams(Params):
    """Settings of source.video."""

    path: SourcePath | list[SourcePath] = Field(
        description="an equirectangular video, a list of videos, or a folder of videos"
    )
    keyframes: Literal["time", "motion"] = Field(
        default="time",
        description="time: frames at equal steps; motion: a frame wherever the scene has moved by `motion_deg`",
    )
    every_s: float | None = Field(default=None, gt=0, description="time between frames in seconds; 1 by default")
    every_frames: int | None = Field(default=None, ge=1, description="the same as a number of frames of the video")
    pick: Literal["sharpest", "nearest"] = Field(
        default="sharpest",
        description="frame to use within a quarter of a step: the sharpest, or the nearest",
    )
    motion_deg: Annotated[float, NOT_IN_KEY] = Field(
        default=8.0,
        ge=1,
        le=45,
        description="with keyframes: motion, the median parallax between frames; rotation of the camera does not count",
    )
    min_s: Annotated[float, NOT_IN_KEY] = Field(
        default=0.2, ge=0, description="with keyframes: motion, the minimum time between frames in seconds"
    )
    max_s: Annotated[float | None, NOT_IN_KEY] = Field(
        default=None,
        gt=0,
        description="with keyframes: motion, the maximum time between frames, even if the camera stands",
    )
    start_s: Annotated[float, NOT_IN_KEY] = Field(default=0.0, ge=0, description="start time in the video, in seconds")
    end_s: Annotated[float | None, NOT_IN_KEY] = Field(
        default=None, gt=0, description="end time in the video, in seconds"
    )
    max_frames: Annotated[int | None, NOT_IN_KEY] = Field(
        default=None, ge=2, description="maximum number of frames per video; a lower number increases the steps"
    )
    mask: SourcePath | None = Field(default=None, description="one mask for all frames; 0 is ignored")
    nadir_deg: float = Field(default=0.0, ge=0, le=90, description="ignore this angle around straight down (operator)")
    zenith_deg: float = Field(default=0.0, ge=0, le=90, description="ignore this angle around straight up")
    max_width: int = Field(default=4096, ge=16, description="wider frames are scaled down to this width")
    stereo: StereoSetting = STEREO

    @model_validator(mode="after")
    def _one_step(self) -> VideoParams:
        if self.every_s is not None and self.every_frames is not None:
            raise ValueError("give every_s or every_frames, not both")
        if self.keyframes == "motion" and (self.every_s is not None or self.every_frames is not None):
            raise ValueError("every_s and every_frames are steps in time: use motion_deg with keyframes: motion")
        if self.max_s is not None and self.max_s < self.min_s:
            raise ValueError("max_s must not be less than min_s")
        if self.end_s is not None and self.end_s <= self.start_s:
            raise ValueError("end_s must be greater than start_s")
        return self

    def step_s(self, info: VideoInfo) -> float:
        """Return the time between frames in seconds."""
        return self.every_frames / info.frames_per_s if self.every_frames is not None else self.every_s or 1.0

    def reach_s(self, info: VideoInfo) -> float:
        """Return how far a frame may be from the time in its name, in seconds."""
        step_s = 2 / _MEASURED_PER_S if self.keyframes == "motion" else self.step_s(info)
        return max(step_s / 4, 0.51 / info.frames_per_s)


def list_frames(params: VideoParams) -> Iterator[SourceItem]:
    """List the frames to read, from the headers of the videos alone.

    Raises:
        InputError: if the only video cannot be used, or all videos together give fewer than two frames.
    """
    items, failed, first_error = list[SourceItem](), list[SourceItem](), None
    unread: list[str] = []
    for path, name in _named_videos(params, unread):
        try:
            items += _items_of(path, name, params)
        except InputError as error:
            first_error = first_error or error
            failed.append(SourceItem(printable_name(name)[0], {"video": path}, str(error)))
    if len(items) < 2:
        if first_error is not None:
            raise first_error
        raise InputError(
            f"{items[0].files['video'] if items else params.path}: gives {len(items)} {plural(len(items), 'frame')}; "
            f"depth needs two or more. {_TOO_FEW[params.keyframes]}, or another start_s and end_s"
        )
    yield from (replace(item, notes=tuple(unread)) for item in items)
    yield from failed


@source("source.video", list_items=list_frames)
def video(item: SourceItem, params: VideoParams, ctx: Context) -> Panorama:
    """Read frames of equirectangular videos, at equally spaced times or by the motion of the camera.

    Around each time, the sharpest frame within a quarter of a step is used. With `keyframes: motion`, a frame is used
    wherever the scene has moved by `motion_deg` since the last one; a camera that stands or only turns gives none.
    Frames are stored without loss, as `<video>_<milliseconds of the time>ms.png`. Match them with `pairs.sequential`.
    """
    path = item.files["video"]
    info = describe_video(path, params.stereo)
    if info.stereo != "none":
        ctx.note(stereo_note(path.name, info.stereo))
    if info.is_turned:
        ctx.note(f"{path.name} has a rotation in its metadata, which was ignored: frames are used as stored")
    match = _TIME_IN_NAME.fullmatch(item.name)
    assert match is not None, item.name
    wanted_s = int(match[1]) / 1000
    time_s, quality, frame = _best_frame(path, wanted_s, params, info=info, threads=ctx.threads)
    if time_s < wanted_s - params.reach_s(info) - 0.001:
        ctx.note("{count} frames are those that a player shows at their time: the frame rate of the video varies")
    if is_dual_fisheye(frame):
        raise InputError(_dual_fisheye(path))
    ctx.metric("time_s", time_s)
    ctx.metric("sharpness", quality)
    kept = ctx.scratch / "frame.png"
    write_png(kept, np.ascontiguousarray(frame[..., ::-1]))
    panorama = Panorama(
        image=FilePart(kept),
        size_hw=working_size(info.size_hw, params.max_width),
        source_size_hw=info.size_hw,
        mask_file=item.file("mask") if "mask" in item.files else None,
        nadir_deg=params.nadir_deg,
        zenith_deg=params.zenith_deg,
    )
    return masked_panorama(panorama, None, name=item.name, ctx=ctx)


def _named_videos(params: VideoParams, notes: list[str]) -> Iterator[tuple[Path, str]]:
    """Yield the videos with their names relative to the capture, without suffix where that is unambiguous."""
    named: dict[str, Path] = {}
    for path in params.path if isinstance(params.path, list) else [params.path]:
        base = path if is_folder(path) else path.parent
        for found in list_videos(path, notes):
            name = found.relative_to(base).as_posix()
            if name in named:
                raise InputError(
                    f"{named[name]} and {found}: frames of both would be called after {name}. Use the folder that "
                    "contains both as path, or rename one of them"
                )
            named[name] = found
    stems = item_stems(named)
    for name, path in named.items():
        yield path, stems[name]


def _items_of(path: Path, name: str, params: VideoParams) -> Iterator[SourceItem]:
    info = describe_video(path, params.stereo)
    begin_s = params.start_s
    if begin_s <= _last_s(info, params):
        first = next(frames_between(path, begin_s, begin_s + params.step_s(info), stereo=info.stereo), None)
        if first is not None and is_dual_fisheye(first[1]):
            raise InputError(_dual_fisheye(path))
    times = _steps(info, params) if params.keyframes == "time" else _keyframes(path, info, params)
    files = {"video": path} if params.mask is None else {"video": path, "mask": params.mask}
    for time_s in times:
        shown, problem = printable_name(f"{name}_{round(time_s * 1000):08d}ms.png")
        yield SourceItem(shown, files, problem)


def _last_s(info: VideoInfo, params: VideoParams) -> float:
    last_s = (info.frames - 1) / info.frames_per_s
    return min(last_s, params.end_s if params.end_s is not None else last_s)


def _keyframes(path: Path, info: VideoInfo, params: VideoParams) -> list[float]:
    """Return the times of the frames between which the scene moves by the wanted parallax, in seconds.

    The whole video is decoded once; the times are remembered among the user's caches.
    """
    settings = KeyframeSettings(params.motion_deg, params.min_s, params.max_s)
    usable = Panorama(
        image=FilePart(path),
        size_hw=REDUCED_HW,
        source_size_hw=info.size_hw,
        mask_file=None if params.mask is None else FilePart(params.mask),
        nadir_deg=params.nadir_deg,
        zenith_deg=params.zenith_deg,
    ).load_mask()
    code = digest_from_file(Path(str(keyframes.__file__)))
    own = [*vars(settings).values(), info.stereo, params.start_s, params.end_s, usable.tobytes(), _MEASURED_PER_S, code]
    known = KeptFile.of(path, "keyframes", own, suffix=".json")
    times = read_times(known)
    if times is None:
        frames = frames_between(
            path,
            params.start_s,
            _last_s(info, params) + 1.0,
            min_step_s=1 / _MEASURED_PER_S,
            threads=2,
            stereo=info.stereo,
        )
        # The rows near the equator are enough to compare sharpness.
        small = (
            SmallFrame(time_s, reduced_grey(frame), sharpness(frame[len(frame) // 4 : len(frame) - len(frame) // 4]))
            for time_s, frame in frames
        )
        times = [frame.time_s for frame in select_keyframes(small, settings, usable)]
        known.write(json.dumps(times).encode())
    if params.max_frames is not None and len(times) > params.max_frames:
        kept = np.linspace(0, len(times) - 1, params.max_frames).round().astype(int)
        times = [times[idx] for idx in kept]
    return times


def _steps(info: VideoInfo, params: VideoParams) -> list[float]:
    """Return the times of the frames, in seconds."""
    step_s = params.step_s(info)
    length_s = _last_s(info, params) - params.start_s
    if length_s < 0:
        return []
    count = int(length_s / step_s + 1e-6) + 1
    if params.max_frames is not None and count > params.max_frames:
        count = params.max_frames
        step_s = length_s / (count - 1)
    return [params.start_s + idx * step_s for idx in range(count)]


def _best_frame(
    path: Path, time_s: float, params: VideoParams, *, info: VideoInfo, threads: int
) -> tuple[float, float, NDArray[np.uint8]]:
    """Return the time, the sharpness and the image (BGR) of the frame to use around a time."""
    reach_s = params.reach_s(info)
    best: tuple[float, float, NDArray[np.uint8]] | None = None
    least = np.inf
    frames = frames_between(path, time_s - reach_s, time_s + reach_s, threads=threads, stereo=info.stereo)
    for found_s, frame in frames:
        quality = sharpness(frame)
        badness = -quality if params.pick == "sharpest" else abs(found_s - time_s)
        if best is None or badness < least:
            best, least = (found_s, quality, frame), badness
    if best is None and (shown := frame_on_display(path, time_s, threads=threads, stereo=info.stereo)) is not None:
        best = (shown[0], sharpness(shown[1]), shown[1])
    if best is None:
        raise InputError(
            f"{path}: no frame from {max(0.0, time_s - reach_s):.3f} s on can be decoded: the video ends before its "
            "header says, or is damaged there. Set end_s or start_s, or copy it again"
        )
    return best


def _dual_fisheye(path: Path) -> str:
    return (
        f"{path}: two fisheye images side by side, not an equirectangular panorama. Export it as an equirectangular "
        "video with the camera maker's program first (stitching), or, if the calibration of the lenses is known, split "
        "it into pictures and use source.dual_fisheye (docs/rigs.md)"
    )
