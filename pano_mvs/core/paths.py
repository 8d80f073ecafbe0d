"""Query paths without exceptions.

`Path.is_file`, `exists`, `is_dir`, `resolve` and `glob` raise on some paths: below a folder that may not be searched
(PermissionError), with a name that is too long or links that form a circle (OSError, RuntimeError), with a null byte
(ValueError). The functions here do not: a path that cannot be examined does not exist, and
`problem_of` says why.

The rest of the package uses only these functions; a test checks this.
"""

from __future__ import annotations

import os
import stat
from pathlib import Path

_NO_PATH = (OSError, ValueError, RuntimeError)


def is_file(path: Path) -> bool:
    """Return whether a path is a regular file, or a link to one."""
    info = stat_of(path)
    return info is not None and stat.S_ISREG(info.st_mode)


def is_folder(path: Path) -> bool:
    """Return whether a path is a folder, or a link to one."""
    info = stat_of(path)
    return info is not None and stat.S_ISDIR(info.st_mode)


def exists(path: Path) -> bool:
    """Return whether a path exists; False for a broken link."""
    return stat_of(path) is not None


def is_link(path: Path) -> bool:
    """Return whether a path is a symbolic link, broken or not."""
    try:
        return path.is_symlink()
    except _NO_PATH:
        return False


def stat_of(path: Path) -> os.stat_result | None:
    """Return the status of a file or folder, or None if it cannot be examined."""
    try:
        return path.stat()
    except _NO_PATH:
        return None


def problem_of(path: Path) -> str:
    """Return why a path cannot be examined, such as "Permission denied", or "" if it can."""
    try:
        path.stat()
    except _NO_PATH as error:
        return reason_of(error)
    return ""


def is_denied(path: Path) -> bool:
    """Return whether a path cannot be examined because a folder above it may not be searched."""
    try:
        path.stat()
    except PermissionError:
        return True
    except _NO_PATH:
        return False
    return False


def reason_of(error: BaseException) -> str:
    """Return the reason in a system error, without the path."""
    return getattr(error, "strerror", None) or str(error)


def resolved(path: Path) -> Path:
    """Return a path with links and ".." resolved; if that is impossible, only made absolute."""
    try:
        return path.resolve()
    except _NO_PATH:
        try:
            return path.absolute()
        except _NO_PATH:  # the current folder has been deleted
            return path


def is_inside(path: Path, folder: Path) -> bool:
    """Return whether a path is in a folder or is that folder, after following links."""
    return resolved(path).is_relative_to(resolved(folder))


def children(folder: Path, pattern: str = "*") -> list[Path]:
    """Return the entries of a folder, sorted by name; none if it cannot be listed.

    Args:
        pattern: of the names to return, such as "*.yaml".
    """
    try:
        return sorted(folder.glob(pattern))
    except _NO_PATH:
        return []


def below(folder: Path, pattern: str = "*") -> list[Path]:
    """Return all files and folders below a folder, sorted by path, as far as they can be listed."""
    try:
        return sorted(folder.rglob(pattern))
    except _NO_PATH:
        return []


def home_folder() -> Path | None:
    """Return the user's home folder, or None if there is none or it may not be searched."""
    try:
        home = Path.home()
        os.stat(f"{home}/.")  # noqa: PTH116  # the dot requires search permission, and Path would drop it
    except _NO_PATH:
        return None
    return home


def expanded(path: Path) -> Path:
    """Return a path with "~" replaced by the home folder, or unchanged if there is no home folder."""
    try:
        return path.expanduser()
    except RuntimeError:
        return path
