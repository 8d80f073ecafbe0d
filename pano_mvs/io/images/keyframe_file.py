"""Times of keyframes that were chosen in a video, stored among the user's caches for the next command.

Choosing keyframes decodes the whole video, but every command has to list them.
"""

from __future__ import annotations

import json
import math
from contextlib import suppress
from pathlib import Path

from pano_mvs.core.digest import digest_from_value
from pano_mvs.core.errors import StoreError
from pano_mvs.core.files import write_text
from pano_mvs.core.kernel_cache import user_cache_folder
from pano_mvs.core.paths import resolved


def keyframe_file(video: Path, settings: object) -> Path | None:
    """Return the file for the keyframes of a video as it is now; None if the user has no writable folder for caches."""
    return file_of_state(video, "keyframes", settings, suffix=".json")


def file_of_state(path: Path, what: str, settings: object, *, suffix: str) -> Path | None:
    """Return the file among the user's caches for what was computed from a file as it is now; None if there is none.

    Args:
        path: the file; its path, size, time stamps and inode are part of the name.
        what: folder for what is stored.
        settings: plain values that it depends on.
        suffix: of the name.
    """
    try:
        stated = path.stat()
        folder = user_cache_folder()
    except OSError:
        return None
    state = [str(resolved(path)), stated.st_size, stated.st_mtime_ns, stated.st_ctime_ns, stated.st_ino]
    return folder / "pano-mvs" / what / f"{digest_from_value([state, settings])}{suffix}"


def read_times(path: Path | None) -> list[float] | None:
    """Return the stored times in seconds; None if there are none, or the file is damaged."""
    if path is None:
        return None
    try:
        times = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
    if not isinstance(times, list) or not all(isinstance(time, float) and math.isfinite(time) for time in times):
        return None
    return times


def store_times(path: Path | None, times: list[float]) -> None:
    """Store times in seconds; a folder that cannot be written costs only time."""
    if path is not None:
        with suppress(OSError, StoreError):
            path.parent.mkdir(parents=True, exist_ok=True)
            write_text(path, json.dumps([float(time) for time in times]))
