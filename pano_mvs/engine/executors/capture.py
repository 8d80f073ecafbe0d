"""Redirect everything that a unit prints to a file: Python's streams, logging, and the output of C and C++ code."""

from __future__ import annotations

import ctypes
import io
import logging
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from pano_mvs.core.files import make_folder

_STDOUT, _STDERR = 1, 2


@contextmanager
def captured(log: Path) -> Iterator[None]:
    """Redirect the standard streams to a file inside the context; an empty file is removed.

    This redirects the descriptors 1 and 2 of the whole process; to print meanwhile, use a duplicate made before.
    """
    make_folder(log.parent)
    target = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_APPEND, 0o666)
    # The original streams are hidden as well, because code that closes one of them would silence this process.
    kept_streams = sys.stdout, sys.stderr, sys.__stdout__, sys.__stderr__
    kept = [os.dup(_STDOUT), os.dup(_STDERR)]
    file = os.fdopen(os.dup(target), "wb", 0)
    stream = io.TextIOWrapper(file, "utf-8", errors="backslashreplace", write_through=True)
    try:
        _flush()
        os.dup2(target, _STDOUT)
        os.dup2(target, _STDERR)
        sys.stdout = sys.stderr = sys.__stdout__ = sys.__stderr__ = stream  # type: ignore[misc]
        with _logging_to(stream):
            yield
    finally:
        sys.stdout, sys.stderr, sys.__stdout__, sys.__stderr__ = kept_streams  # type: ignore[misc]
        _flush()
        os.dup2(kept[0], _STDOUT)
        os.dup2(kept[1], _STDERR)
        with suppress(ValueError):  # it was detached from its file
            stream.close()
        file.close()
        for descriptor in (target, *kept):
            os.close(descriptor)
        with suppress(OSError):
            if log.stat().st_size == 0:
                log.unlink()


def tail(log: Path, lines: int) -> tuple[str, ...]:
    """Return the last lines of a log; none if there is no log."""
    try:
        with log.open("rb") as file:
            file.seek(max(0, log.stat().st_size - 8192))
            text = file.read().decode("utf-8", errors="replace")
    except OSError:
        return ()
    return tuple(text.replace("\r", "\n").rstrip().splitlines()[-lines:])


@contextmanager
def _logging_to(stream: io.TextIOBase) -> Iterator[None]:
    root = logging.getLogger()
    handler = logging.StreamHandler(stream)
    handler.setFormatter(logging.Formatter("%(levelname)s %(name)s: %(message)s"))
    level = root.level
    root.addHandler(handler)
    root.setLevel(min(level, logging.INFO) if level else logging.INFO)
    try:
        yield
    finally:
        root.removeHandler(handler)
        root.setLevel(level)


def _flush() -> None:
    """Flush the streams of Python and C, so that buffered text goes to the present target."""
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError, AttributeError):
            stream.flush()
    with suppress(OSError, AttributeError):
        ctypes.CDLL("ucrtbase" if os.name == "nt" else None).fflush(None)
