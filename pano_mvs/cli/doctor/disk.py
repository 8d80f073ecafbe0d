"""The folders of a run: whether they can be written, how much room there is, and what their file system can do."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

from pano_mvs.cli.doctor.finding import Finding
from pano_mvs.core.memory import size_text
from pano_mvs.core.paths import exists, is_folder

_LITTLE_BYTES = 5_000_000_000


def folder_findings(
    what: str, folder: Path, option: str, *, free_bytes_of: Callable[[Path], int] | None = None
) -> Iterator[Finding]:
    """Yield what there is to say of a folder that need not exist yet.

    Args:
        what: it is for: "cache", "results".
        folder: the folder.
        option: by which another one is chosen.
        free_bytes_of: finds the room on a folder's disk; by default as the system has it.
    """
    free_bytes_of = free_bytes_of or (lambda path: shutil.disk_usage(path).free)
    there = _existing(folder)
    if there is None or not is_folder(there):
        yield Finding(
            "disk", what, "failed", f"{folder}: {there or folder} is no folder", f"choose another with {option}"
        )
        return
    try:
        with tempfile.TemporaryDirectory(dir=there, prefix=".pano-mvs-doctor-") as probe:
            yield from _file_system(what, Path(probe), option)
        free = free_bytes_of(there)
    except OSError as error:
        yield Finding("disk", what, "failed", f"{folder} cannot be written: {error.strerror or error}",
                      f"mend its permissions, or choose another folder with {option}")  # fmt: skip
        return
    shown = f"{folder}: {size_text(free)} free"
    if free < _LITTLE_BYTES:
        yield Finding("disk", what, "warning", shown, f"make room, or choose another folder with {option}; "
                      "a panorama of 2048 px takes some 60 MB in the cache")  # fmt: skip
    else:
        yield Finding("disk", what, "ok", shown)


def _existing(folder: Path) -> Path | None:
    """Return the folder, or the nearest above it that exists."""
    path = folder.absolute()
    return next((place for place in (path, *path.parents) if os.path.lexists(place)), None)


def _file_system(what: str, probe: Path, option: str) -> Iterator[Finding]:
    old, new = probe / "old", probe / "new"
    old.write_bytes(b"old")
    new.write_bytes(b"new")
    new.replace(old)
    if old.read_bytes() != b"new":
        yield Finding("disk", what, "failed", f"{probe.parent}: a file cannot take another's name in one step",
                      f"choose a folder on a local disk with {option}")  # fmt: skip
    if exists(probe / "OLD"):
        yield Finding("disk", what, "note", f"{probe.parent}: names that differ in case alone are one file there")
