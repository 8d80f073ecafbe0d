"""Standard streams that tolerate a closed pipe or a full disk, which end the output but not the command."""

from __future__ import annotations

import errno
import io
import os
import select
import sys
from typing import TYPE_CHECKING, TextIO

from pano_mvs.cli.console import Console
from pano_mvs.core.errors import StoreError

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

CLOSED_PIPE = 128 + 13
"""The exit code of a command whose reader left: what a shell reports of a program that SIGPIPE ended."""

_READER_LEFT = {errno.EPIPE, errno.ECONNRESET, getattr(errno, "ESHUTDOWN", errno.EPIPE)}


class StreamState:
    """Whether a stream can still be written."""

    def __init__(self) -> None:
        self.reader_left = False  # whether the other end of the pipe, or the terminal, was closed
        self.failure = ""  # why the stream cannot be written otherwise, such as a full disk; empty if it can
        self.reader_may_leave = False  # whether the command keeps its own exit code when the reader leaves

    def exit_code(self, code: int) -> int:
        """Return the exit code of a command that would end with `code`, reporting a failed standard output."""
        if self.failure:
            text = f"the standard output cannot be written: {self.failure}. The command went on without it"
            Console(stderr=True).say(f"[red]error:[/] {text}")
            return code or StoreError.exit_code
        return CLOSED_PIPE if self.reader_left and not self.reader_may_leave and not code else code


class LenientStream(io.TextIOWrapper):
    """A text stream that drops all output after the first failed write."""

    def __init__(
        self, raw: io.RawIOBase, encoding: str, state: StreamState, *, owned: bool = False, by_line: bool = True
    ) -> None:
        """Write to a raw stream, which is closed with this one if it is owned; `by_line` flushes after each line."""
        self.state = state
        lenient = _LenientRaw(raw, state, owned=owned)
        super().__init__(io.BufferedWriter(lenient), encoding, "replace", line_buffering=by_line)


class _LenientRaw(io.RawIOBase):
    def __init__(self, raw: io.RawIOBase, state: StreamState, *, owned: bool) -> None:
        self._raw = raw
        self._state = state
        self._owned = owned
        self._is_terminal = raw.isatty()

    def writable(self) -> bool:
        return True

    def fileno(self) -> int:
        return self._raw.fileno()

    def isatty(self) -> bool:
        return self._is_terminal

    def close(self) -> None:
        super().close()
        if self._owned:
            self._raw.close()

    def write(self, data: ReadableBuffer, /) -> int:
        size = memoryview(data).nbytes
        if self._state.reader_left or self._state.failure:
            return size
        try:
            while (
                written := self._raw.write(data)
            ) is None:  # another process made the terminal or the pipe non-blocking
                select.select([], [self._raw], [])
        except OSError as error:
            hung_up = self._is_terminal and error.errno == errno.EIO
            if error.errno in _READER_LEFT or hung_up or (os.name == "nt" and error.errno == errno.EINVAL):
                self._state.reader_left = True
            else:
                self._state.failure = error.strerror or str(error)
            return size
        return written


def protect_standard_streams() -> StreamState:
    """Make the standard output and error streams lenient; return the state of the output.

    A descriptor that was closed when the command started is redirected to the null device. Otherwise the next opened
    file would get its number, and would receive the output.
    """
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # it gets the lowest free number, which is this one
    sys.stdout, sys.stderr = _lenient(sys.stdout, 1), _lenient(sys.stderr, 2)
    return sys.stdout.state if isinstance(sys.stdout, LenientStream) else StreamState()


def _lenient(stream: TextIO | None, descriptor: int) -> TextIO:
    """Return a lenient stream for a standard one; a stream that is not a file is returned unchanged."""
    if stream is None:  # its descriptor was closed
        return LenientStream(io.FileIO(descriptor, "w", closefd=False), "utf-8", StreamState())
    raw = getattr(stream, "buffer", None)
    raw = getattr(raw, "raw", raw)
    if not isinstance(stream, io.TextIOWrapper) or not isinstance(raw, io.RawIOBase):
        return stream
    stream.flush()
    return LenientStream(raw, stream.encoding, StreamState(), by_line=stream.line_buffering or stream.write_through)


def apart(stream: TextIO) -> TextIO:
    """Return a stream to the current target of another one, unaffected by later redirections of its descriptor.

    It is lenient, and its reader may exit. If the other stream is lenient, both share their state. A stream without
    descriptor, such as that of a test, is returned unchanged.
    """
    try:
        stream.flush()
        descriptor = os.dup(stream.fileno())
    except (OSError, ValueError, AttributeError):
        return stream
    state = stream.state if isinstance(stream, LenientStream) else StreamState()
    state.reader_may_leave = True
    return LenientStream(io.FileIO(descriptor, "w"), stream.encoding, state, owned=True)
