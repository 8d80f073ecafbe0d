"""A disk that fills up, wherever that is: exit code 4 and the remedy; after room was made the same command goes on.

A full disk is played by refusing, from a certain one on, everything that would take room. A small real one is filled
where it may be mounted, which takes root.
"""

from __future__ import annotations

import errno
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from pano_mvs.cli.app import app
from pano_mvs.core import files
from pano_mvs.core.errors import StoreError
from pano_mvs.engine.cache import store as disk_guard
from pano_mvs.engine.cache.maintenance import verify
from pano_mvs.engine.cache.store import Store
from pano_mvs.session.running import MIN_FREE_VARIABLE
from tests.engine.conftest import Toy
from tools.stress.captures import deliverables, write_toy


class Disk:
    """Refuses whatever takes room once so many such calls have been made."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, number: int = errno.ENOSPC) -> None:
        self.left: float = float("inf")
        self.calls = 0
        self._number = number
        for place, name in (
            (tempfile, "mkstemp"),
            (tempfile, "mkdtemp"),
            (Path, "write_bytes"),
            (Path, "write_text"),
            (Path, "mkdir"),
            (Path, "touch"),
            (shutil, "copyfile"),
            (os, "open"),
        ):
            monkeypatch.setattr(place, name, self._metered(getattr(place, name), creates=name == "open"))

    def _metered(self, function: Callable[..., Any], *, creates: bool) -> Callable[..., Any]:
        def call(*arguments: Any, **settings: Any) -> Any:
            if not creates or (len(arguments) > 1 and arguments[1] & os.O_CREAT):
                self.calls += 1
                if self.calls > self.left:
                    raise OSError(self._number, os.strerror(self._number))
            return function(*arguments, **settings)

        return call


def run(toy: Toy, *options: str) -> tuple[int, str]:
    command = [
        *f"run {toy.folder / 'wf.yaml'} --cache {toy.folder / 'cache'} --out {toy.folder / 'out'}".split(),
        *options,
    ]
    result = CliRunner().invoke(app, command)
    return result.exit_code, " ".join(result.output.split())


@pytest.mark.slow
def test_disk_that_fills_up_anywhere_stops_the_run_and_loses_nothing(
    toy: Toy, monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory
) -> None:
    toy.run(cache=tmp_path_factory.mktemp("clean") / "cache")
    clean = deliverables(toy.folder / "out")
    disk = Disk(monkeypatch)
    assert run(toy, "--min-free", "0")[0] == 0
    calls = disk.calls
    assert calls > 300
    for left in (0, 5, *range(calls // 2, calls // 2 + 12), calls - 1):  # a unit takes about twelve
        for name in ("cache", "out"):
            files.remove_whole(toy.folder / name)
        disk.calls, disk.left = 0, left
        code, said = run(toy, "--min-free", "0")
        assert code == 4, (left, said)
        assert "internal error" not in said
        assert str(toy.folder) in said
        assert "make room" in said.lower() or "free some space" in said.lower(), said
        disk.left = float("inf")
        if left % 3 == 1:
            continue  # these say only how it stops
        code, said = run(toy)
        assert code == 0, (left, said)
        assert deliverables(toy.folder / "out") == clean
        assert not list(toy.folder.rglob(".tmp-*"))


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EFBIG])
def test_quota_is_a_full_disk_too(toy: Toy, monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    disk = Disk(monkeypatch, number)
    disk.left = 40
    code, said = run(toy)
    assert code == 4
    assert "failed:" not in said


@pytest.mark.parametrize("how", ["OSError('12 requested and 0 written')", "RuntimeError('cannot write')"])
def test_library_that_tells_of_a_full_disk_in_its_own_words_is_understood(
    toy: Toy, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    toy.begin(f"raise {how}")
    code, said = run(toy)
    assert (code, "cannot write" in said or "requested" in said) == (3, True)
    monkeypatch.setattr(disk_guard, "_FULL_BELOW_BYTES", 1 << 60)
    code, said = run(toy)
    assert code == 4
    assert "Make room" in said


def test_what_was_made_on_a_full_disk_is_not_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A library that does not look at what became of its writes leaves a short file and says nothing."""
    monkeypatch.setattr(disk_guard, "_FULL_BELOW_BYTES", 1 << 60)
    with pytest.raises(StoreError, match="is full"), Store(tmp_path).scratch():
        pass


@pytest.mark.parametrize("by_variable", [True, False])
def test_guard_stops_before_the_disk_is_full(toy: Toy, monkeypatch: pytest.MonkeyPatch, by_variable: bool) -> None:
    if by_variable:
        monkeypatch.setenv(MIN_FREE_VARIABLE, "900TB")
    code, said = run(toy, *([] if by_variable else ["--min-free", "900 TB"]))
    assert code == 4
    assert f"of the cache {toy.folder / 'cache'}, but 900000000 MB must stay free (--min-free). Make room" in said
    monkeypatch.delenv(MIN_FREE_VARIABLE, raising=False)
    assert run(toy, "--min-free", "1MB", "--durable")[0] == 0


def test_size_that_is_none_is_refused(toy: Toy) -> None:
    code, said = run(toy, "--min-free", "much")
    assert code == 2
    assert "--min-free" in said
    assert "such as" in said


@pytest.mark.slow
def test_workers_keep_the_guard_of_the_run(toy: Toy) -> None:
    """The workers' own guard, of 200 MB, would stop them on a small disk where the run was told to go on."""
    text = 'import pano_mvs.engine.cache.store as s\n    for o in __import__("gc").get_objects():\n'
    text += "        if isinstance(o, s.Store): assert (o.durable, o.min_free_bytes) == (True, 12345), o.durable"
    toy.edit("plug.py", lambda plugin: plugin.replace('    """Multiply."""', f'    """Multiply."""\n    {text}'))
    code, said = run(toy, "--executor", "processes", "--workers", "2", "--durable", "--min-free", "12345")
    assert code == 0, said


def mounted(folder: Path, size: str) -> bool:
    if os.name != "posix" or os.geteuid() != 0:
        return False
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)]
    return subprocess.run(command, capture_output=True, check=False).returncode == 0


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    folder = tmp_path / "disk"
    if not mounted(folder, "6m"):
        pytest.skip("only root may mount a small disk; the tests above play one")
    yield folder
    subprocess.run(["umount", "-l", str(folder)], check=True)


@pytest.mark.slow
def test_small_disk_fills_up_and_the_run_goes_on_when_it_is_larger(tmp_path: Path, small_disk: Path) -> None:
    workflow = write_toy(tmp_path / "toy")

    def run_in(cache: Path, out: Path, *options: str) -> tuple[int, str]:
        command = [sys.executable, "-m", "pano_mvs", "run", str(workflow), "--cache", str(cache), "--out", str(out)]
        done = subprocess.run([*command, *options], capture_output=True, text=True, check=False, cwd=tmp_path)
        return done.returncode, done.stdout + done.stderr

    assert run_in(tmp_path / "clean-cache", tmp_path / "clean")[0] == 0
    cache, out = small_disk / "cache", tmp_path / "out"
    options = ("--executor", "processes", "--min-free", "0")
    code, said = run_in(cache, out, *options)
    assert code == 4, said
    assert str(small_disk) in said
    assert "the same command again" in " ".join(said.split())
    records = list((cache / "records").rglob("*.json"))
    assert len(records) > 30
    subprocess.run(["mount", "-o", "remount,size=64m", str(small_disk)], check=True)
    code, said = run_in(cache, out, *options)
    assert code == 0, said
    assert deliverables(out) == deliverables(tmp_path / "clean")
    store = Store(cache)
    assert all(store.read_record(path.stem) is not None for path in records)
    damage = verify(store)
    assert (damage.removed, damage.incomplete, damage.foreign) == ([], [], [])
