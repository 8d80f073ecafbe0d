"""Readers of plugins: what `--images` may hold beside panoramas, and files of poses of other programs.

A reader is chosen by what a file or folder says, not by its name alone: its `recognises` looks into it. Plugins come
before the built-in formats of poses, so that they can read differently what these read.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from pano_mvs.core.doors import Door
from pano_mvs.core.errors import PluginError
from pano_mvs.geometry import Rigid3


@dataclass(frozen=True, slots=True)
class CaptureReader:
    """A kind of capture, such as a virtual tour, and the stage that reads it."""

    what: str  # the kind, in words: "a video"
    source: str  # name of the stage, such as `source.video`
    recognises: Callable[[Path], bool]  # whether a file or folder is of this kind; it exists
    # what to do where a workflow has another source; empty if the stage can take the place of `source.folder`, with the
    # settings that both have
    advice: str = ""


@dataclass(frozen=True, slots=True)
class PosesRead:
    """The poses of the panoramas in a file."""

    # cam_from_world by the name of the image as stored; each group has a world of its own, and the largest comes first
    groups: Sequence[Mapping[str, Rigid3]]
    others: Mapping[str, str] = field(default_factory=dict)  # images that cannot be used, with the reason
    metric: bool = False  # whether lengths are metres


@dataclass(frozen=True, slots=True)
class PoseReader:
    """A format of poses."""

    what: str  # the format, in words: "the log of a scanner"
    recognises: Callable[[Path], bool]  # whether a file is of this format; it exists
    read: Callable[[Path], PosesRead]  # raises InputError, which names the file


CAPTURE_READERS = Door[CaptureReader](
    "capture reader",
    "pano_mvs.capture_readers",
    accepts=lambda value: value if isinstance(value, CaptureReader) else None,
)
POSE_READERS = Door[PoseReader](
    "pose reader",
    "pano_mvs.pose_readers",
    accepts=lambda value: value if isinstance(value, PoseReader) else None,
)


def capture_reader_of(path: Path) -> CaptureReader | None:
    """Return the reader of the kind of capture that a file or folder holds; None if no plugin has one."""
    for name in CAPTURE_READERS.names():
        try:
            reader = CAPTURE_READERS.get(name)
        except PluginError:
            continue  # `pano-mvs plugins` shows why
        if reader.recognises(path):
            return reader
    return None


def pose_reader_of(path: Path) -> PoseReader | None:
    """Return the reader of a plugin for a file of poses; None if no plugin has one."""
    for name in POSE_READERS.names():
        try:
            reader = POSE_READERS.get(name)
        except PluginError:
            continue
        if reader.recognises(path):
            return reader
    return None


def register_pose_reader(
    name: str, *, what: str, recognises: Callable[[Path], bool]
) -> Callable[[Callable[[Path], PosesRead]], Callable[[Path], PosesRead]]:
    """Return a decorator that registers a function as reader of a format of poses.

    Args:
        name: of the reader.
        what: the format, in words.
        recognises: returns whether a file, which exists, is of this format.
    """

    def register(read: Callable[[Path], PosesRead]) -> Callable[[Path], PosesRead]:
        POSE_READERS.register(name, PoseReader(what, recognises, read), read)
        return read

    return register


def register_capture_reader(
    name: str, *, what: str, source: str, advice: str = ""
) -> Callable[[Callable[[Path], bool]], Callable[[Path], bool]]:
    """Return a decorator that registers a function, which recognises a kind of capture, with the stage that reads it.

    Args:
        name: of the reader.
        what: the kind, in words.
        source: name of the stage.
        advice: see `CaptureReader`.
    """

    def register(recognises: Callable[[Path], bool]) -> Callable[[Path], bool]:
        CAPTURE_READERS.register(name, CaptureReader(what, source, recognises, advice), recognises)
        return recognises

    return register
