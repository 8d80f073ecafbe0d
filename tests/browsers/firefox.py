"""Firefox, driven by the W3C WebDriver BiDi protocol, which it speaks itself."""

from __future__ import annotations

import asyncio
import base64
import json
import os
import subprocess
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tornado.websocket import WebSocketClientConnection, websocket_connect

from tests.browsers.browser import Browser, free_port, installed, picture, sources_of

_SECONDS = 120


class WebSocket:
    """A connection over which texts are sent and received."""

    def __init__(self, port: int) -> None:
        """Connect to a port of this machine as soon as something listens there."""
        self._loop = asyncio.new_event_loop()
        self._connection = self._loop.run_until_complete(self._connected(port))

    async def _connected(self, port: int) -> WebSocketClientConnection:
        end = time.monotonic() + _SECONDS
        while True:
            try:
                return await websocket_connect(f"ws://127.0.0.1:{port}/session", max_message_size=1 << 30)
            except OSError:
                if time.monotonic() > end:
                    raise
                await asyncio.sleep(0.05)

    def send(self, text: str) -> None:
        """Send a text."""
        self._loop.run_until_complete(self._written(text))

    async def _written(self, text: str) -> None:
        await self._connection.write_message(text)

    def receive(self) -> str:
        """Return the next text.

        Raises:
            ConnectionError: if the other side ended the connection.
        """
        text = self._loop.run_until_complete(asyncio.wait_for(self._read(), _SECONDS))
        if text is None:
            raise ConnectionError("the browser ended the connection")
        return str(text)

    async def _read(self) -> str | bytes | None:
        return await self._connection.read_message()

    def close(self) -> None:
        """End the connection."""
        self._connection.close()
        self._loop.close()


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
            with closing(WebSocket(port)) as socket:
                yield Firefox(socket)
        finally:
            process.terminate()
            process.wait()
