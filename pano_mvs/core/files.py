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


@contextmanager
def replacing(path: Path, *, temporary_in: Path | None = None) -> Iterator[Path]:
    """Yield a temporary path to write; on success it takes the name `path` in one step, else it is removed.

    Args:
        path: the file to create or replace; its folder is made.
        temporary_in: folder for the temporary file, on the same file system; default beside `path`.

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
        temporary.chmod(0o666 & ~_umask())
        temporary.replace(path)
    except OSError as error:
        if isinstance(error, StoreError):
            raise
        reason = error.strerror or str(error)
        raise StoreError(f"{path} cannot be written: {reason}. Free some space, mend the permissions or choose another "
                         "folder, then run the same command again")  from error  # fmt: skip
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a text file in one step (UTF-8, as given)."""
    with replacing(path) as temporary:
        temporary.write_bytes(text.encode())


def copy_file(source: Path, target: Path) -> None:
    """Copy a file's bytes to a place in one step."""
    with replacing(target) as temporary:
        shutil.copyfile(source, temporary)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
