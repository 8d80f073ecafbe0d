"""Firefox, driven by the W3C WebDriver BiDi protocol, which it speaks itself."""

from __future__ import annotations

import base64
import json
import os
import socket
import struct
import subprocess
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, BinaryIO, Self

import numpy as np
from numpy.typing import NDArray

from tests.share.browser import Browser, free_port, installed, picture, sources_of

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


_PREFERENCES: dict[str, bool | int | str] = {
    "app.normandy.enabled": False,
    "app.update.enabled": False,
    "browser.shell.checkDefaultBrowser": False,
    "datareporting.policy.dataSubmissionEnabled": False,
    "layout.css.prefers-color-scheme.content-override": 0,  # dark
    "network.captive-portal-service.enabled": False,
    "network.connectivity-service.enabled": False,
    "services.settings.server": "data:,",
    "toolkit.telemetry.enabled": False,
    "webgl.force-enabled": True,
    "webgl.forbid-software": False,
}
# Without a display Firefox finds no graphics but through EGL.
_ENVIRONMENT = {"MOZ_WEBGL_FORCE_EGL": "1", "LIBGL_ALWAYS_SOFTWARE": "1"}


class Firefox(Browser):
    """A window of Firefox."""

    schemes = ("dark",)

    def __init__(self, socket: WebSocket) -> None:
        self._socket = socket
        self._count = 0
        self._messages: list[str] = []
        self._call("session.new", capabilities={})
        # The first tab has the focus in the address bar, and in a page without focus Enter presses no button.
        self._context = self._call("browsingContext.create", type="tab")["context"]
        self._call("session.subscribe", events=["log.entryAdded"])

    def open(self, address: str) -> None:
        """Load a page."""
        self._call("browsingContext.navigate", context=self._context, url=address, wait="complete")

    def resize(self, width: int, height: int) -> None:
        """Set the size of the area that shows the page."""
        viewport = {"width": width, "height": height}
        self._call("browsingContext.setViewport", context=self._context, viewport=viewport, devicePixelRatio=1)

    def prelude(self, script: str) -> Callable[[], None]:
        """Run a script in each page before its own ones."""
        added = self._call("script.addPreloadScript", functionDeclaration=f"() => {{ {script} }}")
        return partial(self._call, "script.removePreloadScript", **added)

    def evaluate(self, script: str) -> Any:
        """Return the value of a JavaScript expression in the page."""
        answer = self._call(
            "script.evaluate",
            expression=f"Promise.resolve(({script})).then((value) => JSON.stringify(value ?? null))",
            target={"context": self._context},
            awaitPromise=True,
        )
        if answer["type"] == "exception":
            raise RuntimeError(f"{script}: {answer['exceptionDetails']['text']}")
        return json.loads(answer["result"]["value"])

    def perform(self, source: Mapping[str, Any]) -> None:
        """Let a pointer or a keyboard act."""
        self._call("input.performActions", context=self._context, actions=sources_of(source))

    def screenshot(self) -> NDArray[np.uint8]:
        """Return the window's contents, (H, W, 3) uint8 RGB."""
        answer = self._call("browsingContext.captureScreenshot", context=self._context)
        return picture(base64.b64decode(answer["data"]))

    def console(self) -> list[str]:
        """Return errors and warnings that the page wrote to the console since the last call."""
        self.evaluate("0")  # so that all earlier messages have arrived
        messages, self._messages = self._messages, []
        return messages

    def prefer(self, scheme: str, *, reduced_motion: bool = False) -> None:
        """Accept what the profile prefers anyway; Firefox cannot change it while it runs."""
        assert scheme in self.schemes
        assert not reduced_motion

    def _call(self, method: str, **params: Any) -> Any:
        self._count += 1
        self._socket.send(json.dumps({"id": self._count, "method": method, "params": params}))
        while True:
            answer = json.loads(self._socket.receive())
            if answer.get("method") == "log.entryAdded":
                entry = answer["params"]
                if entry["level"] in ("error", "warn"):
                    self._messages.append(str(entry["text"]))
            elif answer.get("id") == self._count:
                if answer["type"] == "error":
                    raise RuntimeError(f"{method}: {answer['error']}: {answer['message']}")
                return answer["result"]


@contextmanager
def firefox() -> Iterator[Firefox]:
    """Start Firefox with a fresh profile and end it afterwards."""
    program, port = installed("firefox-esr", "firefox"), free_port()
    with TemporaryDirectory(prefix="pano-mvs-browser-", ignore_cleanup_errors=True) as profile:
        lines = [f"user_pref({json.dumps(name)}, {json.dumps(value)});" for name, value in _PREFERENCES.items()]
        (Path(profile) / "user.js").write_text("\n".join(lines) + "\n", encoding="utf-8")
        process = subprocess.Popen(
            [program, "--headless", "--no-remote", "--profile", profile, f"--remote-debugging-port={port}"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env={**os.environ, **_ENVIRONMENT},
        )
        try:
            with WebSocket.connected(port, "/session") as socket:
                yield Firefox(socket)
        finally:
            process.terminate()
            process.wait()
