"""Allow one run at a time in an output folder, by a lock of the system on a file that names its owner.

The system releases the lock when the process ends, however it ends. Where a file system has no locks, nothing prevents
two runs in a folder.
"""

from __future__ import annotations

import json
import os
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path

from pano_mvs.core.errors import StoreError
from pano_mvs.core.locks import try_lock

LOCK_NAME = ".pano-mvs-lock"


@contextmanager
def output_lock(out: Path) -> Iterator[None]:
    """Hold the lock of an existing output folder inside the context.

    Raises:
        StoreError: if another run holds it, or the folder cannot be written.
    """
    path = out / LOCK_NAME
    since = datetime.now(UTC).isoformat(timespec="seconds")
    owner = {"host": socket.gethostname(), "process": os.getpid(), "since": since}
    try:
        handle = _acquired(path)
        os.ftruncate(handle, 0)
        os.write(handle, json.dumps(owner, indent=1).encode() + b"\n")
    except StoreError:
        raise
    except OSError as error:
        raise StoreError(
            f"{path} cannot be written: {error.strerror or error}. Choose another folder with --out DIR, "
            "or mend its permissions"
        ) from error
    try:
        yield
    finally:
        if os.name != "posix":
            os.close(handle)  # there, an open file cannot be removed
        with suppress(OSError):
            path.unlink()
        if os.name == "posix":
            os.close(handle)


def is_run_gone(out: Path) -> bool:
    """Return whether a run in an output folder was killed: it left its file, and nobody holds the lock."""
    path = out / LOCK_NAME
    try:
        handle = os.open(path, os.O_RDWR if os.access(path, os.W_OK) else os.O_RDONLY)  # it may be another user's
    except OSError:
        return False
    try:
        return try_lock(handle) is True
    finally:
        os.close(handle)


def _acquired(path: Path) -> int:
    """Return the handle of the file, locked."""
    for _ in range(10):
        handle = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o666)
        if try_lock(handle) is not False:
            with suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(handle), path.stat()):  # else its owner has just removed it
                    return handle
        os.close(handle)
        time.sleep(0.02)  # `is_run_gone` holds it for a moment
    try:
        owner = json.loads(path.read_bytes())
        who = f": process {owner['process']} on {owner['host']}, since {owner['since']}"
    except (OSError, ValueError, KeyError, TypeError):
        who = ""
    raise StoreError(
        f"another run is writing into {path.parent}{who}. Wait until it has ended, or choose another folder with "
        "--out DIR"
    )
