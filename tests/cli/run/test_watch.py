"""What `pano-mvs watch` shows of a run, and how it ends."""

from __future__ import annotations

import io
import os
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest

from pano_mvs.cli.console import Console
from pano_mvs.cli.watch_command import WatchDisplay, watch_run
from pano_mvs.core.errors import InputError
from pano_mvs.engine.planning.forecast import StageForecast
from pano_mvs.engine.running.events import StageStarted, UnitFailed, UnitFinished, UnitStarted, ignore
from pano_mvs.engine.running.output_lock import output_lock
from pano_mvs.session.progress import (
    BlockStarted,
    Event,
    EventLog,
    Forecast,
    RunFinished,
    RunStarted,
    TimeLeft,
    WorkersChanged,
)
from tests.cli.conftest import Command
from tests.engine.conftest import Toy, start, wait_for_records

NAMES = ("images", "depth")
FORECAST = Forecast((StageForecast("images", (), 0, 4, 1.0, 1e6), StageForecast("depth", ("images",), 0, 4, 10.0, 5e6)))


def started(folder: Path) -> RunStarted:
    return RunStarted("lobby", NAMES, "slurm", workers=6, threads=2, out=folder, cache=folder)


def log_in(folder: Path, *events: Event) -> EventLog:
    """Begin a log in a folder, with these events."""
    folder.mkdir(parents=True, exist_ok=True)
    log = EventLog(ignore)
    log.open(folder)
    for event in events:
        log(event)
    return log


class Watched:
    """A display of a folder, and what it shows."""

    def __init__(self, folder: Path) -> None:
        self.stream = io.StringIO()
        self.display = WatchDisplay(folder, Console(file=self.stream, width=160))

    def updated(self) -> str:
        """Return what is printed and what is shown after the new events."""
        self.display.update()
        self.display.console.print(self.display.live_lines())
        return self.stream.getvalue()

    def line(self) -> str:
        self.display.update()
        self.display.print_line()
        return self.stream.getvalue().splitlines()[-1]


def test_a_run_is_shown_as_in_its_own_terminal_with_workers_disk_and_range(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [0.0]
    monkeypatch.setattr("time.time", lambda: now[0])
    events: list[tuple[float, Event]] = [(1000, started(tmp_path)), (1000, FORECAST), (1000, StageStarted("images", 4))]
    events += [(1001 + i, UnitFinished("images", f"{i}", "run", 1.0)) for i in range(4)]
    events += [(1005, StageStarted("depth", 4)), (1005, WorkersChanged(2)), (1006, UnitStarted("depth", "0"))]
    events += [(1020, TimeLeft(500.0)), (1050, TimeLeft(60.0)), (1060, TimeLeft(20.0))]
    events += [(1060, UnitStarted("depth", "1")), (1080, UnitFailed("depth", "0", "too dark"))]
    events += [(1080, UnitFinished("depth", "0", "failed", 74.0))]
    log = log_in(tmp_path)
    for now[0], event in events:
        log(event)
    now[0] = 1090.0
    text = Watched(tmp_path).updated()
    assert f"lobby in {tmp_path}: slurm, 6 workers of 2 threads\n" in text
    assert "failed depth:0: too dark\n" in text
    assert re.search(r"depth +━+ +1 of 4  1:24  1\n", text)
    # The estimate of 1020 s belongs to the first half, and by that of 1060 s the run would have ended.
    assert re.search(r"all +[━╸╺]+ .* 1:30  about 1:0[89] left \(0:20 to 1:08\), until about \d\d:\d\d\n", text)
    assert "2 workers; " in text
    assert "free for the cache, about 15.0 MB still to come" in text
    assert "no event" not in text
    now[0] = 1680.0
    assert "no event for 10 min" in Watched(tmp_path).updated()
    log(RunFinished(0, ""))


@pytest.mark.parametrize(
    ("end", "said"),
    [
        (RunFinished(0, "", seconds=90.0), "finished (exit code 0) after 2 min"),
        (RunFinished(4, "the disk is full", seconds=5.0), "check (exit code 4) after 5 s: the disk is full"),
        (RunFinished(130, "interrupted", seconds=5.0), "interrupted (exit code 130) after 5 s"),
    ],
)
def test_watch_ends_with_the_run(end: RunFinished, said: str, tmp_path: Path) -> None:
    log = EventLog(ignore)
    log.open(tmp_path)
    for event in (started(tmp_path), FORECAST, end):
        log(event)
    stream = io.StringIO()
    assert watch_run(tmp_path, Console(file=stream, width=120)) == end.exit_code
    assert stream.getvalue().rstrip().endswith(said)


def test_run_in_blocks(tmp_path: Path) -> None:
    blocks = tmp_path / "blocks"
    log_in(blocks / "block_2", started(blocks / "block_2"), RunFinished(4, "too few matches"))  # of an earlier run
    time.sleep(0.01)  # times are in milliseconds
    log = log_in(blocks, BlockStarted("block_1", 1, 2, images=10, images_left=5))
    watched = Watched(blocks)
    assert watched.line() == "0 %, starting"
    assert watched.stream.getvalue().startswith("block 1 of 2, 10 images\n")

    first = log_in(blocks / "block_1", started(blocks / "block_1"), FORECAST, StageStarted("images", 4))
    # The block takes 1 s for its images, 10 s for its ranges, and the other one half of that.
    in_all = r"all blocks: about 0:1[6-9] left, if the later ones take as long"
    assert re.match(rf"0 %, about 1[01] s left .*; {in_all}; 6 workers", watched.line())

    first(RunFinished(3, "", seconds=60.0))
    assert "block_1: finished, but some items failed" in watched.updated()
    log(BlockStarted("block_2", 2, 2, images=5, images_left=0))
    assert watched.line() == "0 %, starting"
    assert "block 2 of 2, 5 images\n" in watched.stream.getvalue()

    log_in(blocks / "block_2", started(blocks / "block_2"), FORECAST, RunFinished(0, "", seconds=50.0))
    assert "all blocks" not in watched.line()
    assert "block_2: finished (exit code 0) after 50 s\n" in watched.stream.getvalue()
    assert "too few matches" not in watched.stream.getvalue()
    log(RunFinished(3, ""))
    watched.display.update()
    assert watched.display.end == RunFinished(3, "")


def test_watch_ends_with_the_run_in_blocks(tmp_path: Path) -> None:
    log = log_in(tmp_path / "blocks", BlockStarted("block_1", 1, 2, images=10, images_left=5))
    log_in(tmp_path / "blocks/block_1", started(tmp_path), RunFinished(4, "the disk is full", seconds=5.0))
    log(RunFinished(4, "", seconds=7.0))
    stream = io.StringIO()
    assert watch_run(tmp_path, Console(file=stream, width=120)) == 4
    assert stream.getvalue().startswith("block 1 of 2, 10 images\n")
    assert "check (exit code 4) after 5 s: the disk is full\n" in stream.getvalue()
    assert stream.getvalue().rstrip().endswith("check (exit code 4) after 7 s")
    # A run without blocks is the later one: one in blocks is refused in its folder.
    log_in(tmp_path, started(tmp_path), FORECAST, RunFinished(0, "", seconds=9.0))
    assert watch_run(tmp_path, Console(file=io.StringIO(), width=120)) == 0


def test_folder_without_a_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no run has begun in"):
        watch_run(tmp_path, Console(file=io.StringIO()))


@pytest.mark.skipif(os.name != "posix", reason="whether a process runs is known on POSIX")
def test_killed_run_is_noticed(tmp_path: Path) -> None:
    code = """
import os, sys
from pathlib import Path
from pano_mvs.engine.running.output_lock import output_lock
from pano_mvs.session.progress import EventLog
from pano_mvs.engine.running.events import Warned, ignore
log, out = EventLog(ignore), Path(sys.argv[1])
with output_lock(out):
    log.open(out)
    log(Warned("about to die"))
    os._exit(9)
"""
    subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=False)
    stream = io.StringIO()
    assert watch_run(tmp_path, Console(file=stream, width=120)) == 1
    assert "warning: about to die" in stream.getvalue()
    assert "the run was killed" in stream.getvalue()


@pytest.mark.slow
def test_watch_follows_a_run_from_another_process(toy: Toy) -> None:
    process = start(toy, "--executor", "processes", "--workers", "2", sleep_s=0.5)
    wait_for_records(toy, process, 1)
    watch = [sys.executable, "-m", "pano_mvs", "watch", str(toy.folder / "out")]
    done = subprocess.run(watch, capture_output=True, text=True, check=False)
    process.communicate()
    assert (done.returncode, done.stderr) == (0, "")
    assert re.search(r"^mean +5 run, ", done.stdout, re.MULTILINE)
    assert re.match(r"finished \(exit code 0\) after ", done.stdout.splitlines()[-1])


def test_refused_run_leaves_the_events_of_the_first(toy: Toy, pano_mvs: Command) -> None:
    arguments = ("run", toy.folder / "wf.yaml", "--executor", "serial", "--out", "lobby")
    assert pano_mvs(*arguments).code == 0
    before = Path("lobby/logs/events.jsonl").read_bytes()
    with output_lock(Path("lobby")):
        assert pano_mvs(*arguments).code == 4
    assert Path("lobby/logs/events.jsonl").read_bytes() == before
