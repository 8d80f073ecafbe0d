"""Panoramas from videos: the sharpest frame around each of a series of equally spaced times."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from pano_mvs.algorithms.dual_fisheye import is_dual_fisheye
from pano_mvs.algorithms.sharpness import sharpness
from pano_mvs.api import NOT_IN_KEY, Context, FilePart, InputError, Panorama, Params, SourceItem, SourcePath, source
from pano_mvs.core.paths import is_folder
from pano_mvs.core.text import plural
from pano_mvs.io.images.names import printable_name
from pano_mvs.io.images.video import VideoInfo, describe_video, frames_between, list_videos
from pano_mvs.scene.files import item_stems
from pano_mvs.scene.image_files.image_file import write_png
from pano_mvs.stages.source import working_size

_TIME_IN_NAME = re.compile(r".*_(\d{8,})ms\.png")


class VideoParams(Params):
    """Settings of source.video."""

    path: SourcePath | list[SourcePath] = Field(
        description="an equirectangular video, a list of videos, or a folder of videos"
    )
    every_s: float | None = Field(default=None, gt=0, description="time between frames in seconds; 1 by default")
    every_frames: int | None = Field(default=None, ge=1, description="the same as a number of frames of the video")
    pick: Literal["sharpest", "nearest"] = Field(
        default="sharpest",
        description="frame to use within a quarter of a step: the sharpest, or the nearest",
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

    @model_validator(mode="after")
    def _one_step(self) -> VideoParams:
        if self.every_s is not None and self.every_frames is not None:
            raise ValueError("give every_s or every_frames, not both")
        if self.end_s is not None and self.end_s <= self.start_s:
            raise ValueError("end_s must be greater than start_s")
        return self

    def step_s(self, info: VideoInfo) -> float:
        """Return the time between frames in seconds."""
        return self.every_frames / info.frames_per_s if self.every_frames is not None else self.every_s or 1.0


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
            "depth needs two or more. Set a smaller every_s, or another start_s and end_s"
        )
    yield from (replace(item, notes=tuple(unread)) for item in items)
    yield from failed


@source("source.video", list_items=list_frames)
def video(item: SourceItem, params: VideoParams, ctx: Context) -> Panorama:
    """Read frames of equirectangular videos at equally spaced times.

    Around each time, the sharpest frame within a quarter of a step is used. It is stored without loss, as
    `<video>_<milliseconds of the time>ms.png`. Match the frames with `pairs.sequential`.
    """
    path = item.files["video"]
    info = describe_video(path)
    if info.is_turned:
        ctx.note(f"{path.name} has a rotation in its metadata, which was ignored: frames are used as stored")
    time_s, quality, frame = _best_frame(path, _time_from_name(item.name), params, info=info, threads=ctx.threads)
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
    ctx.metric("valid", float(panorama.load_mask().mean()))
    return panorama


def _named_videos(params: VideoParams, notes: list[str]) -> Iterator[tuple[Path, str]]:
    """Yield the videos with their names relative to the capture, without suffix where that is unambiguous.

    Raises:
        InputError: if two videos of a list have the same name.
    """
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
    info = describe_video(path)
    times = _steps(info, params)
    if times:
        first = next(frames_between(path, times[0], times[0] + params.step_s(info)), None)
        if first is not None and is_dual_fisheye(first[1]):
            raise InputError(_dual_fisheye(path))
    files = {"video": path} if params.mask is None else {"video": path, "mask": params.mask}
    for time_s in times:
        shown, problem = printable_name(f"{name}_{round(time_s * 1000):08d}ms.png")
        yield SourceItem(shown, files, problem)


def _steps(info: VideoInfo, params: VideoParams) -> list[float]:
    """Return the times of the frames, in seconds."""
    step_s, last_s = params.step_s(info), (info.frames - 1) / info.frames_per_s
    length_s = min(last_s, params.end_s if params.end_s is not None else last_s) - params.start_s
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
    """Return the time, the sharpness and the image (BGR) of the frame to use around a time.

    Raises:
        InputError: if there is no frame that can be decoded.
    """
    reach_s = max(params.step_s(info) / 4, 0.51 / info.frames_per_s)
    best: tuple[float, float, NDArray[np.uint8]] | None = None
    least = np.inf
    for found_s, frame in frames_between(path, time_s - reach_s, time_s + reach_s, threads=threads):
        quality = sharpness(frame)
        badness = -quality if params.pick == "sharpest" else abs(found_s - time_s)
        if best is None or badness < least:
            best, least = (found_s, quality, frame), badness
    if best is None:
        raise InputError(
            f"{path}: no frame between {max(0.0, time_s - reach_s):.3f} s and {time_s + reach_s:.3f} s can be decoded: "
            "the video is damaged there, ends early, or pauses. Set end_s or start_s, or copy it again"
        )
    return best


def _time_from_name(name: str) -> float:
    match = _TIME_IN_NAME.fullmatch(name)
    assert match is not None, name
    return int(match[1]) / 1000


def _dual_fisheye(path: Path) -> str:
    return (
        f"{path}: two fisheye images side by side, not an equirectangular panorama. Export it as an equirectangular "
        "video with the camera maker's program first (stitching)"
    )
