"""Write files atomically: a reader sees the old file or the new one, never a partial one."""

from __future__ import annotations

import errno
import os
import re
import shutil
import stat
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path

from pano_mvs.core.digest import digest_from_bytes
from pano_mvs.core.errors import StoreError, UsageError
from pano_mvs.core.paths import children, exists, is_file, is_folder, is_link
from pano_mvs.core.processes import process_place, start_of

OUTPUT_MARK = ".pano-mvs-output"
"""An empty file, written first into every output folder, so that sources do not read images from there."""

CACHE_MARK = ".pano-mvs-cache"  # an empty file in every cache, so that sources do not read images from there
_UMASK = os.umask(0)  # read once, because reading it sets it for a moment, in all threads
os.umask(_UMASK)
_TEMPORARY = re.compile(r"\.tmp-([0-9a-f]{8})-(\d{1,10})-.*")
_FULL = {errno.ENOSPC, getattr(errno, "EDQUOT", errno.ENOSPC), errno.EFBIG}


def set_aside(path: Path) -> Path:
    """Rename a file to `<name>.bak`, or `<name>.1.bak` and so on if that exists; return its new path.

    Raises:
        StoreError: if it cannot be renamed.
    """
    names = (f"{path.name}{f'.{number}' if number else ''}.bak" for number in count())
    free = next(path.with_name(name) for name in names if not exists(path.with_name(name)))
    try:
        return path.rename(free)
    except OSError as error:
        raise StoreError(f"{path} exists and cannot be renamed ({error.strerror}). Move it elsewhere") from error


def make_room(path: Path) -> None:
    """Remove a file, or rename a folder that somebody has put in its place.

    Raises:
        StoreError: if the folder cannot be renamed.
        OSError: if the file cannot be removed.
    """
    if is_folder(path) and not is_link(path):
        set_aside(path)
    else:
        path.unlink(missing_ok=True)


def temporary_prefix() -> str:
    """Return the prefix of this process's temporary files, from which other processes see whether it is running."""
    return f".tmp-{process_place()}-{os.getpid()}-"


def whose_temporary(path: Path) -> str:
    """Return in words which process a temporary file or folder belongs to."""
    match = _TEMPORARY.fullmatch(path.name)
    if match is None:
        return "of another version; removed when it is seven days old"
    if match[1] != process_place() or os.name != "posix":
        return "of another host or container; removed when it is seven days old"
    state = "gone" if start_of(int(match[2])) is None else "running"
    return f"of process {match[2]} on this host, which is {state}"


def clear_abandoned(folder: Path, pattern: str = ".tmp-*") -> None:
    """Remove the temporary files and folders of processes that were killed.

    Those of processes that are known to have ended are removed at once, and those of running ones never, whatever the
    clock says. Where this cannot be known (another host or container, Windows, other names), they are removed after
    seven days: no unit takes that long.
    """
    with suppress(OSError):
        for path in children(folder, pattern):
            match = _TEMPORARY.fullmatch(path.name)
            if match and match[1] == process_place() and os.name == "posix":
                abandoned = start_of(int(match[2])) is None  # also if it has ended but is not reaped yet
            else:
                abandoned = is_older(path, 7 * 24 * 3600.0)
            if abandoned:
                remove_whole(path)


def remove_whole(path: Path) -> None:
    """Remove a file, a link or a folder with its contents; other processes may do so at the same time."""
    with suppress(OSError):
        if is_folder(path) and not is_link(path):
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


def is_older(path: Path, seconds: float) -> bool:
    """Return whether a file was last changed more than `seconds` ago; False if it does not exist."""
    try:
        return time.time() - path.lstat().st_mtime > seconds
    except OSError:
        return False


def make_folder(folder: Path) -> None:
    """Create a folder and its parents, if they do not exist.

    In a folder that its group shares (`chmod g+ws`), folders, and files of `replacing`, are the group's too, whatever
    the umask.

    Raises:
        OSError: if it cannot be created.
    """
    if is_folder(folder):
        return
    if folder.parent != folder:  # else a drive that does not exist
        make_folder(folder.parent)
    shared = _shared_mode(folder.parent)
    if not shared:
        folder.mkdir(exist_ok=True)
        return
    # It gets its name with its permissions, so that other members never meet it without.
    temporary = Path(tempfile.mkdtemp(dir=folder.parent, prefix=temporary_prefix()))
    try:
        temporary.chmod(0o777 & ~_UMASK | shared | stat.S_ISGID)
        temporary.rename(folder)
    except OSError:
        if not is_folder(folder):  # or else another process was faster
            raise
    finally:
        with suppress(OSError):
            temporary.rmdir()


def _shared_mode(folder: Path) -> int:
    """Return the permissions that a group has in a folder that it shares; 0 elsewhere."""
    mode = folder.stat().st_mode
    return mode & stat.S_IRWXG if mode & stat.S_ISGID and mode & stat.S_IWGRP else 0


@contextmanager
def replacing(path: Path, *, temporary_in: Path | None = None, durable: bool = False) -> Iterator[Path]:
    """Yield a temporary path to write to; on success it is renamed to `path`, otherwise it is removed.

    Args:
        path: the file to create or replace; its folder is created.
        temporary_in: folder for the temporary file, on the same file system; default beside `path`.
        durable: return only after file and name have been flushed to the disk, so that they survive a power cut.

    Raises:
        StoreError: if the file cannot be written (no permission, disk full).
    """
    folder = temporary_in or path.parent
    temporary: Path | None = None
    try:
        make_folder(folder)
        make_folder(path.parent)
        handle, name = tempfile.mkstemp(dir=folder, prefix=temporary_prefix(), suffix=path.suffix)
        os.close(handle)
        temporary = Path(name)
        yield temporary
        temporary.chmod(0o666 & (~_UMASK | _shared_mode(path.parent)))
        if durable:
            _flush(temporary)
        try:
            temporary.replace(path)
        except PermissionError:  # while a reader has the target open, which is fine if its bytes are the same
            if not is_file(path) or path.stat().st_size != temporary.stat().st_size:
                raise
            if path.read_bytes() != temporary.read_bytes():
                raise
        if durable and os.name == "posix":
            _flush(path.parent)
    except OSError as error:
        if isinstance(error, StoreError):
            raise
        remedy = "Free some space" if is_full_disk(error) else "Check the permissions"
        raise StoreError(
            f"{path} cannot be written: {_reason(error)}. {remedy} or choose another folder, then run the same "
            "command again"
        ) from error
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str, *, temporary_in: Path | None = None, durable: bool = False) -> None:
    """Write a text file atomically (UTF-8, line ends as given); see `replacing`."""
    with replacing(path, temporary_in=temporary_in, durable=durable) as temporary:
        temporary.write_bytes(text.encode(errors="backslashreplace"))  # file names may have bytes that are not text


def write_checked(path: Path, body: bytes, *, temporary_in: Path, durable: bool = False) -> None:
    """Write bytes below a line with their digest, for `checked_body`; see `replacing`."""
    with replacing(path, temporary_in=temporary_in, durable=durable) as temporary, temporary.open("wb") as stream:
        stream.write(f"{digest_from_bytes(body)}\n".encode())
        stream.write(body)  # up to 100 MB, so avoid copies


def checked_body(data: bytes) -> bytes:
    """Return the bytes below the first line of a file that `write_checked` wrote.

    Raises:
        ValueError: if they do not have the digest in that line.
    """
    checksum, _, body = data.partition(b"\n")
    if checksum.decode() != digest_from_bytes(body):
        raise ValueError("it has been changed")
    return body


def write_given(path: Path, text: str, what: str) -> None:
    """Write the first file of a place that the user names, as `write_text` does.

    Args:
        what: the option and the place that it names, for messages.

    Raises:
        UsageError: if the place cannot be used.
        StoreError: if the disk is full.
    """
    try:
        write_text(path, text)
    except StoreError as error:
        cause = error.__cause__
        if not isinstance(cause, OSError) or is_full_disk(cause):
            raise
        raise UsageError(f"{what}: cannot be written ({_reason(cause)}). Give another folder") from error


def is_full_disk(error: BaseException | None) -> bool:
    """Return whether a system error means that the disk is full or a quota is used up."""
    return isinstance(error, OSError) and error.errno in _FULL


def _reason(error: OSError) -> str:
    """Return the reason of an error in writing, which for a folder below a file is sometimes that this exists."""
    return os.strerror(errno.ENOTDIR) if isinstance(error, FileExistsError) else error.strerror or str(error)


def read_regular(path: Path | str) -> bytes:
    """Return the bytes of a file, but do not wait for a FIFO, and do not read a device without end.

    Raises:
        OSError: if it cannot be read, or is not a regular file.
    """
    handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    try:
        if not stat.S_ISREG(os.fstat(handle).st_mode):
            raise OSError(errno.EINVAL, "not a regular file", os.fspath(path))
        with open(handle, "rb", closefd=False) as stream:
            return stream.read()
    finally:
        os.close(handle)


def copy_file(source: Path, target: Path) -> None:
    """Copy a file atomically."""
    with replacing(target) as temporary:
        shutil.copyfile(source, temporary)


def _flush(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY if is_folder(path) else os.O_RDWR)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
