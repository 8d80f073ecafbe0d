"""All executors do the same: values, records, failures and their order do not depend on who computes, or when."""

from __future__ import annotations

import json
import os
import queue
import shutil
import signal
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

from pano_mvs.core.errors import InputError, PanoMvsError, RunStoppedError, StoreError, UsageError
from pano_mvs.engine.cache.blobs import BlobRef
from pano_mvs.engine.cache.store import ItemRef, Store
from pano_mvs.engine.executors import choose, fork_server, unit_requests
from pano_mvs.engine.executors import processes as worker_process
from pano_mvs.engine.executors.choose import ExecutorRequest, SerialExecutor, make_executor
from pano_mvs.engine.executors.processes import ProcessExecutor
from pano_mvs.engine.executors.protocol import Executor, JobOutcome
from pano_mvs.engine.executors.threads import bound_environment, share_cores
from pano_mvs.engine.executors.unit_requests import unit_from_json, unit_to_json, write_large_inputs
from pano_mvs.engine.planning.units import Unit
from pano_mvs.engine.running import run as run_module
from pano_mvs.engine.running.events import Observer, RunResult, UnitStarted
from pano_mvs.engine.running.run import Run
from pano_mvs.engine.stages.stage_code import stage_code
from tests.engine.conftest import Toy, ran
from tests.engine.running.test_run import ALL_UNITS

Make = Callable[[Store], Executor]


def one_process(store: Store) -> Executor:
    return ProcessExecutor(store, workers=1, threads=1)


def two_processes(store: Store) -> Executor:
    return ProcessExecutor(store, workers=2, threads=1)


def run_with(toy: Toy, make: Make, *overrides: str, name: str = "x", observer: Observer | None = None) -> RunResult:
    """Run into a folder and a store of the name's own."""
    session = toy.session(*overrides, cache=toy.folder / f"cache-{name}")
    store = Store(session.store_root)
    executor = make(store)
    try:
        out = toy.folder / f"out-{name}"
        return Run(session.workflow, session.graph, store, out=out, observer=observer, executor=executor).execute()
    finally:
        executor.close()


def files_below(folder: Path) -> dict[str, bytes]:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def keys_and_outputs(store: Path) -> dict[str, object]:
    """Return what the records of a store say, without the times."""
    found = {}
    for path in (store / "records").rglob("*.json"):
        record = json.loads(path.read_bytes().partition(b"\n")[2])
        found[path.name] = record | {"seconds": 0}
    return found


def told(result: RunResult) -> object:
    """Return all that a result says, in its order, without the times and the folders."""
    stages = [(s.stage, s.units, s.run, s.failed, s.blocked, s.metrics, s.unit_metrics, s.notes) for s in result.stages]
    failures = [(f.stage, f.item, f.cause, f.consequence) for f in (*result.failures, *result.blocked)]
    return (
        stages,
        failures,
        result.exit_code,
        result.stopped,
        dict(result.published),
        result.written,
        [result.rejected, result.doubts],
    )


# Slow tests of dask run before the slow ones here, and its loops are collected late.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("workers", [2, pytest.param(4, marks=pytest.mark.slow)])
def test_processes_give_the_bytes_of_serial(toy: Toy, workers: int) -> None:
    serial = run_with(toy, SerialExecutor, name="serial")
    side_by_side = run_with(toy, lambda store: ProcessExecutor(store, workers=workers, threads=1), name="processes")
    assert ran(side_by_side) == ALL_UNITS
    assert told(side_by_side) == told(serial)
    assert files_below(toy.folder / "out-processes") == files_below(toy.folder / "out-serial")
    assert keys_and_outputs(toy.folder / "cache-processes") == keys_and_outputs(toy.folder / "cache-serial")


@pytest.mark.slow
def test_what_fails_is_told_the_same_in_the_same_order(toy: Toy) -> None:
    toy.number("2.txt", "13")
    toy.number("4.txt", "not a number")
    serial = run_with(toy, SerialExecutor, name="serial")
    side_by_side = run_with(toy, two_processes, name="processes")
    assert serial.exit_code == 3
    assert [(f.stage, f.item) for f in serial.failures][:2] == [("images", "4.txt"), ("scaled", "2.txt")]
    assert told(side_by_side) == told(serial)
    assert "ValueError" in side_by_side.failures[0].trace


@pytest.mark.slow
def test_unit_starts_before_the_stage_before_it_is_complete(toy: Toy) -> None:
    """The second stage's first unit is waited for by the last unit of the first: a barrier would stop it for ever."""
    seen = toy.folder / "seen"
    toy.begin(
        f"""
import pathlib
while item.name == "5.txt" and not pathlib.Path({str(seen)!r}).exists(): time.sleep(0.01)
""",
        of="Read a number.",
    )
    touch = f"import pathlib; pathlib.Path({str(seen)!r}).touch()"
    toy.begin(touch)
    result = run_with(toy, two_processes, "images.timeout_s=60")
    assert result.exit_code == 0
    assert ran(result) == ALL_UNITS


def kill_once(
    toy: Toy, *, when: str = "x.value == 30", how: str = "os.kill(os.getpid(), 9)", of: str = "Multiply."
) -> None:
    """Let the worker that multiplies a certain number die the first time; `of` is the docstring of another stage."""
    mark = toy.folder / "died"
    code = f"""
import pathlib
if {when} and not pathlib.Path({str(mark)!r}).exists():
    pathlib.Path({str(mark)!r}).touch()
    {how}
"""
    toy.begin(code, of=of)


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="this system has no SIGKILL")
def test_killed_worker_costs_one_try(toy: Toy) -> None:
    kill_once(toy)
    result = run_with(toy, one_process)
    assert result.exit_code == 0
    assert ran(result) == ALL_UNITS


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="this system has no SIGKILL")
def test_many_inputs_reach_workers_through_a_file(toy: Toy, monkeypatch: pytest.MonkeyPatch) -> None:
    """Half a million of them as one message took 3 kB each. The worker dies once, so that they are sent twice."""
    kill_once(toy, when="len(xs) == 5", of="Less the whole part of the mean.")
    (toy.folder / "died").touch()
    serial = run_with(toy, SerialExecutor, name="serial")
    (toy.folder / "died").unlink()
    written: list[list[int]] = []

    def write(unit: Unit, store: Store, path: Path) -> None:
        write_large_inputs(unit, store, path)
        written.append([len(json.loads(line)["many"]) for line in path.read_text().splitlines()])

    for name, value in {"LARGE_INPUT": 3, "_ITEMS_PER_LINE": 2, "write_large_inputs": write}.items():
        monkeypatch.setattr(unit_requests, name, value)
    side_by_side = run_with(toy, one_process, name="processes")
    assert written == [[2, 2, 1], [2, 2, 1], [2, 2]]
    assert told(side_by_side) == told(serial)
    assert keys_and_outputs(toy.folder / "cache-processes") == keys_and_outputs(toy.folder / "cache-serial")
    assert not list((toy.folder / "cache-processes" / "tmp").iterdir())


def test_the_files_of_the_user_among_many_inputs_reach_workers(toy: Toy, monkeypatch: pytest.MonkeyPatch) -> None:
    session, store = toy.session(), Store(toy.folder / "cache")
    entry = session.workflow.stages["shifted"]
    images = [toy.folder / "capture" / f"{number}.txt" for number in (1, 2, 3)]
    texts = [BlobRef(store.blobs.register_external(path), 2, ".txt", external=True) for path in images]
    xs = {path.name: ItemRef("Number", "0" * 32, {"text": text}) for path, text in zip(images, texts, strict=True)}
    code = stage_code(entry.spec, entry.params)
    identity = {"code": code.digest, "libraries": dict(code.libraries), "inputs": {"xs": list(xs)}}
    unit = Unit(entry, "", (), {"xs": xs}, "1" * 32, identity)
    monkeypatch.setattr(unit_requests, "LARGE_INPUT", 1)
    write_large_inputs(unit, store, toy.folder / "cache" / "tmp" / "x.inputs")
    message = unit_to_json(unit, store, inputs_file=toy.folder / "cache" / "tmp" / "x.inputs")
    assert message["external"] == {}
    other = Store(toy.folder / "cache")
    received = unit_from_json(json.loads(json.dumps(message)), entry.spec, other)
    assert (received.inputs, received.identity) == (unit.inputs, unit.identity)
    assert [other.blobs.path(ref.parts["text"]) for ref in xs.values()] == images
    (toy.folder / "cache" / "tmp" / "x.inputs").unlink()
    with pytest.raises(StoreError, match=r"x\.inputs: the inputs of a unit cannot be read \(No such file"):
        unit_from_json(message, entry.spec, other)


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="this system has no SIGKILL")
def test_unit_that_kills_its_worker_again_is_listed_and_the_others_go_on(toy: Toy) -> None:
    toy.begin("""
print("about to go")
if x.value == 30: os.kill(os.getpid(), 9)
""")
    result = run_with(toy, two_processes)
    assert result.exit_code == 3
    failure = next(f for f in result.failures if f.stage == "scaled")
    assert (failure.item, failure.said) == ("3.txt", ("about to go",))
    assert "SIGKILL" in failure.cause
    assert ran(result)["scaled"] == 4


@pytest.mark.slow
@pytest.mark.parametrize(("how", "cause"), [("os._exit(0)", "exit code 0"), ("os.abort()", "killed by SIGABRT")])
def test_a_unit_that_ends_its_process_fails_with_one_worker_too(toy: Toy, how: str, cause: str) -> None:
    """One worker was no process: os._exit(0) in a stage ended the run with exit code 0 and without a report."""
    toy.begin(f"""
if x.value == 30:
    {how}
""")
    result = run_with(toy, lambda store: make_executor(store, ExecutorRequest(workers=1, threads=1)))
    (failure,) = (f for f in result.failures if f.stage == "scaled")
    assert (failure.item, result.exit_code) == ("3.txt", 3)
    assert f"its worker process died ({cause})" in failure.cause
    assert bool(failure.log) == (cause == "killed by SIGABRT")  # of which Python prints where it was
    assert ran(result)["scaled"] == 4


@pytest.mark.parametrize("said", ["", "about to go"])
def test_the_log_of_a_process_that_died_is_named_if_it_holds_anything(
    toy: Toy, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An empty log file was kept and named: a process that dies cannot remove its own."""
    wait = SerialExecutor.wait

    def wait_for_death(self: SerialExecutor, timeout_s: float | None = None) -> tuple[int, JobOutcome] | None:
        job = self._jobs[0] if self._jobs else None
        if timeout_s == 0 or job is None or (job.unit.entry.name, job.unit.item) != ("scaled", "3.txt"):
            return wait(self, timeout_s)
        self._jobs.clear()
        job.log.parent.mkdir(parents=True, exist_ok=True)
        job.log.write_text(said)
        return job.number, JobOutcome("failed", cause="its worker process died (exit code 7)", died=True)

    monkeypatch.setattr(SerialExecutor, "wait", wait_for_death)
    result = run_with(toy, SerialExecutor)
    failure = next(f for f in result.failures if f.stage == "scaled")
    assert failure.cause == "its worker process died (exit code 7)"
    assert (bool(failure.log), "\n".join(failure.said)) == (bool(said), said)
    assert bool(files_below(toy.folder / "out-x" / "logs")) == bool(said)
    assert not list((toy.folder / "cache-x" / "tmp").iterdir())


@pytest.mark.slow
def test_an_import_that_ends_the_worker_costs_the_units_that_need_it(toy: Toy) -> None:
    exits = "import os\nif 'PANO_MVS_WORKER' in os.environ: os._exit(0)\n"
    toy.edit("plug.py", lambda text: exits + text)
    with pytest.raises(InputError, match=r"(?s)none of the 5 items.*its worker process died \(exit code 0\)"):
        run_with(toy, one_process)


@pytest.mark.parametrize("make", [SerialExecutor, one_process])
def test_whatever_a_stage_raises_is_a_unit_that_failed(toy: Toy, make: Make) -> None:
    toy.begin("""
if x.value in (kinds := {20: BaseException, 30: Exception, 40: SystemExit}):
    class Odd(kinds[x.value]):
        def __str__(self):
            return 1 / 0
    raise Odd
""")
    result = run_with(toy, make)
    failures = {failure.item: failure.cause for failure in result.failures if failure.stage == "scaled"}
    assert failures.keys() == {"2.txt", "3.txt", "4.txt"}
    for cause in failures.values():
        assert "Odd: (its message cannot be shown: ZeroDivisionError)" in cause
    assert ran(result)["scaled"] == 2


@pytest.mark.slow
def test_timeout_ends_the_unit_and_not_the_run(toy: Toy, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a busy machine the other units may take longer than that too, so for them it does not count."""
    kill_once(toy, when="x.value == 20", how="time.sleep(600)")
    run = worker_process.WorkerProcess.run

    def run_without_timeout(self: worker_process.WorkerProcess, request: Mapping[str, Any]) -> JobOutcome:
        assert request["timeout_s"] == (1 if request["unit"]["stage"] == "scaled" else 0)
        return run(self, request if request["unit"]["item"] == "2.txt" else {**request, "timeout_s": 0})

    monkeypatch.setattr(worker_process.WorkerProcess, "run", run_without_timeout)
    result = run_with(toy, one_process, "scaled.timeout_s=1")
    failure = next(f for f in result.failures if f.stage == "scaled")
    assert failure.item == "2.txt"
    assert "timeout_s: 1" in failure.cause


def test_a_timeout_counts_only_the_time_in_which_the_main_process_waits(tmp_path: Path) -> None:
    """After SIGSTOP and SIGCONT of all processes, as when a batch system suspends a job, units were ended at once."""
    worker = worker_process.WorkerProcess(1, tmp_path / "errors.txt")
    waits: list[float] = []

    class Lines:
        """Nothing comes for ten times; the process may have been stopped for hours in each."""

        def get(self, timeout: float) -> bytes:
            waits.append(timeout)
            if len(waits) > 10:
                return b"answer"
            raise queue.Empty

    class Process:
        def poll(self) -> None:
            return None

    for left_s, is_late in ((6.0, False), (2.2, True)):
        waits.clear()
        worker._lines, worker._left_s, worker._too_late = Lines(), left_s, False  # type: ignore[assignment]
        assert worker._next_line(Process()) == b"answer"  # type: ignore[arg-type]
        assert worker._too_late is is_late
        assert not is_late or sum(waits[:5]) == pytest.approx(2.2)


def test_a_worker_without_threads_or_memory_stops_the_run(toy: Toy, monkeypatch: pytest.MonkeyPatch) -> None:
    """The thread that serves a worker ended, and the run waited for ever."""

    def fail(self: worker_process.WorkerProcess) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(worker_process.WorkerProcess, "_start", fail)
    with pytest.raises(StoreError, match="a worker cannot be started: can't start new thread"):
        run_with(toy, two_processes)


def test_serial_says_that_it_keeps_no_timeouts(toy: Toy) -> None:
    result = run_with(toy, SerialExecutor, "scaled.timeout_s=1")
    assert any("timeout_s of scaled has no effect" in warning for warning in result.warnings)


@pytest.mark.slow
def test_processes_are_replaced_after_so_many_units(toy: Toy, monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[int] = []
    start = worker_process.WorkerProcess._start

    def counted(self: worker_process.WorkerProcess) -> object:
        process = start(self)
        started.append(process.pid)
        return process

    monkeypatch.setattr(worker_process.WorkerProcess, "_start", counted)
    result = run_with(toy, lambda store: ProcessExecutor(store, workers=1, threads=1, units_per_process=10))
    assert ran(result) == ALL_UNITS
    assert len(started) == 3  # 28 units
    assert not any(_runs(pid) for pid in started)


def _runs(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except OSError:
        return False
    return True


@pytest.mark.slow
def test_policies_mean_the_same_in_processes(toy: Toy) -> None:
    toy.number("3.txt", "13")
    stopped = run_with(toy, two_processes, "scaled.on_error=stop")
    assert stopped.exit_code == RunStoppedError.exit_code
    assert "unlucky" in stopped.stopped
    gated = run_with(toy, two_processes, "scaled.min_success=0.9")
    assert "min_success is 0.9" in gated.stopped
    assert not {"difference", "shifted", "mean"} & set(ran(gated)), "nothing follows a stage before it has passed"


@pytest.mark.slow
def test_retries_are_as_many_as_the_workflow_says(toy: Toy) -> None:
    count = toy.folder / "count"
    toy.begin(f"""
if x.value == 30:
    with open({str(count)!r}, "a") as file: file.write("x")
    raise ValueError("again")
""")
    assert run_with(toy, one_process, "scaled.retries=2").exit_code == 3
    assert count.read_text() == "xxx"


@pytest.mark.slow
def test_declared_memory_bounds_how_many_run_at_a_time(toy: Toy, monkeypatch: pytest.MonkeyPatch) -> None:
    log = toy.folder / "log"
    toy.begin(
        f"""
with open({str(log)!r}, "a") as file: file.write("+")
time.sleep(0.05)
with open({str(log)!r}, "a") as file: file.write("-")
""",
        of="Mean of the neighbours and the own.",
    )
    monkeypatch.setattr(ProcessExecutor, "free_memory_bytes", lambda self: 3_000_000_000)
    result = run_with(toy, lambda store: ProcessExecutor(store, workers=3, threads=1), "mean.memory=2GB")
    assert result.exit_code == 0
    assert log.read_text() == "+-" * 5
    monkeypatch.setattr(SerialExecutor, "free_memory_bytes", lambda self: 3_000_000_000)
    refused = run_with(toy, SerialExecutor, "mean.memory=4 GB", name="y")
    failure = next(f for f in refused.failures if f.stage == "mean")
    assert "declares 4.0 GB of memory, and 3.0 GB are free" in failure.cause
    assert ran(refused)["difference"] == 4


def test_stage_may_declare_its_memory(toy: Toy, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(SerialExecutor, "free_memory_bytes", lambda self: 1_000_000)
    toy.edit("plug.py", lambda text: text.replace('@stage("toy.mean")', '@stage("toy.mean", memory="2MB")'))
    assert run_with(toy, SerialExecutor).exit_code == 3
    assert run_with(toy, SerialExecutor, "mean.memory=1MB").exit_code == 0


def test_memory_may_depend_on_settings_and_inputs(toy: Toy, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(SerialExecutor, "free_memory_bytes", lambda self: 1_000_000)
    toy.edit(
        "plug.py",
        lambda text: text.replace(
            '@stage("toy.mean")',
            "def needed(params, inputs):\n"
            '    return 2_000_000 * (inputs["own"].value > 50 and bool(inputs["around"]))\n\n'
            '@stage("toy.mean", memory=needed)',
        ),
    )
    result = run_with(toy, SerialExecutor)
    refused = [failure for failure in result.failures if failure.stage == "mean"]
    assert all("declares 2.0 MB of memory, and 1.0 MB are free" in failure.cause for failure in refused)
    assert 0 < len(refused) < 5
    assert not run_with(toy, SerialExecutor, "mean.memory=1MB", name="y").failures


@pytest.mark.slow
def test_what_a_unit_prints_is_kept_whoever_prints_it(toy: Toy) -> None:
    toy.begin("""
import ctypes, logging, sys
print("from Python")
sys.stderr.write("to the error stream\\n")
logging.getLogger("toy").info("from logging")
os.write(2, b"from a descriptor\\n")
ctypes.CDLL(None).puts(b"from C")
""")
    for name, make in {"serial": SerialExecutor, "processes": one_process}.items():
        assert run_with(toy, make, name=name).exit_code == 0
        text = (toy.folder / f"out-{name}" / "logs" / "scaled" / "3.txt.log").read_text()
        assert sorted(text.splitlines()) == sorted(
            [
                "from Python",
                "to the error stream",
                "INFO toy: from logging",
                "from a descriptor",
                "from C",
            ]
        )
    assert not list((toy.folder / "cache-processes" / "tmp").iterdir()), "nothing is left in the store"


@pytest.mark.slow
def test_stage_that_changed_meanwhile_is_not_mistaken_for_the_old_one(toy: Toy) -> None:
    session = toy.session()
    toy.edit("plug.py", lambda text: text.replace("2 * ", "3 * ").replace("* params.by / 2", "* params.by / 3"))
    store = Store(session.store_root)
    executor = one_process(store)
    try:
        with pytest.raises(UsageError, match="not the same in the worker"):
            Run(session.workflow, session.graph, store, out=toy.folder / "out", executor=executor).execute()
    finally:
        executor.close()


def test_workers_that_do_not_start_end_the_run(toy: Toy, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fork_server, "_BOOT", "raise SystemExit('no room for a server')")
    monkeypatch.setattr(worker_process, "_BOOT", "raise SystemExit('no room for a worker')")
    with pytest.raises(PanoMvsError, match="no room for a worker"):
        run_with(toy, two_processes)


def test_workers_times_threads_are_the_cores() -> None:
    assert share_cores(8) == (8, 1)
    assert share_cores(8, workers=2) == (2, 4)
    assert share_cores(8, threads=3) == (2, 3)
    assert share_cores(2, workers=5) == (5, 1)
    assert share_cores(4, workers=2, threads=1) == (2, 1)


def test_libraries_are_bound_by_the_environment_and_the_user_may_bind_them_further() -> None:
    environment = {"OMP_NUM_THREADS": "2", "NUMBA_NUM_THREADS": "64"}
    bound_environment(environment, 4)
    assert environment["OMP_NUM_THREADS"] == "2"
    assert environment["NUMBA_NUM_THREADS"] == "4"
    assert environment["OPENBLAS_NUM_THREADS"] == "1"


def test_executors_are_chosen_by_name_and_contradictions_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = Store(tmp_path)
    assert make_executor(store, ExecutorRequest("serial")).name == "serial"
    assert make_executor(store, ExecutorRequest(workers=3)).capacity == 3
    one = make_executor(store, ExecutorRequest(workers=1))
    assert (one.name, one.capacity) == ("processes", 1)
    monkeypatch.delenv("PANO_MVS_EXECUTOR")
    monkeypatch.setattr(choose, "available_threads", lambda: 1)
    assert make_executor(store).name == "processes"
    with pytest.raises(UsageError, match="there is no executor 'thread'"):
        make_executor(store, ExecutorRequest("thread"))
    with pytest.raises(UsageError, match="one unit at a time"):
        make_executor(store, ExecutorRequest("serial", 2))
    with pytest.raises(UsageError, match=r"--scheduler requires --executor .*; processes has no such option"):
        make_executor(store, ExecutorRequest("processes", options={"scheduler": "tcp://somewhere:8786"}))


@pytest.mark.slow
def test_nothing_of_a_cancelled_run_goes_on(toy: Toy) -> None:
    """An error in the middle ends the units in flight and the processes."""
    toy.begin("""
if x.value == 10: raise ValueError("stop here")
time.sleep(3600)
""")
    before = threading.active_count()
    assert run_with(toy, two_processes, "scaled.on_error=stop").exit_code == RunStoppedError.exit_code
    deadline = time.monotonic() + 30  # the threads that read from the workers end by themselves
    while threading.active_count() > before and time.monotonic() < deadline:
        time.sleep(0.01)
    assert threading.active_count() == before


def test_a_job_that_a_thread_takes_meanwhile_does_not_block_an_interrupt(tmp_path: Path) -> None:
    """Jobs were removed from a queue that was not empty a moment before, which waits for ever once it is."""

    class Jobs(queue.SimpleQueue[Any]):
        def empty(self) -> bool:
            return False

    executor = ProcessExecutor(Store(tmp_path), workers=1, threads=1)
    executor._jobs = Jobs()
    thread = threading.Thread(target=executor.cancel, daemon=True)
    thread.start()
    thread.join(5.0)
    assert not thread.is_alive()


def test_a_process_that_starts_during_an_interrupt_is_ended(toy: Toy, monkeypatch: pytest.MonkeyPatch) -> None:
    """It computed its unit to the end, and the command waited for it."""
    toy.begin("time.sleep(3600)", of="Read a number.")
    start, starting, interrupted = worker_process.WorkerProcess._start, threading.Event(), threading.Event()

    def start_late(self: worker_process.WorkerProcess) -> object:
        starting.set()
        assert interrupted.wait(30.0)
        return start(self)

    cancel = ProcessExecutor.cancel

    def cancel_before(self: ProcessExecutor) -> None:
        cancel(self)
        interrupted.set()

    def interrupt(event: object) -> None:
        if isinstance(event, UnitStarted) and event.item == "2.txt":
            assert starting.wait(30.0)
            raise KeyboardInterrupt

    monkeypatch.setattr(worker_process.WorkerProcess, "_start", start_late)
    monkeypatch.setattr(ProcessExecutor, "cancel", cancel_before)
    monkeypatch.setattr(run_module, "GRACE_S", 0.0)
    began = time.monotonic()
    with pytest.raises(KeyboardInterrupt, match=r"^$"):
        run_with(toy, two_processes, observer=interrupt)
    assert 0.5 < time.monotonic() - began < 60


@pytest.mark.slow
def test_same_work_twice_is_done_once(toy: Toy) -> None:
    """Two pictures of the same content have the same key; side by side they must not both be computed."""
    shutil.copy(toy.folder / "capture" / "1.txt", toy.folder / "capture" / "0.txt")
    toy.begin("time.sleep(0.05)")
    serial = run_with(toy, SerialExecutor, name="serial")
    side_by_side = run_with(toy, two_processes, name="processes")
    assert told(side_by_side) == told(serial)
    assert keys_and_outputs(toy.folder / "cache-processes") == keys_and_outputs(toy.folder / "cache-serial")
