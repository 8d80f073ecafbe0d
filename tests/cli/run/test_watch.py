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
from pano_mvs.cli.watch_command import BlocksView, RunView, _updated, watch_run
from pano_mvs.core.errors import InputError
from pano_mvs.engine.planning.forecast import StageForecast
from pano_mvs.engine.running.events import StageStarted, UnitFailed, UnitFinished, UnitStarted, ignore
from pano_mvs.engine.running.output_lock import output_lock
from pano_mvs.session.progress import (
    BlockStarted,
    Event,
    EventLog,
    EventReader,
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


def text_of(view: RunView | BlocksView) -> str:
    stream = io.StringIO()
    Console(file=stream, width=120).print(view.shown())
    return stream.getvalue()


def test_view_of_a_run(tmp_path: Path) -> None:
    view = RunView(tmp_path, clock=lambda: 1090.0)
    events: list[tuple[float, Event]] = [(1000, started(tmp_path)), (1000, FORECAST), (1000, StageStarted("images", 4))]
    events += [(1001 + i, UnitFinished("images", f"{i}", "run", 1.0)) for i in range(4)]
    events += [(1005, StageStarted("depth", 4)), (1005, WorkersChanged(2)), (1006, UnitStarted("depth", "0"))]
    events += [
        (1020, TimeLeft(500.0)),
        (1050, TimeLeft(60.0)),
        (1060, TimeLeft(20.0)),
        (1060, UnitStarted("depth", "1")),
    ]
    events += [(1080, UnitFailed("depth", "0", "too dark")), (1080, UnitFinished("depth", "0", "failed", 74.0))]
    for at, event in events:
        view.take(at, event)
    text = text_of(view)
    assert "lobby in" in text
    assert "slurm, 2 workers of 2 threads, 1:30" in text
    assert re.search(r"images +━+ +4 of 4 ", text)
    assert re.search(r"depth +━+ +1 of 4 +1 +1 +1:24", text)
    # The estimate of 1020 s belongs to the first half, and by that of 1060 s the run would have ended.
    assert "about 1:08 left (0:20 to 1:08), until about " in text
    assert "free for the cache, about 15 MB still to come" in text
    assert "failed depth:0: too dark" in text
    assert "no event" not in text
    assert "no event for 10 min" in text_of_later(view, 1680.0)


def text_of_later(view: RunView, now: float) -> str:
    view._clock = lambda: now
    return text_of(view)


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
    assert "left" not in stream.getvalue()


def log_in(folder: Path, *events: Event) -> EventLog:
    """Begin a log in a folder, with these events."""
    folder.mkdir(parents=True, exist_ok=True)
    log = EventLog(ignore)
    log.open(folder)
    for event in events:
        log(event)
    return log


def test_view_of_a_run_in_blocks(tmp_path: Path) -> None:
    blocks = tmp_path / "blocks"
    log_in(blocks / "block_2", started(blocks / "block_2"), RunFinished(4, "too few matches"))  # of an earlier run
    time.sleep(0.01)  # times are in milliseconds
    log = log_in(blocks, BlockStarted("block_1", 1, 2, images=10, images_left=5))
    reader = EventReader(blocks)
    view = _updated(BlocksView(blocks), reader)
    assert view.left_text() == "block 1 of 2, 10 images; starting"

    first = log_in(blocks / "block_1", started(blocks / "block_1"), FORECAST, StageStarted("images", 4))
    view = _updated(view, reader)
    # The block takes 1 s for its images, 10 s for its ranges, and the other one half of that.
    in_all = r"all blocks: about 0:1[6-9] left, if the later ones take as long"
    assert re.fullmatch(rf"block 1 of 2, 10 images; 0 %, about 0:1[01] left .*; {in_all}", view.left_text())
    assert re.search(rf"^block 1 of 2.*images +0 of 4 .*{in_all}\n$", text_of(view), re.DOTALL)

    first(RunFinished(3, "", seconds=60.0))
    assert "block_1: finished, but some items failed" in text_of(_updated(view, reader))
    log(BlockStarted("block_2", 2, 2, images=5, images_left=0))
    view = _updated(view, reader)
    assert view.left_text() == "block 2 of 2, 5 images; starting"
    assert "too few matches" not in text_of(view)

    second = log_in(blocks / "block_2", started(blocks / "block_2"), FORECAST)
    view = _updated(view, reader)
    assert re.fullmatch(r"block 2 of 2, 5 images; 0 %, about .*", view.left_text())
    assert "all blocks" not in view.left_text()
    second(RunFinished(0, "", seconds=50.0))
    assert _updated(view, reader).left_text().endswith("; all blocks have run")
    log(RunFinished(3, ""))
    assert "all blocks" not in text_of(_updated(view, reader))


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
    first, *_ = done.stdout.splitlines()
    assert re.match(r"\d+ %, ", first)
    assert re.search(r"mean +━+ +5 of 5 ", done.stdout)
    assert re.match(r"finished \(exit code 0\) after ", done.stdout.splitlines()[-1])


def test_refused_run_leaves_the_events_of_the_first(toy: Toy, pano_mvs: Command) -> None:
    arguments = ("run", toy.folder / "wf.yaml", "--executor", "serial", "--out", "lobby")
    assert pano_mvs(*arguments).code == 0
    before = Path("lobby/logs/events.jsonl").read_bytes()
    with output_lock(Path("lobby")):
        assert pano_mvs(*arguments).code == 4
    assert Path("lobby/logs/events.jsonl").read_bytes() == before
