"""A headless Chromium, driven through chromedriver by the W3C WebDriver protocol."""

from __future__ import annotations

import base64
import json
import shutil
import socket
import subprocess
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

_ARGUMENTS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-first-run",
    "--enable-unsafe-swiftshader",
    "--use-angle=swiftshader",
    "--hide-scrollbars",
)


def chromedriver() -> str | None:
    """Return the path of chromedriver; None if Chromium is not installed."""
    return shutil.which("chromedriver") if shutil.which("chromium") or shutil.which("google-chrome") else None


class Browser:
    """One window of a browser.

    Attributes:
        root: address of the WebDriver session.
    """

    def __init__(self, root: str) -> None:
        self.root = root

    def open(self, address: str) -> None:
        """Load a page."""
        _call("POST", f"{self.root}/url", {"url": address})

    def resize(self, width: int, height: int) -> None:
        """Set the size of the area that shows the page."""
        metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        arguments = {"cmd": "Emulation.setDeviceMetricsOverride", "params": metrics}
        _call("POST", f"{self.root}/goog/cdp/execute", arguments)

    def command(self, name: str, **params: Any) -> Any:
        """Run a command of the DevTools protocol, such as `Emulation.setEmulatedMedia`."""
        return _call("POST", f"{self.root}/goog/cdp/execute", {"cmd": name, "params": params})

    def evaluate(self, script: str) -> Any:
        """Return the value of a JavaScript expression in the page."""
        return _call("POST", f"{self.root}/execute/sync", {"script": f"return ({script})", "args": []})

    def wait(self, script: str, *, seconds: float = 60) -> None:
        """Wait until an expression is true.

        Raises:
            TimeoutError: if it does not become true in time.
        """
        end = time.monotonic() + seconds
        while not self.evaluate(f"Boolean({script})"):
            if time.monotonic() > end:
                raise TimeoutError(f"never true: {script}; console: {self.console()}")
            time.sleep(0.1)

    def click(self, x: float, y: float) -> None:
        """Click a place of the window, in pixels from its upper-left corner."""
        moves = [
            {"type": "pointerMove", "duration": 0, "x": round(x), "y": round(y)},
            {"type": "pointerDown", "button": 0},
            {"type": "pointerUp", "button": 0},
        ]
        pointer = {"type": "pointer", "id": "mouse", "parameters": {"pointerType": "mouse"}, "actions": moves}
        _call("POST", f"{self.root}/actions", {"actions": [pointer]})

    def press(self, key: str) -> None:
        """Press and release a key."""
        keys = [{"type": "keyDown", "value": key}, {"type": "keyUp", "value": key}]
        _call("POST", f"{self.root}/actions", {"actions": [{"type": "key", "id": "keyboard", "actions": keys}]})

    def screenshot(self) -> NDArray[np.uint8]:
        """Return the window's contents, (H, W, 3) uint8 RGB."""
        data = base64.b64decode(_call("GET", f"{self.root}/screenshot"))
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        assert image is not None
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)

    def console(self) -> list[str]:
        """Return errors and warnings that the page wrote to the console since the last call."""
        entries = _call("POST", f"{self.root}/se/log", {"type": "browser"})
        return [entry["message"] for entry in entries if entry["level"] in ("SEVERE", "WARNING")]


@contextmanager
def open_browser(*, width: int = 1280, height: int = 720) -> Iterator[Browser]:
    """Start a browser and end it afterwards."""
    driver = chromedriver()
    assert driver is not None, "these tests need the packages chromium and chromium-driver"
    port = _free_port()
    with TemporaryDirectory(prefix="pano-mvs-browser-", ignore_cleanup_errors=True) as profile:
        process = subprocess.Popen(
            [driver, f"--port={port}", "--silent"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        try:
            root = f"http://127.0.0.1:{port}"
            _wait_for(f"{root}/status")
            arguments = [*_ARGUMENTS, f"--user-data-dir={Path(profile) / 'profile'}"]
            wanted = {"goog:chromeOptions": {"args": arguments}, "goog:loggingPrefs": {"browser": "ALL"}}
            session = _call("POST", f"{root}/session", {"capabilities": {"alwaysMatch": wanted}})["sessionId"]
            browser = Browser(f"{root}/session/{session}")
            browser.resize(width, height)
            try:
                yield browser
            finally:
                _call("DELETE", browser.root)
        finally:
            process.terminate()
            process.wait()


def _call(method: str, address: str, body: dict[str, Any] | None = None) -> Any:
    data = json.dumps(body).encode() if body is not None else None
    request = urllib.request.Request(  # our own process
        address, data, {"Content-Type": "application/json"}, method=method
    )
    with urllib.request.urlopen(request, timeout=120) as answer:
        return json.load(answer)["value"]


def _wait_for(address: str) -> None:
    end = time.monotonic() + 60
    while True:
        try:
            _call("GET", address)
        except OSError:
            if time.monotonic() > end:
                raise
            time.sleep(0.1)
        else:
            return


def _free_port() -> int:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return int(listener.getsockname()[1])
