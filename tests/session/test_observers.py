"""Observers of plugins receive the events of a run, and none of them changes it."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import pytest

import pano_mvs
from pano_mvs.core.errors import InputError, PluginError, UsageError
from pano_mvs.engine.running.events import Warned
from pano_mvs.session.observers import OBSERVERS, MakeObserver, ObservedRun, Observers, observing, register_observer
from pano_mvs.session.progress import BlockStarted, Event, Progress, RunFinished, RunStarted, StageStarted
from pano_mvs.session.running import Execution, run_session
from tests.cli.conftest import Command
from tests.engine.conftest import Toy
from tests.plugin_packages import Packages

FILE = """\
import json
from contextlib import contextmanager
from pathlib import Path

from pano_mvs.session.observers import register_observer
from pano_mvs.session.progress import RunFinished

@register_observer("{name}", help="Write the kinds of events.", metavar="FILE")
@contextmanager
def kinds(values, run):
    seen = []
    def take(event):
        seen.append(event.kind)
        {then}
    yield take
    Path(values[-1]).write_text(json.dumps([len(values), run.out.name, *seen]))

@register_observer("{name}-flag", help="Do nothing.")
@contextmanager
def flag(values, run):
    yield lambda event: run.warn(f"flag has {{values}}") if event.kind == "run_started" else None
"""


class Recorder:
    """An observer that keeps what happens to it."""

    def __init__(self) -> None:
        self.seen: list[object] = []
        self.values: tuple[str, ...] = ()
        self.fails_at: type[Event] | None = None
        self.error: BaseException = ValueError("no\nmore")

    def made(self) -> MakeObserver:
        """Return what makes it."""
        return lambda values, run: self.listen(values, run)

    @contextmanager
    def listen(self, values: tuple[str, ...], run: ObservedRun) -> Iterator[Progress]:
        self.values, self.run = values, run
        yield self.take
        self.seen.append("closed")

    def take(self, event: Event) -> None:
        self.seen.append(event)
        if self.fails_at is not None and isinstance(event, self.fails_at):
            raise self.error

    @property
    def kinds(self) -> list[str]:
        return [getattr(one, "kind", "closed") for one in self.seen]


@pytest.fixture
def recorders(mine: Path) -> dict[str, Recorder]:
    """Three observers, the second of which may fail."""
    found = {name: Recorder() for name in ("first", "second", "third")}
    for name, recorder in found.items():
        register_observer(name, help="Record.")(recorder.made())
    return found


NONE: Mapping[str, Sequence[str]] = {"first": (), "second": (), "third": ()}


def run(toy: Toy, wanted: Mapping[str, Sequence[str]] = NONE, passed: list[Event] | None = None) -> int:
    """Run a toy capture with observers, and return the exit code."""
    session, progress = toy.session(), (lambda event: None) if passed is None else passed.append
    with observing(wanted, session.out) as observed:
        return run_session(session, Execution("serial", observers=observed), progress).summary.exit_code


def test_observers_receive_the_events_of_a_run_in_order(toy: Toy, recorders: dict[str, Recorder]) -> None:
    passed: list[Event] = []
    assert run(toy, passed=passed) == 0
    for recorder in recorders.values():
        assert recorder.seen == [*passed, "closed"]
        assert recorder.run.out == toy.folder / "out"
    assert isinstance(passed[0], RunStarted)
    assert isinstance(passed[-1], RunFinished)


def test_the_last_event_reaches_observers_first(toy: Toy, recorders: dict[str, Recorder]) -> None:
    """What they warn of then is reported before the end."""
    recorders["second"].fails_at = RunFinished
    passed: list[Event] = []
    assert run(toy, passed=passed) == 0
    (warned,) = (event for event in passed if isinstance(event, Warned))
    assert passed[-2:] == [warned, passed[-1]]
    assert isinstance(passed[-1], RunFinished)


@pytest.mark.parametrize("error", [ValueError("no\nmore"), SystemExit(3), BaseException()])
def test_an_observer_that_fails_is_dropped_with_one_warning(
    toy: Toy, recorders: dict[str, Recorder], error: BaseException
) -> None:
    recorders["second"].fails_at, recorders["second"].error = StageStarted, error
    passed: list[Event] = []
    assert run(toy, passed=passed) == 0
    warned = [event.text for event in passed if isinstance(event, Warned)]
    assert len(warned) == 1
    assert warned[0].startswith(f"the observer second ({__file__}) failed, and receives nothing more: ")
    assert type(error).__name__ in warned[0]
    assert "\n" not in warned[0]
    assert recorders["second"].kinds[-2:] == ["stage_started", "closed"]
    assert recorders["second"].kinds.count("stage_started") == 1
    for name in ("first", "third"):
        assert [event for event in recorders[name].seen if not isinstance(event, Warned)] == [
            *(event for event in passed if not isinstance(event, Warned)),
            "closed",
        ]


def test_an_observer_that_fails_when_it_is_closed_is_a_warning(toy: Toy, recorders: dict[str, Recorder]) -> None:
    """It ended a run that had finished as an internal error."""

    @register_observer("bad", help="Fail at the end.")
    @contextmanager
    def bad(values: tuple[str, ...], run: ObservedRun) -> Iterator[Progress]:
        yield lambda event: None
        raise OSError("the server is gone")

    passed: list[Event] = []
    assert run(toy, {"bad": (), "first": ()}, passed) == 0
    assert [event.text.partition(": ")[2] for event in passed if isinstance(event, Warned)] == [
        "OSError: the server is gone"
    ]
    assert recorders["first"].kinds[-2:] == ["run_finished", "closed"]


def test_errors_before_the_run_are_the_end_of_it(toy: Toy, recorders: dict[str, Recorder]) -> None:
    session = toy.session()
    with pytest.raises(UsageError, match="there is no executor"), observing(NONE, session.out) as observed:
        run_session(session, Execution("nothing", observers=observed))
    for recorder in recorders.values():
        (end, closed) = recorder.seen
        assert isinstance(end, RunFinished)
        assert (end.exit_code, end.out, closed) == (2, session.out, "closed")
        assert end.stopped.startswith("there is no executor 'nothing'")


@pytest.mark.parametrize(
    ("error", "code", "text"),
    [(KeyboardInterrupt(), 130, "interrupted"), (InputError("no images"), 2, "no images"), (ValueError("x"), 1, "x")],
)
def test_whatever_ends_a_run_ends_its_observers(
    recorders: dict[str, Recorder], tmp_path: Path, error: BaseException, code: int, text: str
) -> None:
    recorders["first"].fails_at = RunFinished
    with pytest.raises(type(error)), observing(NONE, tmp_path):
        raise error
    for recorder in recorders.values():
        assert recorder.seen == [RunFinished(code, text, out=tmp_path), "closed"]


def test_an_interrupt_during_a_run_is_its_end(toy: Toy, recorders: dict[str, Recorder]) -> None:
    recorders["second"].fails_at, recorders["second"].error = StageStarted, KeyboardInterrupt()
    with pytest.raises(KeyboardInterrupt):
        run(toy)
    for recorder in recorders.values():
        ends = [event for event in recorder.seen if isinstance(event, RunFinished)]
        assert [(end.exit_code, end.stopped) for end in ends] == [(130, "interrupted")]
        assert recorder.kinds[-2:] == ["run_finished", "closed"]


def test_an_observer_that_cannot_start_is_refused_and_the_others_learn_of_it(
    recorders: dict[str, Recorder], tmp_path: Path
) -> None:
    @register_observer("bad", help="Fail.", metavar="URL")
    @contextmanager
    def bad(values: tuple[str, ...], run: ObservedRun) -> Iterator[Progress]:
        if values == ("nowhere",):
            raise UsageError("--bad nowhere: must be somewhere")
        yield {}[values]  # type: ignore[index]

    with pytest.raises(UsageError, match="--bad nowhere"), observing({"first": (), "bad": ("nowhere",)}, tmp_path):
        raise AssertionError("the run begins")
    assert recorders["first"].seen == [RunFinished(2, "--bad nowhere: must be somewhere", out=tmp_path), "closed"]
    with (
        pytest.raises(PluginError, match=r"the observer bad \(.*\) cannot start: KeyError"),
        observing({"bad": ()}, tmp_path),
    ):
        raise AssertionError("the run begins")
    with pytest.raises(UsageError, match="there is no observer 'bell'"), observing({"bell": ()}, tmp_path):
        raise AssertionError("the run begins")


def test_values_of_options_reach_observers(toy: Toy, mine: Path, pano_mvs: Command) -> None:
    (mine / "kinds.py").write_text(FILE.format(name="kinds", then="pass"))
    arguments = ("run", toy.folder / "wf.yaml", "--executor", "serial", "--out", "lobby")
    result = pano_mvs(*arguments, "--kinds", "a.json", "--kinds", "b.json", "--kinds-flag")
    assert result.code == 0, result.text
    assert "flag has ()" in result.flat
    count, out, *kinds = json.loads(Path("b.json").read_text())
    assert (count, out, kinds[0], kinds[-1]) == (2, "lobby", "run_started", "run_finished")
    assert not Path("a.json").exists()
    text = pano_mvs("run", "--help").flat
    assert "Write the kinds of events." in text
    assert "--kinds-flag" in text
    assert pano_mvs(*arguments, "--dry-run", "--kinds", "c.json").code == 0
    assert not Path("c.json").exists()


def test_values_of_options_are_those_of_python_calls(toy: Toy, recorders: dict[str, Recorder]) -> None:
    made = pano_mvs.run(
        toy.folder / "wf.yaml",
        out=toy.folder / "out",
        executor="serial",
        observers={"first": (), "second": ["a", "b"]},
    )
    assert made.ok
    assert (recorders["first"].values, recorders["second"].values) == ((), ("a", "b"))
    assert recorders["first"].kinds[-2:] == ["run_finished", "closed"]
    assert recorders["third"].seen == []


def test_a_failure_does_not_change_the_exit_code(toy: Toy, mine: Path, pano_mvs: Command) -> None:
    (mine / "kinds.py").write_text(FILE.format(name="kinds", then="1 / 0"))
    toy.number("3.txt", "13")
    result = pano_mvs("run", toy.folder / "wf.yaml", "--executor", "serial", "--kinds", "a.json")
    assert result.code == 3
    assert result.flat.count("the observer kinds (") == 1
    assert "ZeroDivisionError: division by zero" in result.flat
    assert json.loads(Path("a.json").read_text())[2:] == ["run_started"]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["out", "json", "help", "workers", "class", "3d", "a.b", "kéy"])
def test_no_name_of_an_observer_breaks_the_command(toy: Toy, mine: Path, pano_mvs: Command, name: str) -> None:
    """Two options with one name, or one that cannot be a parameter of Python, ended every `run`."""
    (mine / "odd.py").write_text(FILE.format(name=name, then="pass"))
    result = pano_mvs("run", toy.folder / "wf.yaml", "--executor", "serial", "--out", "lobby", f"--{name}-flag")
    assert result.code == 0, result.text
    assert Path("lobby/run.json").is_file()
    assert "flag has ()" in result.flat


def test_a_broken_observer_affects_no_run(toy: Toy, mine: Path, packages: Packages, pano_mvs: Command) -> None:
    packages.add("dark", {"observers": {"dark": "dark:observer", "odd": "json:dumps"}}, dark="1 / 0\n")
    (mine / "a.py").write_text(FILE.format(name="kinds", then="pass"))
    (mine / "b.py").write_text(FILE.format(name="kinds", then="pass").replace("def ", "def other_"))
    arguments = ("run", toy.folder / "wf.yaml", "--executor", "serial")
    assert pano_mvs(*arguments).code == 0
    for option in ("--dark", "--odd", "--kinds-flag"):
        result = pano_mvs(*arguments, option)
        assert result.code == 2
        assert "No such option" in result.flat
    with pytest.raises(PluginError, match="ZeroDivisionError"):
        OBSERVERS.get("dark")


def test_the_end_of_a_block_is_not_the_end_of_the_run(recorders: dict[str, Recorder], tmp_path: Path) -> None:
    events: list[Event] = []
    for number in (1, 2):
        events += [
            BlockStarted(f"block_{number}", number, 2, images=3, images_left=0),
            RunFinished(0, "", out=tmp_path / "blocks" / f"block_{number}"),
        ]
    events.append(RunFinished(3, "", out=tmp_path))
    passed: list[Event] = []
    recorders["second"].fails_at = RunFinished
    with observing(NONE, tmp_path) as observed:
        for event in events[:-1]:
            observed.beside(passed.append)(event)
        assert "closed" not in recorders["first"].seen
        observed.beside(passed.append)(events[-1])
    assert recorders["first"].seen == recorders["third"].seen == [*events, "closed"]
    assert recorders["second"].seen == [*events[:2], "closed"]
    assert [event for event in passed if not isinstance(event, Warned)] == events


def test_an_error_between_blocks_is_the_end_of_the_run(recorders: dict[str, Recorder], tmp_path: Path) -> None:
    def run_blocks(observed: Observers) -> None:
        observed.beside(lambda event: None)(RunFinished(0, "", out=tmp_path / "blocks" / "block_1"))
        raise InputError("the blocks cannot be merged")

    with pytest.raises(InputError), observing({"first": ()}, tmp_path) as observed:
        run_blocks(observed)
    assert recorders["first"].seen[-2:] == [RunFinished(2, "the blocks cannot be merged", out=tmp_path), "closed"]


def test_files_that_have_changed_are_imported_again_by_the_next_run(mine: Path, toy: Toy) -> None:
    """As in a notebook, whose kernel goes on: what a file registers, and what the stages of another import."""
    file = mine / "kinds.py"
    wanted = {"kinds": (str(toy.folder / "first.json"),)}
    toy.edit("plug.py", lambda text: text.replace('"value", x.value', '"value", double(x.value)'))
    file.write_text(FILE.format(name="kinds", then="pass"))
    first = pano_mvs.run(toy.folder / "wf.yaml", out=toy.folder / "one", executor="serial", observers=wanted)
    file.write_text(FILE.format(name="kinds", then="pass").replace("[len(values), ", '["changed", '))
    toy.edit("helper.py", lambda text: f"{text}\n\ndef double(value):\n    return -2 * value\n")
    second = pano_mvs.run(toy.folder / "wf.yaml", out=toy.folder / "two", executor="serial", observers=wanted)
    assert json.loads((toy.folder / "first.json").read_text())[0] == "changed"
    values = [
        next(stage.metrics["value"] for stage in run.summary.stages if stage.name == "scaled")
        for run in (first, second)
    ]
    assert values[0]
    assert values[1] == -values[0]
