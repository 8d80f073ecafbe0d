"""Questions about paths, answered without exceptions.

`Path.is_file`, `exists`, `is_dir`, `resolve` and `glob` raise on some paths: below a folder that may not be searched
(PermissionError), with a name that is too long or links that form a circle (OSError, RuntimeError), with a null byte
(ValueError). The functions here do not. What cannot be looked at is not there; `problem_of` says why.

The rest of the package asks these functions only; a test checks that.
"""

from __future__ import annotations

import os
import stat
from pathlib import Path

_NO_PATH = (OSError, ValueError, RuntimeError)


def is_file(path: Path) -> bool:
    """Return whether a path leads to a plain file."""
    info = stat_of(path)
    return info is not None and stat.S_ISREG(info.st_mode)


def is_folder(path: Path) -> bool:
    """Return whether a path leads to a folder."""
    info = stat_of(path)
    return info is not None and stat.S_ISDIR(info.st_mode)


def exists(path: Path) -> bool:
    """Return whether a path leads to anything."""
    return stat_of(path) is not None


def is_link(path: Path) -> bool:
    """Return whether a path is a symbolic link, whether or not it leads anywhere."""
    try:
        return path.is_symlink()
    except _NO_PATH:
        return False


def stat_of(path: Path) -> os.stat_result | None:
    """Return what the system knows of what a path leads to, or None if it cannot be looked at."""
    try:
        return path.stat()
    except _NO_PATH:
        return None


def problem_of(path: Path) -> str:
    """Return why a path leads to nothing that can be looked at, such as "Permission denied"; "" if it does."""
    try:
        path.stat()
    except _NO_PATH as error:
        return reason_of(error)
    return ""


def is_denied(path: Path) -> bool:
    """Return whether it cannot be known what a path leads to, since a folder above it may not be searched."""
    try:
        path.stat()
    except PermissionError:
        return True
    except _NO_PATH:
        return False
    return False


def reason_of(error: BaseException) -> str:
    """Return in words why the system refused something, without the path."""
    return getattr(error, "strerror", None) or str(error)


def resolved(path: Path) -> Path:
    """Return a path without links and "..", or as it is, made absolute, where these cannot be followed."""
    try:
        return path.resolve()
    except _NO_PATH:
        try:
            return path.absolute()
        except _NO_PATH:  # the current folder has been deleted
            return path


def children(folder: Path, pattern: str = "*") -> list[Path]:
    """Return what a folder holds, in order of the names; nothing if it cannot be listed.

    Args:
        folder: the folder.
        pattern: which names, such as "*.yaml".
    """
    try:
        return sorted(folder.glob(pattern))
    except _NO_PATH:
        return []


def below(folder: Path, pattern: str = "*") -> list[Path]:
    """Return what a folder and its subfolders hold, in order of the paths, as far as they can be listed."""
    try:
        return sorted(folder.rglob(pattern))
    except _NO_PATH:
        return []


def home_folder() -> Path | None:
    """Return the user's home folder; None if there is none, or it may not be searched."""
    try:
        home = Path.home()
        os.stat(f"{home}/.")  # noqa: PTH116  # Path would drop the dot, for which the folder has to be searched
    except _NO_PATH:
        return None
    return home


def expanded(path: Path) -> Path:
    """Return a path with the home folder for "~"; as it is where there is no such home folder."""
    try:
        return path.expanduser()
    except RuntimeError:
        return path
