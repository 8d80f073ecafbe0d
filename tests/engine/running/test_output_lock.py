"""One run at a time in an output folder, whatever became of the run before."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from pano_mvs.core.errors import StoreError
from pano_mvs.core.processes import start_of
from pano_mvs.engine.running import output_lock as module
from pano_mvs.engine.running.output_lock import LOCK_NAME, output_lock

ON_POSIX = pytest.mark.skipif(os.name != "posix", reason="elsewhere it is not known whether a process is gone")

Change = Callable[[dict[str, Any]], dict[str, Any]]


def left_behind(out: Path, change: Change) -> Path:
    """Leave the lock of a run that was killed, changed."""
    path = out / LOCK_NAME
    with output_lock(out):
        owner = json.loads(path.read_bytes())
    path.write_text(json.dumps(change(owner)))
    return path


def ended_process() -> int:
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


def test_a_second_run_is_refused_and_the_lock_goes_with_the_first(tmp_path: Path) -> None:
    with output_lock(tmp_path):
        with (
            pytest.raises(StoreError, match=rf"process {os.getpid()} on .*, since .*\. Wait until it has ended"),
            output_lock(tmp_path),
        ):
            pass
        assert [path.name for path in tmp_path.iterdir()] == [LOCK_NAME]
    assert not list(tmp_path.iterdir())
    with output_lock(tmp_path):
        pass


@ON_POSIX
@pytest.mark.parametrize(
    "change",
    [
        lambda owner: owner | {"process": ended_process()},
        lambda owner: owner | {"process_started": "1"},  # the number belongs to another process by now
        lambda owner: owner | {"place": "x", "boot": "before", "machine": "m"},
    ],
)
def test_the_lock_of_a_process_that_is_gone_is_taken_over(
    tmp_path: Path, change: Change, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "machine_id", lambda: "m")
    path = left_behind(tmp_path, change)
    with output_lock(tmp_path):
        assert json.loads(path.read_bytes())["process"] == os.getpid()
    assert not path.exists()


@pytest.mark.parametrize(
    "change",
    [
        lambda owner: owner | {"place": "x", "host": "another", "boot": "x"},
        lambda owner: owner | {"place": "x"},  # another container of this host
        lambda owner: owner | {"place": "x", "boot": "x", "machine": ""},
    ],
)
def test_the_lock_of_another_host_is_left_to_the_user(tmp_path: Path, change: Change) -> None:
    path = left_behind(tmp_path, change)
    before = path.read_bytes()
    with pytest.raises(StoreError, match=rf"which cannot be checked from here, delete {path}"), output_lock(tmp_path):
        pass
    assert path.read_bytes() == before


@pytest.mark.parametrize("text", [b"", b"{", b"[]", b'{"process": "1"}', b'{"process": -1}'])
def test_a_lock_that_names_nobody_is_left_to_the_user(
    tmp_path: Path, text: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_PAUSE_S", 0)
    (tmp_path / LOCK_NAME).write_bytes(text)
    with pytest.raises(StoreError, match="does not name the run"), output_lock(tmp_path):
        pass
    assert (tmp_path / LOCK_NAME).read_bytes() == text


def test_a_file_system_without_links_has_locks_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "link", refuse)
    with output_lock(tmp_path):
        with pytest.raises(StoreError, match="another run is writing"), output_lock(tmp_path):
            pass
        assert [path.name for path in tmp_path.iterdir()] == [LOCK_NAME]
    assert not list(tmp_path.iterdir())


def test_a_link_whose_success_a_file_server_did_not_report_counts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    link = os.link

    def unheard(source: Path, target: Path) -> None:
        link(source, target)
        raise FileExistsError(17, "File exists")  # the server did it twice, as the first answer was lost

    monkeypatch.setattr(os, "link", unheard)
    with output_lock(tmp_path):
        assert (tmp_path / LOCK_NAME).is_file()


@ON_POSIX
def test_of_two_that_judge_a_lock_stale_one_alone_takes_it_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second read the old lock before the first had replaced it: it must not remove the new one."""
    path = left_behind(tmp_path, lambda owner: owner | {"process_started": "1"})
    remove, first = module._remove_stale, output_lock(tmp_path)
    calls: list[Path] = []

    def overtaken(path: Path, stale: bytes | None) -> None:
        calls.append(path)
        if len(calls) == 1:
            first.__enter__()
        remove(path, stale)

    monkeypatch.setattr(module, "_remove_stale", overtaken)
    with pytest.raises(StoreError, match=f"process {os.getpid()} on"), output_lock(tmp_path):
        pass
    assert len(calls) == 2
    assert path.is_file()
    first.__exit__(None, None, None)
    assert not path.exists()


def test_a_lock_that_cannot_be_written_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="cannot be written"), output_lock(tmp_path / "nowhere"):
        pass


@ON_POSIX
def test_the_start_of_a_process_is_its_own() -> None:
    assert start_of(os.getpid()) == start_of(os.getpid()) != ""
    process = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    assert start_of(process.pid) not in (None, "")
    process.kill()
    os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)  # it has ended, and nobody has taken note
    assert start_of(process.pid) is None
    process.communicate()
    assert start_of(process.pid) is None
