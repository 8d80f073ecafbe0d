"""The contract of observers that plugins bring.

An observer must
  * describe the option that switches it on, which is not one of `pano-mvs run` itself;
  * accept the events of every run: one that finishes, fails, is interrupted, starts over, or did not begin, and blocks;
  * print nothing to the standard output, which belongs to the results of commands;
  * leave no thread and no process when its context is closed.
"""

from __future__ import annotations

import io
import multiprocessing
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import redirect_stdout
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

from typer.main import get_command

from pano_mvs.results.records import Verdict
from pano_mvs.session.observers import OBSERVERS, observing
from pano_mvs.session.progress import (
    BlockStarted,
    Divided,
    Event,
    Forecast,
    KernelsCompiled,
    RunFinished,
    RunStarted,
    StageFinished,
    StageStarted,
    TimeLeft,
    UnitFailed,
    UnitFinished,
    UnitStarted,
    Warned,
    WorkersChanged,
)
from pano_mvs.testing.contract import ContractTest, registered_names

_PATIENCE_S = 10.0


def observer_contract_tests(observer: Path | str, *, values: Sequence[str] = ()) -> list[ContractTest]:
    """Return the contract tests of an observer, given by name, or of all observers of a plugin file.

    Args:
        values: of its option; `{folder}` in a value stands for an empty folder. By default "{folder}/value" if the
            option has a value.

    Raises:
        UsageError: if the file registers no observer.
        PluginError: if the file cannot be loaded.
    """
    return [
        found
        for name in registered_names("observer", observer)
        for found in (
            ContractTest(f"{name} describes its option", partial(_describes_itself, name)),
            *(
                ContractTest(f"{name} accepts the events of {what}", partial(_accepts, name, what, values=values))
                for what in runs_of(Path())
            ),
            ContractTest(f"{name} leaves no thread and no process", partial(_leaves_nothing, name, values=values)),
        )
    ]


def runs_of(out: Path) -> Mapping[str, Sequence[Event]]:
    """Return the events of runs of every kind, by what kind of run it is; together they have all kinds of events."""
    began = RunStarted("tiny", ("images", "depth"), "processes", 2, 1, out=out, cache=out / ".pano-mvs")
    forecast = Forecast((), report_s=1.0, compiles=True)
    reading = (
        StageStarted("images", 2),
        UnitStarted("images", "a.png"),
        UnitStarted("images", "b.png"),
        UnitFinished("images", "a.png", "run", 0.5),
        UnitFinished("images", "b.png", "cached", 0.0),
        StageFinished("images", "source.folder", units=2, run=1, cached=1, metrics={"megapixels": 8.0}),
    )
    failing = (
        StageStarted("depth", 2),
        UnitStarted("depth", "a.png"),
        UnitFailed("depth", "a.png", "too dark [/red] \x1b", "no range map", trace="Traceback"),
        UnitFinished("depth", "a.png", "failed", 0.1),
        UnitFinished("depth", "b.png", "blocked", 0.0),
        StageFinished("depth", "depth.sweep", units=2, failed=1, blocked=1),
    )
    others = (TimeLeft(3.0), KernelsCompiled(2, 1.5), WorkersChanged(1), Warned("the disk is almost full"))
    verdict = Verdict("good", "finished", "The result is reliable.", "2 images were read.", (), ())
    end = RunFinished(0, "", run=1, cached=1, seconds=1.5, out=out, verdict=verdict)
    failed = RunFinished(3, "", run=1, failed=1, blocked=1, out=out, verdict=verdict, doubts={"b.png": "it is blurred"})
    interrupted = RunFinished(130, "interrupted", out=out)
    block = out / "blocks" / "block_1"
    return {
        "a run that finishes": (began, forecast, *reading, *others, end),
        "a run with failures": (began, *reading, *failing, failed),
        "a run in which stages overlap": (began, reading[0], failing[0], *failing[1:], *reading[1:], failed),
        "a run that starts over": (began, *reading, StageStarted("images", 2), *reading[1:], end),
        "a run that is interrupted": (began, *reading[:3], interrupted),
        "an interrupt before the run": (interrupted,),
        "an error before the run": (RunFinished(2, "there is no executor 'x'", out=out),),
        "a run in blocks": (
            Divided("it needs 80 GB of memory"),
            BlockStarted("block_1", 1, 1, images=2, images_left=0),
            RunStarted("tiny", ("images",), "serial", 1, 1, out=block),
            *reading,
            RunFinished(0, "", run=1, out=block, verdict=verdict),
            failed,
        ),
    }


def _describes_itself(name: str) -> None:
    from pano_mvs.cli.app import app

    option = OBSERVERS.get(name).option(name)
    assert option.help, f"the observer {name} has no help"
    command = vars(get_command(app))["commands"]["run"]
    own = {text for parameter in command.params for text in parameter.opts} | {"--help"}
    assert f"--{name}" not in own, f"--{name} is an option of `pano-mvs run` itself: choose another name"


def _observed(name: str, what: str, folder: Path, *, values: Sequence[str]) -> list[str]:
    """Pass the events of a run to an observer, and return its warnings."""
    given = [value.replace("{folder}", str(folder)) for value in values]
    if not given and OBSERVERS.get(name).metavar:
        given = [str(folder / "value")]
    out = folder / "out"
    out.mkdir()
    passed: list[Event] = []
    events = runs_of(out)[what]
    with observing({name: given}, out) as observers:
        report = observers.beside(passed.append)
        for event in events:
            report(event)
    return [event.text for event in passed if isinstance(event, Warned) and event not in events]


def _accepts(name: str, what: str, *, values: Sequence[str]) -> None:
    printed = io.StringIO()
    with TemporaryDirectory() as folder, redirect_stdout(printed):
        warnings = _observed(name, what, Path(folder), values=values)
    failures = [text for text in warnings if text.startswith(f"the observer {name} (")]
    assert not failures, failures[0]
    assert not printed.getvalue(), f"{name} prints to the standard output: {printed.getvalue()[:200]!r}"


def _leaves_nothing(name: str, *, values: Sequence[str]) -> None:
    before = set[threading.Thread]()
    for _ in range(2):  # after the first, a library may keep threads that later runs share; they do not become more
        before = set(threading.enumerate())
        with TemporaryDirectory() as folder, redirect_stdout(io.StringIO()):
            _observed(name, "a run that finishes", Path(folder), values=values)
    deadline = time.monotonic() + _PATIENCE_S
    while (left := _left(before)) and time.monotonic() < deadline:
        time.sleep(0.01)
    assert not left, f"{name} leaves {', '.join(left)} running"


def _left(before: set[threading.Thread]) -> list[str]:
    threads = [thread.name for thread in threading.enumerate() if thread not in before]
    return [*threads, *(child.name for child in multiprocessing.active_children())]
