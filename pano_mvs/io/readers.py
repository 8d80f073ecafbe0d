"""Readers of plugins: what `--images` may hold beside panoramas, and files of poses of other programs.

A reader is chosen by what a file or folder says, not by its name alone: its `recognises` looks into it. Plugins come
before the built-in formats of poses, so that they can read differently what these read.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

from pano_mvs.core.doors import Door
from pano_mvs.core.errors import InputError, PanoMvsError, PluginError
from pano_mvs.core.text import error_summary
from pano_mvs.geometry import Rigid3


@dataclass(frozen=True, slots=True)
class CaptureReader:
    """A kind of capture, such as a virtual tour, and the stage that reads it."""

    what: str  # the kind, in words: "a video"
    source: str  # name of the stage, such as `source.video`
    # whether a file or folder, which exists, is of this kind; InputError if it is but cannot be read
    recognises: Callable[[Path], bool]
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
    """Return the reader of the kind of capture that a file or folder holds; None if no plugin reads it.

    Raises:
        PluginError: if a reader fails when it looks at the file or folder.
    """
    return _recogniser(CAPTURE_READERS, path)


def pose_reader_of(path: Path) -> PoseReader | None:
    """Return the reader of a plugin for a file of poses; None if no plugin reads it.

    Raises:
        PluginError: if a reader fails when it looks at the file.
    """
    return _recogniser(POSE_READERS, path)


def poses_of_plugin(path: Path) -> PosesRead | None:
    """Return the poses in a file that a plugin reads; None if no plugin reads it.

    Raises:
        InputError: if the file is invalid, or holds no poses.
        PluginError: if the reader fails in any other way.
    """
    reader = pose_reader_of(path)
    if reader is None:
        return None
    try:
        found = reader.read(path)
    except (PanoMvsError, OSError):
        raise
    except Exception as error:
        raise PluginError(f"{path}: the plugin that reads {reader.what} failed: {error_summary(error)}") from error
    if not found.groups:
        raise InputError(f"{path}: {reader.what}, but it holds no poses")
    return found


Reader = TypeVar("Reader", CaptureReader, PoseReader)


def _recogniser(door: Door[Reader], path: Path) -> Reader | None:
    """Return the first reader that recognises a file or folder; readers that cannot be loaded recognise nothing."""
    for name in door.names():
        try:
            reader = door.get(name)
        except PluginError:
            continue  # `pano-mvs plugins` shows why
        try:
            if reader.recognises(path):
                return reader
        except (PanoMvsError, OSError):
            raise
        except Exception as error:  # another reader could read the file differently, so that this is not ignored
            raise PluginError(
                f"{path}: the {door.kind} {name!r} ({door.origin(name)}) failed to look at it: {error_summary(error)}. "
                "Update or uninstall that plugin"
            ) from error
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
