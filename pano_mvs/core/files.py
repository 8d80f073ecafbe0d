"""Write files so that a reader sees the old one or the new one, never half of one."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pano_mvs.core.errors import StoreError

OUTPUT_MARK = ".pano-mvs-output"
"""An empty file in every output folder, written first: no source takes what lies there for pictures."""


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


_UMASK = _umask()  # once: to ask is to set it for a moment, for all threads


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
        handle, name = tempfile.mkstemp(dir=folder, prefix=".tmp-", suffix=path.suffix)
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


def write_text(path: Path, text: str, *, durable: bool = False) -> None:
    """Write a text file in one step (UTF-8, as given); see `replacing`."""
    with replacing(path, durable=durable) as temporary:
        temporary.write_bytes(text.encode())


def copy_file(source: Path, target: Path) -> None:
    """Copy a file's bytes to a place in one step."""
    with replacing(target) as temporary:
        shutil.copyfile(source, temporary)


def _take_name(temporary: Path, path: Path) -> None:
    """Rename; where a reader holds a file of the same content open, some systems refuse, and there is nothing to do."""
    try:
        temporary.replace(path)
    except PermissionError:
        if not path.is_file() or path.stat().st_size != temporary.stat().st_size:
            raise
        if path.read_bytes() != temporary.read_bytes():
            raise


def _flush(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
