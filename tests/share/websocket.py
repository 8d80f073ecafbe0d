"""The part of the WebSocket protocol (RFC 6455) by which a client exchanges texts with a program on this machine."""

from __future__ import annotations

import base64
import os
import socket
import struct
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import BinaryIO, Self

import numpy as np

_TEXT, _CLOSE, _PING, _PONG = 1, 8, 9, 10
_SECONDS = 120


class WebSocket:
    """A connection over which texts are sent and received."""

    def __init__(self, connection: socket.socket, stream: BinaryIO, path: str) -> None:
        self._connection = connection
        self._stream = stream
        host, port = connection.getpeername()
        key = base64.b64encode(os.urandom(16)).decode()
        lines = [
            f"GET {path} HTTP/1.1",
            f"Host: {host}:{port}",
            "Upgrade: websocket",
            "Connection: Upgrade",
            f"Sec-WebSocket-Key: {key}",
            "Sec-WebSocket-Version: 13",
        ]
        connection.sendall("\r\n".join([*lines, "", ""]).encode())
        status = self._stream.readline()
        while self._stream.readline().strip():
            pass
        if b" 101 " not in status:
            raise ConnectionError(f"no WebSocket at {path}: {status.decode().strip()}")

    @classmethod
    @contextmanager
    def connected(cls, port: int, path: str) -> Iterator[Self]:
        """Connect to a port of this machine as soon as something listens there."""
        end = time.monotonic() + _SECONDS
        while True:
            try:
                connection = socket.create_connection(("127.0.0.1", port), timeout=_SECONDS)
                break
            except OSError:
                if time.monotonic() > end:
                    raise
                time.sleep(0.05)
        with connection, connection.makefile("rb") as stream:
            yield cls(connection, stream, path)

    def send(self, text: str) -> None:
        """Send a text."""
        self._send(_TEXT, text.encode())

    def receive(self) -> str:
        """Return the next text.

        Raises:
            ConnectionError: if the other side ended the connection.
        """
        data = b""
        while True:
            first, second = self._read(2)
            kind, length = first & 15, second & 127
            if length >= 126:
                length = int.from_bytes(self._read(2 if length == 126 else 8), "big")
            content = self._read(length)
            if kind == _CLOSE:
                raise ConnectionError("the browser ended the connection")
            if kind == _PING:
                self._send(_PONG, content)
            elif kind != _PONG:
                data += content
                if first & 128:
                    return data.decode()

    def _send(self, kind: int, content: bytes) -> None:
        mask = os.urandom(4)
        length = len(content)
        size = (
            struct.pack(">B", 128 | length)
            if length < 126
            else struct.pack(">BH", 128 | 126, length)
            if length < 65536
            else struct.pack(">BQ", 128 | 127, length)
        )
        keys = np.frombuffer((mask * (length // 4 + 1))[:length], np.uint8)
        masked = (np.frombuffer(content, np.uint8) ^ keys).tobytes()
        self._connection.sendall(bytes([128 | kind]) + size + mask + masked)

    def _read(self, count: int) -> bytes:
        content = self._stream.read(count)
        if len(content) < count:
            raise ConnectionError("the browser ended the connection")
        return content
