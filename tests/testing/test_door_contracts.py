"""What is built in keeps the contracts of executors; what breaks those of other doors, too, is said."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from pano_mvs.core.doors import RunOption
from pano_mvs.core.errors import InputError, UsageError
from pano_mvs.engine.cache.store import Store
from pano_mvs.engine.executors.choose import ExecutorRequest, SerialExecutor, register_executor
from pano_mvs.engine.executors.protocol import Executor, Job, JobOutcome
from pano_mvs.geometry import Rigid3
from pano_mvs.io.readers import PosesRead, register_capture_reader, register_pose_reader
from pano_mvs.session.observers import ObservedRun, register_observer
from pano_mvs.session.progress import Event, Progress, RunFinished
from pano_mvs.testing.conformance import (
    ContractTest,
    command_contract_tests,
    executor_contract_tests,
    observer_contract_tests,
    reader_contract_tests,
)
from pano_mvs.testing.observer_contract import runs_of

KEPT = [
    *executor_contract_tests("serial"),
    *(pytest.param(one, marks=pytest.mark.slow) for one in executor_contract_tests("processes")),
]


@pytest.mark.parametrize("contract_test", KEPT, ids=str)
def test_executors_of_the_core_keep_their_contract(contract_test: ContractTest) -> None:
    contract_test.check()


def broken(tests: list[ContractTest]) -> dict[str, str]:
    """Return the messages of the contract tests that fail, by what they test."""
    found = {}
    for one in tests:
        try:
            one.check()
        except AssertionError as error:
            found[one.name.partition(" ")[2]] = str(error)
    return found


def test_events_of_runs_are_of_all_kinds() -> None:
    kinds = {type(event) for events in runs_of(Path()).values() for event in events}
    assert kinds == set(get_args(Event))


class Odd(SerialExecutor):
    """Breaks one part of its contract."""

    def __init__(self, store: Store, request: ExecutorRequest) -> None:
        super().__init__(store, threads=1)
        self.how = request.options["how"]
        if self.how == "describes itself":
            self.capacity = 0
        if self.how.startswith("leaves"):
            threading.Thread(target=time.sleep, args=(0.5,), daemon=True, name="lamp").start()

    def submit(self, job: Job) -> None:
        super().submit(job)
        self.kept = job

    def wait(self, timeout_s: float | None = None) -> tuple[int, JobOutcome] | None:
        if self.how.startswith("returns at once") and timeout_s == 0:
            time.sleep(0.3)
        ended = super().wait(timeout_s)
        if ended is not None and ended[1].status == "failed" and self.how.startswith("returns a unit"):
            return ended[0], JobOutcome("failed", cause="something")
        return ended

    def cancel(self) -> None:
        if not self.how.startswith("forgets"):
            super().cancel()


@pytest.mark.parametrize(
    "how",
    [
        "describes itself",
        "returns at once from wait with a timeout of 0",
        "returns a unit that fails as an outcome",
        "forgets jobs that are cancelled",
        "leaves no thread and no process",
    ],
)
def test_executors_that_break_their_contract_are_found(mine: Path, how: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pano_mvs.testing.executor_contract._END_S", 0.1)
    monkeypatch.setattr("pano_mvs.testing.executor_contract._AT_ONCE_S", 0.2)

    @register_executor("odd", options=(RunOption("how", "How.", "HOW"),))
    def odd(store: Store, request: ExecutorRequest) -> Executor:
        return Odd(store, request)

    (test,) = (one for one in executor_contract_tests("odd", options={"how": how}) if how in one.name)
    assert how in broken([test])


def test_an_executor_that_computes_something_else_is_found(mine: Path) -> None:
    class Lossy(SerialExecutor):
        def wait(self, timeout_s: float | None = None) -> tuple[int, JobOutcome] | None:
            ended = super().wait(timeout_s)
            if ended is not None and ended[0] % 2 and ended[1].status == "done":
                return ended[0], JobOutcome("failed", cause="lost")
            return ended

    @register_executor("lossy")
    def lossy(store: Store, request: ExecutorRequest) -> Executor:
        return Lossy(store)

    found = broken(executor_contract_tests("lossy"))
    assert {"computes the same bytes as the serial executor", "takes as many jobs at a time as its capacity"} & set(
        found
    )


@pytest.mark.parametrize(
    ("take", "what"),
    [
        (lambda event: print(event), "prints to the standard output"),
        (lambda event: event.stage, "has no attribute 'stage'"),
        (
            lambda event: vars(event)[event.kind] if isinstance(event, RunFinished) else None,
            "vars() argument must have __dict__",
        ),
    ],
)
def test_observers_that_break_their_contract_are_found(mine: Path, take: Callable[[Event], None], what: str) -> None:
    @register_observer("odd", help="Odd.")
    @contextmanager
    def odd(values: tuple[str, ...], run: ObservedRun) -> Iterator[Progress]:
        yield take

    found = broken(observer_contract_tests("odd"))
    assert found
    assert all(what in text for text in found.values())


def test_observers_that_take_an_option_of_the_command_or_leave_threads_are_found(
    mine: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pano_mvs.testing.observer_contract._PATIENCE_S", 0.1)

    @register_observer("workers", help="")
    @contextmanager
    def workers(values: tuple[str, ...], run: ObservedRun) -> Iterator[Progress]:
        threading.Thread(target=time.sleep, args=(1.0,), daemon=True, name="lamp").start()
        yield lambda event: None

    found = broken(observer_contract_tests("workers"))
    assert found["leaves no thread and no process"] == "workers leaves lamp running"
    assert found["describes its option"] == "the observer workers has no help"


REFLECTION = np.diag([1.0, 1.0, -1.0])
EXAMPLE = "MAP\na.jpg 1 2 3\nb.jpg 4 5 6\n"


def read_map(path: Path) -> PosesRead:
    """Read lines of a name and a position."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()[1:]
        places = {line.split()[0]: np.array([float(x) for x in line.split()[1:4]]) for line in lines}
    except (ValueError, IndexError) as error:
        raise InputError(f"{path}: {error}") from error
    if not all(place.shape == (3,) and np.isfinite(place).all() for place in places.values()):
        raise InputError(f"{path}: not a position")
    return PosesRead([{name: Rigid3.from_center(np.eye(3), place) for name, place in places.items()}])


def is_map(path: Path) -> bool:
    try:
        with path.open("rb") as stream:
            return stream.read(4) == b"MAP\n"
    except OSError:
        return False


def test_a_reader_keeps_its_contract(mine: Path) -> None:
    register_pose_reader("map", what="a map", recognises=is_map)(read_map)
    assert broken(reader_contract_tests("map", example=EXAMPLE)) == {}


def test_readers_that_break_their_contract_are_found(mine: Path) -> None:
    def always(path: Path) -> bool:
        return True

    def reflected(path: Path) -> PosesRead:
        return PosesRead([{"a.jpg": Rigid3(REFLECTION, np.zeros(3))}])

    def nameless(path: Path) -> PosesRead:
        raise InputError("no poses")

    register_pose_reader("reflected", what="a map", recognises=is_map)(reflected)
    found = broken(reader_contract_tests("reflected", example=EXAMPLE))
    assert found["reads its example"] == "the matrix of a.jpg is a reflection, not a rotation"
    register_pose_reader("nameless", what="a map", recognises=always)(nameless)
    found = broken(reader_contract_tests("nameless"))
    assert found["reads or rejects a binary file"].startswith("the error does not name the file")
    assert found["recognises no folder"].startswith("a folder is taken for a file of poses")
    register_capture_reader("album", what="an album", source="source.album")(always)
    assert broken(reader_contract_tests("album")) == {"names its stage": "there is no stage 'source.album'"}
    with pytest.raises(UsageError, match="there is no such reader"):
        reader_contract_tests("nothing")


COMMAND = '''\
from typing import Annotated

import typer

from pano_mvs.cli.commands import register_command


@register_command("{name}")
def mine({parameter}) -> None:
    """{doc}"""
    {body}
'''
NAMED = 'name: Annotated[str, typer.Argument(help="A name.")]'


@pytest.mark.parametrize(
    ("given", "test", "why"),
    [
        ({"name": "check"}, "has a place of its own", "pano-mvs check is built in: choose another name"),
        ({"name": "lamp.mine"}, "has a place of its own", "there is no group 'lamp' for the command lamp.mine"),
        ({"doc": ""}, "describes itself and its parameters", "mine has no docstring"),
        ({"parameter": "name: str"}, "describes itself and its parameters", "parameters of mine without help: name"),
        ({"body": "{}[name]"}, "ends with a message if its arguments cannot be used", "ends with an internal error"),
    ],
)
def test_commands_that_break_their_contract_are_found(mine: Path, given: dict[str, str], test: str, why: str) -> None:
    values = {"name": "mine", "parameter": NAMED, "doc": "Be mine.", "body": "print(name)"}
    (mine / "mine.py").write_text(COMMAND.format(**values | given))
    tests = [one for one in command_contract_tests(mine / "mine.py") if one.name.endswith(test)]
    assert why in broken(tests)[test]
    (mine / "mine.py").write_text(COMMAND.format(**values))
    assert broken([one for one in command_contract_tests(mine / "mine.py") if one.name.endswith(test)]) == {}


@pytest.mark.slow
def test_commands_that_load_large_libraries_for_their_help_are_found(mine: Path) -> None:
    text = COMMAND.format(name="mine", parameter=NAMED, doc="Be mine.", body="print(name)")
    (mine / "mine.py").write_text(text)
    tests = [one for one in command_contract_tests(mine / "mine.py") if "large" in one.name]
    assert broken(tests) == {}
    (mine / "mine.py").write_text(f"import dask\n{text}")
    (found,) = broken(tests).values()
    assert found == "the help of mine loads dask: import them where they are used"
