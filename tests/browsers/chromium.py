"""Chromium, driven through chromedriver by the W3C WebDriver protocol."""

from __future__ import annotations

import base64
import json
import subprocess
import time
import urllib.request
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from urllib.error import HTTPError

import numpy as np
from numpy.typing import NDArray

from tests.browsers.browser import Browser, free_port, installed, picture, sources_of

_ARGUMENTS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-first-run",
    "--enable-unsafe-swiftshader",
    "--use-angle=swiftshader",
    "--disable-gpu-watchdog",  # it ends the process that draws, and with it all contexts, on a machine that is busy
    "--hide-scrollbars",
)


class DriverError(OSError):
    """What chromedriver says about a command that it could not do."""


class Chromium(Browser):
    """A window of Chromium.

    Attributes:
        root: address of the WebDriver session.
    """

    schemes = ("light", "dark")

    def __init__(self, root: str) -> None:
        self.root = root

    def open(self, address: str) -> None:
        """Load a page, and wait until it is the one that scripts see."""
        self.evaluate("window.isEarlierPage = true")
        _call("POST", f"{self.root}/url", {"url": address})
        self.wait("!window.isEarlierPage && document.readyState === 'complete'")

    def resize(self, width: int, height: int) -> None:
        """Set the size of the area that shows the page."""
        self.command(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False
        )

    def prelude(self, script: str) -> Callable[[], None]:
        """Run a script in each page before its own ones."""
        added = self.command("Page.addScriptToEvaluateOnNewDocument", source=script)
        return partial(self.command, "Page.removeScriptToEvaluateOnNewDocument", **added)

    def throttle(self, *, bits_per_s: float, latency_ms: float) -> None:
        """Let all that arrives take as long as over a slow line; with an empty cache."""
        self.command("Network.enable")
        self.command("Network.setCacheDisabled", cacheDisabled=True)
        speed = {"downloadThroughput": bits_per_s / 8, "uploadThroughput": bits_per_s / 8}
        self.command("Network.emulateNetworkConditions", offline=False, latency=latency_ms, **speed)

    def evaluate(self, script: str) -> Any:
        """Return the value of a JavaScript expression in the page."""
        return _call("POST", f"{self.root}/execute/sync", {"script": f"return ({script})", "args": []})

    def perform(self, source: Mapping[str, Any]) -> None:
        """Let a pointer or a keyboard act."""
        _call("POST", f"{self.root}/actions", {"actions": sources_of(source)})

    def screenshot(self) -> NDArray[np.uint8]:
        """Return the window's contents, (H, W, 3) uint8 RGB.

        While a frame starts a process of its own, or draws for long, Chromium has no picture yet and refuses.
        """
        end = time.monotonic() + 60
        while True:
            try:
                return picture(base64.b64decode(_call("GET", f"{self.root}/screenshot")))
            except DriverError:
                if time.monotonic() > end:
                    raise
                time.sleep(0.2)

    def console(self) -> list[str]:
        """Return errors and warnings that the page wrote to the console since the last call."""
        entries = _call("POST", f"{self.root}/se/log", {"type": "browser"})
        return [entry["message"] for entry in entries if entry["level"] in ("SEVERE", "WARNING")]

    def prefer(self, scheme: str, *, reduced_motion: bool = False) -> None:
        """Set what the user prefers."""
        motion = "reduce" if reduced_motion else "no-preference"
        features = {"prefers-color-scheme": scheme, "prefers-reduced-motion": motion}
        given = [{"name": name, "value": value} for name, value in features.items()]
        self.command("Emulation.setEmulatedMedia", features=given)

    def command(self, name: str, **params: Any) -> Any:
        """Run a command of the DevTools protocol, such as `Emulation.setEmulatedMedia`."""
        return _call("POST", f"{self.root}/goog/cdp/execute", {"cmd": name, "params": params})


@contextmanager
def chromium(*, width: int = 1280, height: int = 720) -> Iterator[Chromium]:
    """Start Chromium with a window of a size, and end it afterwards."""
    installed("chromium", "google-chrome")
    driver, port = installed("chromedriver"), free_port()
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
            browser = Chromium(f"{root}/session/{session}")
            browser.resize(width, height)
            try:
                yield browser
            finally:
                _call("DELETE", browser.root)
        finally:
            process.terminate()
            process.wait()


def _call(method: str, address: str, body: Mapping[str, Any] | None = None) -> Any:
    data = json.dumps(body).encode() if body is not None else None
    request = urllib.request.Request(  # our own process
        address, data, {"Content-Type": "application/json"}, method=method
    )
    try:
        with urllib.request.urlopen(request, timeout=120) as answer:
            return json.load(answer)["value"]
    except HTTPError as error:
        raise DriverError(error.read().decode(errors="replace")) from error


def _wait_for(address: str) -> None:
    end = time.monotonic() + 60
    while True:
        try:
            _call("GET", address)
        except OSError:
            if time.monotonic() > end:
                raise
            time.sleep(0.05)
        else:
            return
