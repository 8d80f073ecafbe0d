"""Write files so that a reader sees the old one or the new one, never half of one."""

from __future__ import annotations

import os
import re
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path

from pano_mvs.core.errors import StoreError
from pano_mvs.core.paths import children, exists, is_file, is_folder, is_link
from pano_mvs.core.processes import process_place, start_of

OUTPUT_MARK = ".pano-mvs-output"
"""An empty file in every output folder, written first: no source takes what lies there for pictures."""


CACHE_MARK = ".pano-mvs-cache"
"""An empty file in every cache: no source takes what lies there for pictures."""

_FOLDERS_OF_A_CACHE = ("blobs", "records")


def is_cache(folder: Path) -> bool:
    """Return whether a folder is a cache; those of versions that wrote no mark are known by what they hold."""
    if exists(folder / CACHE_MARK):
        return True
    return is_file(folder / "layout.json") and all(is_folder(folder / name) for name in _FOLDERS_OF_A_CACHE)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


_UMASK = _umask()  # once: to ask is to set it for a moment, for all threads
_TEMPORARY = re.compile(r"\.tmp-([0-9a-f]{8})-(\d{1,10})-.*")
_ABANDONED_AFTER_S = 7 * 24 * 3600.0


def set_aside(path: Path) -> Path:
    """Rename a file to `<name>.bak`, or `<name>.1.bak` and so on where that is taken; return its new place.

    Raises:
        StoreError: if it cannot be renamed.
    """
    names = (f"{path.name}{f'.{number}' if number else ''}.bak" for number in count())
    free = next(path.with_name(name) for name in names if not exists(path.with_name(name)))
    try:
        return path.rename(free)
    except OSError as error:
        raise StoreError(f"{path} is in the way and cannot be renamed ({error.strerror}). Move it away") from error


def temporary_prefix() -> str:
    """Return how the names of this process's temporary files begin: they tell whether who made them is still there."""
    return f".tmp-{process_place()}-{os.getpid()}-"


def whose_temporary(path: Path) -> str:
    """Return to whom a temporary file or folder belongs, in words."""
    match = _TEMPORARY.fullmatch(path.name)
    if match is None:
        return "not of this version; removed when it is seven days old"
    if match[1] != process_place() or os.name != "posix":
        return "of another host or container; removed when it is seven days old"
    state = "gone" if start_of(int(match[2])) is None else "running"
    return f"of process {match[2]} on this host, which is {state}"


def clear_abandoned(folder: Path) -> None:
    """Remove the temporary files and folders of processes that were killed.

    Those of processes that are known to be gone are removed at once. Where that cannot be known (another host or
    container, Windows), and what bears another name, it is for age to tell: no unit takes seven days.
    """
    with suppress(OSError):
        for path in children(folder, ".tmp-*"):
            if _is_abandoned(path):
                remove_whole(path)


def remove_whole(path: Path) -> None:
    """Remove a file, a link or a whole folder; another process may be doing so too."""
    with suppress(OSError):
        if is_folder(path) and not is_link(path):
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


def _is_abandoned(path: Path) -> bool:
    match = _TEMPORARY.fullmatch(path.name)
    if match and match[1] == process_place() and os.name == "posix":
        return start_of(int(match[2])) is None  # one that has ended and is not yet cleared away is no owner
    return is_older(path, _ABANDONED_AFTER_S)


def is_older(path: Path, seconds: float) -> bool:
    """Return whether a file was last changed longer ago; not if it is gone."""
    try:
        return time.time() - path.lstat().st_mtime > seconds
    except OSError:
        return False


@contextmanager
def replacing(path: Path, *, temporary_in: Path | None = None, durable: bool = False) -> Iterator[Path]:
    """Yield a temporary path to write; on success it takes the name `path` in one step, else it is removed.

    Args:
        path: the file to create or replace; its folder is made.
        temporary_in: folder for the temporary file, on the same file system; default beside `path`.
        durable: return only when the bytes and the name are on the disk itself, so that a power cut loses neither.

    Raises:
        StoreError: if the file cannot be written (no permission, disk full).
    """
    folder = temporary_in or path.parent
    temporary: Path | None = None
    try:
        folder.mkdir(parents=True, exist_ok=True)
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=folder, prefix=temporary_prefix(), suffix=path.suffix)
        os.close(handle)
        temporary = Path(name)
        yield temporary
        temporary.chmod(0o666 & ~_UMASK)
        if durable:
            _flush(temporary)
        _take_name(temporary, path)
        if durable and os.name == "posix":
            _flush(path.parent)
    except OSError as error:
        if isinstance(error, StoreError):
            raise
        reason = error.strerror or str(error)
        raise StoreError(f"{path} cannot be written: {reason}. Free some space, mend the permissions or choose another "
                         "folder, then run the same command again")  from error  # fmt: skip
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str, *, temporary_in: Path | None = None, durable: bool = False) -> None:
    """Write a text file in one step (UTF-8, as given); see `replacing`."""
    with replacing(path, temporary_in=temporary_in, durable=durable) as temporary:
        temporary.write_bytes(text.encode(errors="backslashreplace"))  # names of files need not be text


def copy_file(source: Path, target: Path) -> None:
    """Copy a file's bytes to a place in one step."""
    with replacing(target) as temporary:
        shutil.copyfile(source, temporary)


def _take_name(temporary: Path, path: Path) -> None:
    """Rename; where a reader holds a file of the same content open, some systems refuse, and there is nothing to do."""
    try:
        temporary.replace(path)
    except PermissionError:
        if not is_file(path) or path.stat().st_size != temporary.stat().st_size:
            raise
        if path.read_bytes() != temporary.read_bytes():
            raise


def _flush(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY if is_folder(path) else os.O_RDWR)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
