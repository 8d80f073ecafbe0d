"""The contract of executors that plugins bring.

An executor must
  * state its name, its capacity and its threads;
  * compute all units of a workflow with the same bytes as the executor `serial`, and take `capacity` jobs at a time;
  * return at once from `wait` with a timeout of 0;
  * return a unit that fails as an outcome, and not raise its error;
  * forget all jobs on `cancel`, and leave no thread and no process after `close`.
"""

from __future__ import annotations

import json
import multiprocessing
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache, partial
from pathlib import Path
from shutil import copytree
from tempfile import TemporaryDirectory

from pano_mvs.core.paths import below
from pano_mvs.engine.cache.store import Store
from pano_mvs.engine.executors.choose import ExecutorRequest, SerialExecutor, make_executor
from pano_mvs.engine.executors.protocol import Executor, Job, JobOutcome
from pano_mvs.engine.running.run import Run
from pano_mvs.session.session import open_session
from pano_mvs.testing.contract import ContractTest, registered_names
from pano_mvs.testing.tiny_capture import Variant, tiny_capture

_WORKFLOW = """\
pano_mvs: 1
name: tiny
stages:
  images:   {use: source.folder, path: images}
  features: {use: features.orb_tangent, max_keypoints: 20}
  pairs:    {use: pairs.sequential, window: 1}
"""
_BROKEN = "broken.png"  # an image that cannot be read
_PATIENCE_S = 300.0  # a busy machine takes long to start a process
_AT_ONCE_S = 2.0
_END_S = 30.0


def executor_contract_tests(executor: Path | str, *, options: Mapping[str, str] | None = None) -> list[ContractTest]:
    """Return the contract tests of an executor, given by name, or of all executors of a plugin file.

    Args:
        options: of the executor, without the dashes.

    Raises:
        UsageError: if the file registers no executor.
        PluginError: if the file cannot be loaded.
    """
    checks: dict[str, Callable[[ExecutorRequest], None]] = {
        "describes itself": _describes_itself,
        "computes the same bytes as the serial executor": _computes_the_same,
        "takes as many jobs at a time as its capacity": _fills_its_capacity,
        "returns at once from wait with a timeout of 0": _waits_no_longer,
        "returns a unit that fails as an outcome": _returns_failures,
        "forgets jobs that are cancelled": _forgets_jobs,
        "leaves no thread and no process": _leaves_nothing,
    }
    return [
        ContractTest(f"{name} {what}", partial(check, ExecutorRequest(name, threads=1, options=dict(options or {}))))
        for name in registered_names("executor", executor)
        for what, check in checks.items()
    ]


class _Recording(SerialExecutor):
    """The serial executor, which keeps its jobs and their outcomes."""

    def __init__(self, store: Store) -> None:
        super().__init__(store, threads=1)
        self.jobs: list[Job] = []
        self.outcomes: dict[int, JobOutcome] = {}

    def submit(self, job: Job) -> None:
        self.jobs.append(job)
        super().submit(job)

    def wait(self, timeout_s: float | None = None) -> tuple[int, JobOutcome] | None:
        ended = super().wait(timeout_s)
        if ended is not None:
            self.outcomes[ended[0]] = ended[1]
        return ended


class _TinyRun:
    """A tiny capture with an image that cannot be read, and what the serial executor made of it."""

    def __init__(self) -> None:
        self._temporary = TemporaryDirectory(prefix="pano-mvs-executor-")
        self.folder = Path(self._temporary.name)
        copytree(tiny_capture(Variant((32, 64))).folder / "images", self.folder / "images")
        (self.folder / "images" / _BROKEN).write_bytes(b"not an image")
        (self.folder / "tiny.yaml").write_text(_WORKFLOW, encoding="utf-8")
        self.store = Store(self.folder / "serial")
        executor = _Recording(self.store)
        self.records = self.run(executor, self.store)
        done = [job for job in executor.jobs if executor.outcomes[job.number].status == "done"]
        self.jobs = [job for job in done if job.unit.entry.name == "features"]
        (self.failing,) = (job for job in executor.jobs if executor.outcomes[job.number].status == "failed")
        self.outcomes = executor.outcomes

    def run(self, executor: Executor, store: Store) -> dict[str, object]:
        """Run the workflow, and return all records of the cache without times; their digests stand for the bytes."""
        session = open_session(str(self.folder / "tiny.yaml"), cache=store.root, out=store.root.with_suffix(".out"))
        Run(session.workflow, session.graph, store, out=session.out, executor=executor).execute()
        records = {}
        for path in below(store.root / "records", "*.json"):
            record = json.loads(path.read_bytes().partition(b"\n")[2])
            records[path.name] = record | {"seconds": 0}
        return records


@cache
def _tiny_run() -> _TinyRun:
    return _TinyRun()


@contextmanager
def _made(request: ExecutorRequest, store: Store | None = None) -> Iterator[Executor]:
    executor = make_executor(store or _tiny_run().store, request)
    try:
        yield executor
    finally:
        executor.close()


def _describes_itself(request: ExecutorRequest) -> None:
    with _made(request) as executor:
        for name in ("capacity", "threads", "cores"):
            value = getattr(executor, name, None)
            assert isinstance(value, int), f"{request.name}: {name} is {value!r}, not a number"
            assert value >= 1, f"{request.name}: {name} is {value}, not at least 1"
        assert executor.name, f"{request.name} has no name"
        assert isinstance(executor.enforces_timeouts, bool), f"{request.name}: enforces_timeouts must be True or False"
        assert executor.places() >= 0, f"{request.name}: places() is negative"
        assert executor.free_memory_bytes() >= 0, f"{request.name}: free_memory_bytes() is negative"
        assert isinstance(executor.notice(), str), f"{request.name}: notice() returns no text"


def _computes_the_same(request: ExecutorRequest) -> None:
    with TemporaryDirectory(prefix="pano-mvs-executor-") as folder:
        store = Store(Path(folder) / "cache")
        with _made(request, store) as executor:
            found = _tiny_run().run(executor, store)
    expected = _tiny_run().records
    assert found.keys() == expected.keys(), (
        f"{request.name} has results of {len(found)} units instead of {len(expected)}"
    )
    other = [name for name, record in found.items() if record != expected[name]]
    assert not other, f"{request.name} returns something else than the serial executor for {len(other)} units"


def _ended(executor: Executor, count: int) -> dict[int, JobOutcome]:
    """Wait for a number of jobs, and return the outcomes."""
    found: dict[int, JobOutcome] = {}
    deadline = time.monotonic() + _PATIENCE_S
    while len(found) < count:
        ended = executor.wait(1.0)
        if ended is not None:
            assert ended[0] not in found, f"job {ended[0]} ended twice"
            found[ended[0]] = ended[1]
        assert time.monotonic() < deadline, f"{count - len(found)} of {count} jobs do not end"
    return found


def _fills_its_capacity(request: ExecutorRequest) -> None:
    run = _tiny_run()
    with _made(request) as executor:
        for _ in range(2):  # it goes on after the first jobs
            jobs = run.jobs[: executor.capacity]
            for job in jobs:
                executor.submit(job)
            outcomes = _ended(executor, len(jobs))
            assert outcomes.keys() == {job.number for job in jobs}
            for number, outcome in outcomes.items():
                assert outcome.status == "done", f"{request.name}: a job is {outcome.status}: {outcome.cause}"
                found, expected = outcome.record, run.outcomes[number].record
                assert found is not None
                assert expected is not None
                same = (found.output, found.metrics, found.notes) == (expected.output, expected.metrics, expected.notes)
                assert same, f"{request.name} returns something else than the serial executor"
        assert executor.wait(0) is None, f"{request.name} returns a job that ended before"


def _waits_no_longer(request: ExecutorRequest) -> None:
    with _made(request) as executor:
        for submitted in (False, True):
            if submitted:
                executor.submit(_tiny_run().jobs[0])
            began = time.monotonic()
            ended = executor.wait(0)
            took = time.monotonic() - began
            assert took < _AT_ONCE_S, f"{request.name}: wait(0) takes {took:.1f} s"
            assert submitted or ended is None, f"{request.name} returns a job that nobody submitted"
        if ended is None:
            _ended(executor, 1)


def _returns_failures(request: ExecutorRequest) -> None:
    run = _tiny_run()
    with _made(request) as executor:
        executor.submit(run.failing)
        (outcome,) = _ended(executor, 1).values()
        expected = run.outcomes[run.failing.number]
        assert (outcome.status, outcome.cause) == (expected.status, expected.cause), (
            f"{request.name} returns {outcome.status} ({outcome.cause}) for a unit that fails, "
            f"instead of {expected.status} ({expected.cause})"
        )


def _forgets_jobs(request: ExecutorRequest) -> None:
    with _made(request) as executor:
        executor.submit(_tiny_run().jobs[0])
        executor.cancel()
        ended = executor.wait(1.0)
        assert ended is None, f"{request.name} returns job {ended and ended[0]}, which was cancelled"


def _leaves_nothing(request: ExecutorRequest) -> None:
    before = set(threading.enumerate())
    with _made(request) as executor:
        executor.submit(_tiny_run().jobs[0])
        _ended(executor, 1)
    deadline = time.monotonic() + _END_S
    while (left := _left(before)) and time.monotonic() < deadline:
        time.sleep(0.01)
    assert not left, f"{request.name} leaves {', '.join(left)} running"


def _left(before: set[threading.Thread]) -> list[str]:
    threads = [thread.name for thread in threading.enumerate() if thread not in before]
    return [*threads, *(child.name for child in multiprocessing.active_children())]
