"""Headless browsers that open the page: Chromium through chromedriver, Firefox through WebDriver BiDi."""

from __future__ import annotations

import shutil
import socket
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray


class Browser(ABC):
    """One window of a browser.

    Attributes:
        schemes: the values of prefers-color-scheme that `prefer` can set.
    """

    schemes: tuple[str, ...] = ()

    @abstractmethod
    def open(self, address: str) -> None:
        """Load a page."""

    @abstractmethod
    def resize(self, width: int, height: int) -> None:
        """Set the size of the area that shows the page."""

    @abstractmethod
    def prelude(self, script: str) -> Callable[[], None]:
        """Run a script in each page before its own ones; return a function that ends this."""

    @abstractmethod
    def evaluate(self, script: str) -> Any:
        """Return the value of a JavaScript expression in the page; of a promise, what it resolves to."""

    @abstractmethod
    def perform(self, source: Mapping[str, Any]) -> None:
        """Let a pointer or a keyboard act, as in "perform actions" of W3C WebDriver; or several: {"sources": [...]}."""

    @abstractmethod
    def screenshot(self) -> NDArray[np.uint8]:
        """Return the window's contents, (H, W, 3) uint8 RGB."""

    @abstractmethod
    def console(self) -> list[str]:
        """Return errors and warnings that the page wrote to the console since the last call."""

    @abstractmethod
    def prefer(self, scheme: str, *, reduced_motion: bool = False) -> None:
        """Set what the user prefers: one of `schemes`, and whether motion is reduced."""

    def wait(self, script: str, *, seconds: float = 60) -> None:
        """Wait until an expression is true.

        Raises:
            TimeoutError: if it does not become true in time.
        """
        end = time.monotonic() + seconds
        while not self.evaluate(f"Boolean({script})"):
            if time.monotonic() > end:
                raise TimeoutError(f"never true: {script}; console: {self.console()}")
            time.sleep(0.05)

    def click(self, x: float, y: float) -> None:
        """Click a place of the window, in pixels from its upper-left corner."""
        self.perform(_pointer("mouse", "mouse", [_to(x, y), {"type": "pointerDown", "button": 0}, _UP]))

    def drag(self, start: tuple[float, float], end: tuple[float, float], *, kind: str = "mouse") -> None:
        """Press at one place, move to another and release; kind: mouse or touch."""
        self.perform(_stroke(kind, kind, start, end))

    def pinch(self, centre: tuple[float, float], before: float, after: float) -> None:
        """Put two fingers down, so many pixels apart, and move them until they are so many pixels apart."""
        x, y = centre
        strokes = [
            _stroke(f"finger {side}", "touch", (x + side * before / 2, y), (x + side * after / 2, y))
            for side in (-1, 1)
        ]
        self.perform({"sources": strokes})

    def press(self, key: str, *, holding: str = "") -> None:
        """Press and release a key, while another one is held down or not."""
        held = [{"type": kind, "value": holding} for kind in ("keyDown", "keyUp") if holding]
        keys = [*held[:1], {"type": "keyDown", "value": key}, {"type": "keyUp", "value": key}, *held[1:]]
        self.perform({"type": "key", "id": "keyboard", "actions": keys})


_UP = {"type": "pointerUp", "button": 0}


def _to(x: float, y: float) -> dict[str, Any]:
    return {"type": "pointerMove", "duration": 0, "x": round(x), "y": round(y)}


def _pointer(name: str, kind: str, actions: list[dict[str, Any]]) -> dict[str, Any]:
    return {"type": "pointer", "id": name, "parameters": {"pointerType": kind}, "actions": actions}


def _stroke(name: str, kind: str, start: tuple[float, float], end: tuple[float, float]) -> dict[str, Any]:
    steps = [_to(*(np.asarray(start) + (np.asarray(end) - start) * part)) for part in (0.25, 0.5, 0.75, 1.0)]
    return _pointer(name, kind, [_to(*start), {"type": "pointerDown", "button": 0}, *steps, _UP])


def sources_of(source: Mapping[str, Any]) -> list[Any]:
    """Return the sources of actions that `Browser.perform` was given."""
    return list(source["sources"]) if "sources" in source else [source]


def picture(png: bytes) -> NDArray[np.uint8]:
    """Return a PNG file's pixels, (H, W, 3) uint8 RGB."""
    image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR_RGB)
    assert image is not None
    return np.asarray(image, np.uint8)


def free_port() -> int:
    """Return a port of this machine on which nothing listens."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return int(listener.getsockname()[1])


def installed(*names: str) -> str:
    """Return the path of the first of these programs that is installed.

    Raises:
        RuntimeError: if none is. The tests fail then; they are not skipped.
    """
    for name in names:
        if (path := shutil.which(name)) is not None:
            return path
    raise RuntimeError(f"these tests need {' or '.join(names)}: install chromium, chromium-driver and firefox-esr")


@contextmanager
def open_browser(name: str, *, width: int = 1280, height: int = 720) -> Iterator[Browser]:
    """Start "chromium" or "firefox", and end it afterwards."""
    from tests.browsers.chromium import chromium
    from tests.browsers.firefox import firefox

    starts: dict[str, Callable[[], AbstractContextManager[Browser]]] = {"chromium": chromium, "firefox": firefox}
    with starts[name]() as browser:
        browser.resize(width, height)
        yield browser
