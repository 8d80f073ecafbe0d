"""Workers are forked by a process that has loaded the stages; where that is impossible, they start by themselves."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from pano_mvs.engine.cache.store import Store
from pano_mvs.engine.executors import fork_server
from pano_mvs.engine.executors.choose import SerialExecutor
from pano_mvs.engine.executors.fork_server import ForkedProcess, ForkServer
from pano_mvs.engine.executors.processes import ProcessExecutor
from tests.engine.conftest import Toy, ran
from tests.engine.running.test_executors import files_below, run_with, told, two_processes
from tests.engine.running.test_isolation import ended
from tests.engine.running.test_run import ALL_UNITS

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="workers are forked on Linux only")


def parents_of_units(toy: Toy) -> set[str]:
    """Run with two processes; return the parents of those that computed units."""
    pids = toy.folder / "pids"
    toy.begin(f'open({str(pids)!r}, "a").write(f"{{os.getppid()}} ")')
    assert ran(run_with(toy, two_processes)) == ALL_UNITS
    return set(pids.read_text().split())


def test_all_workers_have_one_parent_which_is_not_this_process(toy: Toy) -> None:
    assert len(parents := parents_of_units(toy)) == 1
    assert str(os.getpid()) not in parents


@pytest.mark.slow
@pytest.mark.parametrize("way", ["threads", "elsewhere", "broken"])
def test_workers_start_by_themselves_where_none_can_be_forked(
    toy: Toy, way: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A fork of a process with threads may wait for ever for a lock that another thread held."""
    clean = run_with(toy, SerialExecutor, name="clean")
    if way == "elsewhere":
        monkeypatch.setattr(ForkServer, "available", False)
    else:
        first = {
            "threads": "import threading, time; threading.Thread(target=time.sleep, args=(600,), daemon=True).start()",
            "broken": "raise SystemExit(3)",
        }[way]
        monkeypatch.setattr(fork_server, "_BOOT", f"{first}; {fork_server._BOOT}")
    assert parents_of_units(toy) == {str(os.getpid())}
    result = run_with(toy, two_processes, name="y")
    assert told(result) == told(clean)
    assert files_below(toy.folder / "out-y") == files_below(toy.folder / "out-clean")


@contextmanager
def forked(server: ForkServer, folder: Path) -> Iterator[ForkedProcess]:
    process = server.fork("mark", folder / "errors.txt")
    assert process is not None
    assert process.stdin is not None
    assert process.stdout is not None
    with process.stdin, process.stdout:
        yield process


def test_the_end_of_a_forked_process_is_told(tmp_path: Path) -> None:
    server = ForkServer(1)
    try:
        with forked(server, tmp_path) as idle, forked(server, tmp_path) as killed:
            assert idle.poll() is killed.poll() is None
            with pytest.raises(subprocess.TimeoutExpired):
                idle.wait(0.01)
            killed.kill()
            assert killed.wait(20) == -signal.SIGKILL
        assert idle.wait(20) == -signal.SIGKILL  # when its input is closed, it ends itself and all that it started
    finally:
        server.close()


def test_workers_end_with_their_server(tmp_path: Path) -> None:
    server = ForkServer(1)
    with forked(server, tmp_path) as process:
        assert server._process is not None
        server._process.kill()
        assert process.wait(20) == -signal.SIGKILL
    assert server.fork("mark", tmp_path / "errors.txt") is None
    server.close()
    server.close()


def test_a_run_goes_on_without_its_server(toy: Toy) -> None:
    marker = toy.folder / "killed"
    toy.begin(f"""if x.value == 20 and not os.path.exists({str(marker)!r}):
    open({str(marker)!r}, "w").close()
    os.kill(os.getppid(), 9)
    time.sleep(600)""")
    result = run_with(toy, two_processes)
    assert all("its worker process died" in failure.cause for failure in result.failures)
    assert result.stages[-1].units


@pytest.mark.slow
def test_what_a_killed_worker_leaves_behind_ends_before_the_unit_fails(toy: Toy) -> None:
    """Its own children are found below it, those that it forked twice only by who adopts them."""
    pids = toy.folder / "pids"
    toy.begin(f"""if x.value == 20:
    if os.fork() == 0:
        os.setsid()
        if os.fork() == 0:
            open({str(pids)!r}, "a").write(f"{{os.getpid()}} ")
            time.sleep(600)
        os._exit(0)
    while not os.path.exists({str(pids)!r}): time.sleep(0.01)
    os.kill(os.getpid(), 9)""")
    result = run_with(toy, lambda store: ProcessExecutor(store, workers=1, threads=1))
    assert ["killed by SIGKILL" in failure.cause for failure in result.failures][:1] == [True]
    assert ended(pids)


def test_nothing_is_started_for_a_run_without_units(tmp_path: Path) -> None:
    started = time.monotonic()
    executor = ProcessExecutor(Store(tmp_path), workers=2, threads=1)
    assert executor._forks._process is None
    executor.close()
    assert time.monotonic() - started < 60
