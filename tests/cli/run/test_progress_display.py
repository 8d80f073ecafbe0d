"""What is shown while a run goes on, by a clock that is moved by hand.

What `run` prints at its end.
"""

from __future__ import annotations

import io
import os
import threading
from pathlib import Path

import pytest

from pano_mvs.cli.console import Console
from pano_mvs.cli.run.printing import print_scores, print_summary
from pano_mvs.cli.run.progress import ProgressDisplay, _Repeated
from pano_mvs.engine.planning.forecast import StageForecast
from pano_mvs.engine.running.events import StageFinished, StageStarted, UnitFailed, UnitFinished, UnitStarted, Warned
from pano_mvs.results.records import ScoresSummary
from pano_mvs.results.run_output import RunOutput
from pano_mvs.results.stored_values import StoredValues
from pano_mvs.results.summary import RunSummary
from pano_mvs.session.progress import Event, Forecast, KernelsCompiled, RunStarted
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


def test_the_time_left_is_never_missing_and_never_stands_still() -> None:
    shown = Shown(is_terminal=True)
    shown.events(STARTED, Forecast((StageForecast("depth"), StageForecast("cloud", ("depth",)))))
    assert shown.live(5.0)[-1].endswith("time left not known yet: no earlier run has computed depth, cloud")
    shown.events(StageStarted("depth", 4), UnitStarted("depth", "a.jpg"))
    lines = [shown.live(10.0)[-1] for _ in range(30)]
    assert all("more than" in line and line.endswith("left; not known: cloud") for line in lines)
    assert len(set(lines)) == len(lines)


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


def test_lines_are_repeated_by_a_thread_until_the_run_ends() -> None:
    calls: list[int] = []
    ended = threading.Event()

    def call() -> None:
        calls.append(1)
        if len(calls) == 3:
            ended.set()

    with _Repeated(call, first_s=0.0, every_s=0.0):
        assert ended.wait(60)
    count = len(calls)
    assert count >= 3


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
