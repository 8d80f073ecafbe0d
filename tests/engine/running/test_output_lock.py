"""One run at a time in an output folder, whatever became of the run before."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from pano_mvs.core.errors import StoreError
from pano_mvs.core.processes import start_of
from pano_mvs.engine.running import output_lock as module
from pano_mvs.engine.running.output_lock import LOCK_NAME, is_run_gone, output_lock

ON_POSIX = pytest.mark.skipif(os.name != "posix", reason="elsewhere it is not known whether a process is gone")


def test_a_second_run_is_refused_and_the_lock_goes_with_the_first(tmp_path: Path) -> None:
    with output_lock(tmp_path):
        with (
            pytest.raises(StoreError, match=rf"process {os.getpid()} on .*, since .*\. Wait until it has ended"),
            output_lock(tmp_path),
        ):
            pass
        assert [path.name for path in tmp_path.iterdir()] == [LOCK_NAME]
        assert not is_run_gone(tmp_path)
    assert not list(tmp_path.iterdir())
    assert not is_run_gone(tmp_path)
    with output_lock(tmp_path):
        pass


def test_the_lock_of_a_process_that_was_killed_is_taken_over(tmp_path: Path) -> None:
    code = f"""import os
from pathlib import Path
from pano_mvs.engine.running.output_lock import output_lock
with output_lock(Path({str(tmp_path)!r})): os._exit(9)"""
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 9
    assert is_run_gone(tmp_path)
    with output_lock(tmp_path):
        assert json.loads((tmp_path / LOCK_NAME).read_bytes())["process"] == os.getpid()
    assert not list(tmp_path.iterdir())


@ON_POSIX
def test_a_killed_run_of_another_user_is_gone_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened = os.open

    def as_other(path: Path, flags: int) -> int:
        if flags & os.O_RDWR:
            raise PermissionError
        return opened(path, flags)

    (tmp_path / LOCK_NAME).touch()
    monkeypatch.setattr(os, "access", lambda _path, mode: not mode & os.W_OK)
    monkeypatch.setattr(os, "open", as_other)
    assert is_run_gone(tmp_path)


@pytest.mark.parametrize("text", [b"", b"{", b"[]"])
def test_a_file_that_names_nobody_is_no_obstacle(tmp_path: Path, text: bytes) -> None:
    (tmp_path / LOCK_NAME).write_bytes(text)
    with output_lock(tmp_path):
        assert json.loads((tmp_path / LOCK_NAME).read_bytes())["process"] == os.getpid()


def test_a_file_that_its_owner_has_just_removed_is_not_the_lock(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lock, calls = module._lock, []

    def overtaken(handle: int) -> bool | None:
        calls.append(handle)
        if len(calls) == 1:
            (tmp_path / LOCK_NAME).unlink()
        return lock(handle)

    monkeypatch.setattr(module, "_lock", overtaken)
    with output_lock(tmp_path):
        assert (tmp_path / LOCK_NAME).is_file()
    assert len(calls) == 2


@ON_POSIX
def test_where_open_files_cannot_be_removed_the_file_is_closed_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    close = os.close
    held: list[bool] = []

    def unlink(_: Path) -> None:
        if held:
            raise PermissionError("it is open")
        os.unlink(tmp_path / LOCK_NAME)  # noqa: PTH108  # as the method does

    def closed(handle: int) -> None:
        close(handle)
        held.clear()

    with output_lock(tmp_path):
        held.append(True)
        monkeypatch.setattr(os, "close", closed)
        monkeypatch.setattr(Path, "unlink", unlink)
        monkeypatch.setattr(os, "name", "nt")
    monkeypatch.undo()
    assert not list(tmp_path.iterdir())


def test_a_file_system_without_locks_stops_no_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_lock", lambda _handle: None)
    with output_lock(tmp_path):
        assert not is_run_gone(tmp_path)


@ON_POSIX
def test_a_link_in_its_place_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "letter").write_text("dear")
    (tmp_path / LOCK_NAME).symlink_to(tmp_path / "letter")
    with pytest.raises(StoreError, match="cannot be written"), output_lock(tmp_path):
        pass
    assert (tmp_path / "letter").read_text() == "dear"


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
