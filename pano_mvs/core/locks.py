"""Locks of the system on files: they end with the process that holds them, however it ends."""

from __future__ import annotations

import errno
import importlib
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

if os.name == "posix":
    import fcntl

_POLL_S = 0.2


def try_lock(handle: int) -> bool | None:
    """Lock an open file, and return whether that was possible; None if the file system has no locks."""
    try:
        if os.name == "posix":
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        else:
            windows = importlib.import_module("msvcrt")
            os.lseek(handle, 1 << 20, os.SEEK_SET)  # what is locked cannot be read
            windows.locking(handle, windows.LK_NBLCK, 1)
            os.lseek(handle, 0, os.SEEK_SET)
    except OSError as error:
        return False if error.errno in (errno.EWOULDBLOCK, errno.EACCES) else None
    return True


@contextmanager
def locked(path: Path, *, on_wait: Callable[[], None] | None = None) -> Iterator[None]:
    """Hold the lock of a file, which is created and stays, inside the context; wait while another process holds it.

    Args:
        on_wait: called once if another process holds it.

    Raises:
        OSError: if the file cannot be written.
    """
    handle = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o666)
    try:
        while try_lock(handle) is False:
            if on_wait is not None:
                on_wait()
                on_wait = None
            time.sleep(_POLL_S)
        yield
    finally:
        os.close(handle)
