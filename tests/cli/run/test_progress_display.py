"""What is shown while a run goes on, in its own terminal and by `watch`."""

from __future__ import annotations

import io
import os
import re
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import pytest

from pano_mvs.cli.console import Console
from pano_mvs.cli.run.printing import print_scores, print_summary
from pano_mvs.cli.run.progress import ProgressDisplay
from pano_mvs.cli.watch_command import WatchDisplay, watch_run
from pano_mvs.core.errors import InputError
from pano_mvs.engine.planning.forecast import StageForecast
from pano_mvs.engine.running.events import (
    StageFinished,
    StageStarted,
    UnitFailed,
    UnitFinished,
    UnitStarted,
    Warned,
    ignore,
)
from pano_mvs.engine.running.output_lock import output_lock
from pano_mvs.results.records import ScoresSummary
from pano_mvs.results.run_output import RunOutput
from pano_mvs.results.stored_values import StoredValues
from pano_mvs.results.summary import RunSummary
from pano_mvs.session.progress import (
    BlockStarted,
    Event,
    EventLog,
    Forecast,
    KernelsCompiled,
    RunFinished,
    RunStarted,
    TimeLeft,
    WorkersChanged,
    event_from_line,
    line_from_event,
)
from tests.cli.conftest import Command
from tests.engine.conftest import Toy, start, wait_for_records
from tests.session.test_time_estimator import Clock

STARTED = RunStarted("w", ("depth", "cloud"), "processes", workers=1, threads=1, out=Path("out"))
FORECAST = Forecast(
    (StageForecast("depth", (), 0, 4, 30.0, 1.0), StageForecast("cloud", ("depth",), 0, 1, 60.0, 1.0)), report_s=3.0
)


class Shown:
    """A display, its clock, and what it has printed."""

    def __init__(self, *, is_terminal: bool = False) -> None:
        self.stream = io.StringIO()
        self.console = Console(file=self.stream, width=120, force_terminal=is_terminal, no_color=True)
        self.clock = Clock()
        self.display = ProgressDisplay(self.console, self.clock)

    def events(self, *events: Event) -> None:
        for event in events:
            self.display(event)

    def live(self, after_s: float = 0.0) -> list[str]:
        self.clock.now += after_s
        with self.console.capture() as captured:
            self.console.print(self.display.live_lines())
        return [line.rstrip() for line in captured.get().splitlines() if line.strip()]

    def line(self, after_s: float = 0.0) -> str:
        self.clock.now += after_s
        self.display.print_line()
        return self.stream.getvalue().splitlines()[-1]


def finished(stage: str, units: int = 1) -> StageFinished:
    return StageFinished(stage, "x", units, units, 0, 0, 0, 12.34, 12.34, {})


def test_the_live_lines_show_what_is_computed_and_count_down() -> None:
    shown = Shown(is_terminal=True)
    assert "starting" in shown.live()[-1]
    shown.events(STARTED)
    assert "looking for copies" in shown.live()[-1]
    shown.events(FORECAST, StageStarted("depth", 4), UnitStarted("depth", "a.jpg"))
    depth, whole = shown.live(1.0)
    assert depth.split() == ["depth", "0", "of", "4", "0:01", "a.jpg"]
    assert whole.endswith("1 %  0:01  about 3:02 left")
    assert [shown.live(1.0)[-1].split()[-2] for _ in range(5)] == ["3:01", "3:00", "2:59", "2:58", "2:57"]


def test_stages_are_shown_with_their_group_as_in_plans_and_reports() -> None:
    """A plan listed `sweep`, and the run only `depth`."""
    shown = Shown(is_terminal=True)
    grouped = replace(STARTED, groups={"depth": "sweep"})
    units = [UnitStarted("depth", "a.jpg"), UnitStarted("cloud", "")]
    shown.events(grouped, FORECAST, StageStarted("depth", 4), StageStarted("cloud", 1), *units)
    rows = [line.split() for line in shown.live(1.0)]
    assert rows[0] == ["depth", "sweep", "0", "of", "4", "0:01", "a.jpg"]
    assert rows[1] == ["cloud", "0", "of", "1", "0:01"]
    assert shown.line().endswith("(now: sweep: depth 0 of 4, cloud 0 of 1)")
    assert (event_from_line(line_from_event(grouped)) or ())[1:] == (grouped,)
    shown.events(STARTED, UnitStarted("depth", "a.jpg"))
    assert "sweep" not in "".join(shown.live())


def test_the_time_left_is_never_missing_and_never_stands_still() -> None:
    shown = Shown(is_terminal=True)
    shown.events(STARTED, Forecast((StageForecast("depth"), StageForecast("cloud", ("depth",)))))
    assert shown.live(5.0)[-1].endswith("time left not known yet: no earlier run has computed depth, cloud")
    shown.events(StageStarted("depth", 4), UnitStarted("depth", "a.jpg"))
    lines = [shown.live(10.0)[-1] for _ in range(30)]
    assert all("more than" in line and line.endswith("left; not known: cloud") for line in lines)
    assert len(set(lines)) == len(lines)


def test_kernels_that_are_not_compiled_yet_are_no_part_of_the_time_left() -> None:
    """A first run said "about 8 s left" for 138 s."""
    shown = Shown(is_terminal=True)
    shown.events(STARTED, replace(FORECAST, compiles=True), StageStarted("depth", 4), UnitStarted("depth", "a.jpg"))
    assert shown.live(1.0)[-1].endswith("more than 3:02 left; not known: the time to compile kernels (once)")
    short = Forecast((StageForecast("depth", (), 0, 1, 0.1, 1.0),), compiles=True)
    shown.events(STARTED, short)
    assert shown.live()[-1].endswith("time left not known yet: the time to compile kernels (once)")


def test_nothing_is_left_but_the_report_once_all_stages_are_finished() -> None:
    shown = Shown(is_terminal=True)
    shown.events(STARTED, FORECAST, StageStarted("depth", 1), finished("depth"), finished("cloud"))
    assert shown.live()[-1].endswith("about 0:03 left (writing the report)")
    assert shown.live(1.0)[-1].endswith("about 0:02 left (writing the report)")


def test_few_lines_are_shown_however_many_stages_and_units_there_are() -> None:
    shown = Shown(is_terminal=True)
    names = tuple(f"stage{number}" for number in range(10))
    shown.events(RunStarted("w", names, "processes", workers=40, threads=1, out=Path("out")))
    for name in names:
        shown.events(StageStarted(name, 9), *(UnitStarted(name, f"{number}.jpg") for number in range(4)))
    lines = shown.live(1.0)
    assert len(lines) == 6 + 1 + 1
    assert lines[0].endswith("0.jpg, 1.jpg and 2 more")
    assert lines[6] == "… and 4 more"


def test_a_line_states_share_time_left_and_the_stages_at_work() -> None:
    shown = Shown()
    shown.events(STARTED, FORECAST, StageStarted("depth", 4), UnitStarted("depth", "a.jpg"))
    assert shown.line(10.0) == "5 %, about 3 min left (now: depth 0 of 4)"
    shown.events(UnitFinished("depth", "a.jpg", "run", 30.0))
    assert shown.line().startswith("16 %, about 3 min left")


@pytest.mark.parametrize("is_terminal", [False, True])
def test_compilation_is_shown_while_it_takes_place(is_terminal: bool) -> None:
    shown = Shown(is_terminal=is_terminal)
    shown.events(STARTED, FORECAST, StageStarted("depth", 4), UnitStarted("depth", "a"), KernelsCompiled(12, 1.0))
    assert "compiling kernels (once): 12 so far" in (shown.line(1.0) if not is_terminal else "\n".join(shown.live(1.0)))
    assert "compiling" not in (shown.line(60.0) if not is_terminal else "\n".join(shown.live(60.0)))


def test_finished_stages_failures_and_warnings_stay() -> None:
    shown = Shown()
    shown.events(
        STARTED,
        StageStarted("depth", 1),
        UnitFailed("depth", "a[b].jpg", "no light", said=("first", "[red]last")),
        Warned("[x] is odd"),
        StageFinished("depth", "x", 4, 1, 1, 1, 1, 12.34, 12.34, {}),
    )
    lines = shown.stream.getvalue().splitlines()
    assert lines == [
        "failed depth:a[b].jpg: no light",
        "  | first",
        "  | [red]last",
        "warning: [x] is odd",
        "depth          1 run, 1 cached, 1 failed, 1 blocked  12.3 s",
    ]


def test_names_cannot_break_lines() -> None:
    shown = Shown(is_terminal=True)
    shown.events(STARTED, FORECAST, StageStarted("depth", 4), UnitStarted("depth", "a\n\x1b[31m.jpg"))
    assert shown.live(1.0)[0].endswith(r"a\x0a\x1b[31m.jpg")


@pytest.mark.parametrize("is_terminal", [True, False])
def test_drawing_ends_with_the_run(is_terminal: bool) -> None:
    shown = Shown(is_terminal=is_terminal)
    with shown.display:
        shown.events(STARTED, FORECAST, StageStarted("depth", 4))
    size = len(shown.stream.getvalue())
    shown.clock.now += 1
    assert len(shown.stream.getvalue()) == size
    assert (size > 0) == is_terminal


def test_lines_are_repeated_by_a_thread_until_the_run_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    shown, calls = Shown(is_terminal=False), threading.Semaphore(0)
    monkeypatch.setattr(shown.display, "print_line", calls.release)
    monkeypatch.setattr("threading.Event.wait", lambda ended, timeout=None: ended.is_set())
    with shown.display:
        assert all(calls.acquire(timeout=60) for _ in range(3))


def test_lines_do_not_end_up_in_what_a_unit_printed(tmp_path: Path) -> None:
    """With executor `serial`, the output of a unit is captured by redirecting the file that the lines go to."""
    shown, log = tmp_path / "shown", tmp_path / "log"
    with shown.open("w") as stream, log.open("w") as unit:
        display = ProgressDisplay(Console(file=stream, width=80))
        with display:
            os.dup2(unit.fileno(), stream.fileno())
            display.print_line()
        assert display.console.file is stream
    assert "starting" in shown.read_text()
    assert log.read_text() == ""


def test_scores_of_poses_of_which_no_pair_can_be_measured() -> None:
    scores = ScoresSummary(poses={"registered": 2, "of": 6, "registered_in_one_frame": 1, "auc_5_deg": 0.0})
    stream = io.StringIO()
    print_scores(scores, Console(file=stream, width=200))
    assert stream.getvalue() == "against the ground truth: 2 of 6 registered (1 in one frame), no pair to measure\n"


def test_one_of_anything_is_not_named_as_several(tmp_path: Path) -> None:
    summary = RunSummary.from_json(
        {
            "units": {"run": 1},
            "seconds": 1.0,
            "left_over": {"a": "0"},
            "files": {"b": "1"},
            "poses": {"registered": ["a"], "points": 1, "scale": "none"},
        }
    )
    stream = io.StringIO()
    print_summary(RunOutput(tmp_path, summary, StoredValues(), written=("b",)), Console(file=stream, width=200))
    for words in (
        "1 unit computed, 0 cached",
        "1 file of an earlier run, which this run did not write, is still",
        "1 point; scale",
        "(1 file, 1 written now)",
    ):
        assert words in stream.getvalue()


NAMES = ("images", "depth")
WATCHED = Forecast((StageForecast("images", (), 0, 4, 1.0, 1e6), StageForecast("depth", ("images",), 0, 4, 10.0, 5e6)))


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
    events: list[tuple[float, Event]] = [
        (1000, started(tmp_path)),
        (1000, WATCHED),
        (1000, StageStarted("images", 4)),
    ]
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
        (RunFinished(0, "", seconds=90.0), "finished (exit code 0) after 90 s"),
        (RunFinished(4, "the disk is full", seconds=5.0), "check (exit code 4) after 5 s: the disk is full"),
        (RunFinished(130, "interrupted", seconds=5.0), "interrupted (exit code 130) after 5 s"),
    ],
)
def test_watch_ends_with_the_run(end: RunFinished, said: str, tmp_path: Path) -> None:
    log = EventLog(ignore)
    log.open(tmp_path)
    for event in (started(tmp_path), WATCHED, end):
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

    first = log_in(blocks / "block_1", started(blocks / "block_1"), WATCHED, StageStarted("images", 4))
    # The block takes 1 s for its images, 10 s for its ranges, and the other one half of that.
    in_all = r"all blocks: about 0:1[6-9] left, if the later ones take as long"
    assert re.match(rf"0 %, about 1[01] s left .*; {in_all}; 6 workers", watched.line())

    first(RunFinished(3, "", seconds=60.0))
    assert "block_1: finished, but some items failed" in watched.updated()
    log(BlockStarted("block_2", 2, 2, images=5, images_left=0))
    assert watched.line() == "0 %, starting"
    assert "block 2 of 2, 5 images\n" in watched.stream.getvalue()

    log_in(blocks / "block_2", started(blocks / "block_2"), WATCHED, RunFinished(0, "", seconds=50.0))
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
    log_in(tmp_path, started(tmp_path), WATCHED, RunFinished(0, "", seconds=9.0))
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
