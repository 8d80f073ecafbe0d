"""A message tells how a run has ended, in whatever way."""

from __future__ import annotations

import json
import sys
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import pytest

from pano_mvs.session.observers import observing
from tests.cli.conftest import Command
from tests.engine.conftest import Toy


@dataclass
class Receiver:
    """A server that takes messages, and what it has received."""

    url: str = ""
    messages: list[dict[str, Any]] = field(default_factory=list)
    status: int = 200


@pytest.fixture
def receiver() -> Iterator[Receiver]:
    found = Receiver()

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            found.messages.append(json.loads(self.rfile.read(int(self.headers["Content-Length"]))))
            self.send_response(found.status)
            self.end_headers()

        def log_message(self, *_: object) -> None:
            pass

    with HTTPServer(("127.0.0.1", 0), Handler) as server:
        found.url = f"json://127.0.0.1:{server.server_port}"
        thread = threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True)
        thread.start()
        yield found
        server.shutdown()
        thread.join()


def test_message_about_a_run(toy: Toy, receiver: Receiver, pano_mvs: Command) -> None:
    arguments = ("run", toy.folder / "wf.yaml", "--executor", "serial", "--out", "lobby", "--notify", receiver.url)
    assert pano_mvs(*arguments).code == 0
    (message,) = receiver.messages
    assert message["title"] == "pano-mvs: lobby: finished"
    duration, place = message["message"].splitlines()[-1].split(", ", 1)
    assert duration.endswith(" s")
    assert place == str(Path("lobby").absolute())


def test_message_about_a_run_with_failures(toy: Toy, receiver: Receiver, pano_mvs: Command) -> None:
    toy.number("3.txt", "13")
    receiver.status = 500
    arguments = ("run", toy.folder / "wf.yaml", "--executor", "serial", "--out", "lobby", "--notify", receiver.url)
    done = pano_mvs(*arguments)
    assert done.code == 3  # as without a message
    assert "warning: the message could not be sent to json" in done.flat
    assert "finished, but some items failed" in receiver.messages[0]["title"]


def test_message_about_an_interrupt(receiver: Receiver, tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt), observing({"notify": (receiver.url,)}, tmp_path):
        raise KeyboardInterrupt
    assert receiver.messages[0]["title"].endswith("interrupted")


def test_message_about_an_error(toy: Toy, receiver: Receiver, pano_mvs: Command) -> None:
    (toy.folder / "capture").rename(toy.folder / "elsewhere")
    (toy.folder / "capture").mkdir()
    assert pano_mvs("run", toy.folder / "wf.yaml", "--executor", "nothing", "--notify", receiver.url).code == 2
    (message,) = receiver.messages
    assert "not possible" in message["title"]
    assert message["message"].startswith("there is no executor 'nothing'")


@pytest.mark.parametrize("url", ["nonsense", "nothing://host", "json://"])
def test_url_that_is_none_is_refused_before_the_run(url: str, toy: Toy, pano_mvs: Command) -> None:
    done = pano_mvs("run", toy.folder / "wf.yaml", "--out", "lobby", "--notify", url)
    assert done.code == 2
    assert f"--notify {url}: must be a URL such as" in done.flat
    assert not Path("lobby").exists()


def test_missing_library_is_refused_with_the_remedy(
    toy: Toy,
    pano_mvs: Command,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "apprise", None)
    done = pano_mvs("run", toy.folder / "wf.yaml", "--notify", "json://localhost")
    assert done.code == 2
    assert "pip install 'pano-mvs[notify]'" in done.flat
