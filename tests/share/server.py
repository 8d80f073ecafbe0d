"""A server of a page that can hold back some of its files."""

from __future__ import annotations

import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any


class PageServer(ThreadingHTTPServer):
    """Serves a folder on a free port of this machine.

    Attributes:
        address: of the folder.
    """

    daemon_threads = True

    def __init__(self, folder: Path, held: str) -> None:
        super().__init__(("127.0.0.1", 0), partial(_Handler, directory=str(folder)))
        self.address = f"http://127.0.0.1:{self.server_address[1]}/"
        self._held = re.compile(held)
        self._released = threading.Event()

    def release(self) -> None:
        """Send the files that were held back, and all others from now on."""
        self._released.set()

    def wait_for(self, path: str) -> None:
        """Wait until a file may be sent; not for ever, because a browser may wait for it before it says anything."""
        if self._held.search(path):
            self._released.wait(20)

    def handle_error(self, *_: Any) -> None:
        """Ignore that a browser closes a connection."""


class _Handler(SimpleHTTPRequestHandler):
    server: PageServer

    def do_GET(self) -> None:
        self.server.wait_for(self.path)
        super().do_GET()

    def log_message(self, *_: Any) -> None:
        """Say nothing."""


@contextmanager
def served(folder: Path, *, held: str = "$^") -> Iterator[PageServer]:
    """Serve a folder, and hold back the files whose paths a regular expression matches until they are released."""
    with PageServer(folder, held) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        try:
            yield server
        finally:
            server.release()
            server.shutdown()
            thread.join()
