"""Nothing that a plugin does in its process reaches other units: changed libraries, forks, hanging children."""

from __future__ import annotations

import math
import os
import queue
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Annotated, Any

import numpy as np
import pytest
from pydantic import create_model

from pano_mvs.core.errors import UsageError
from pano_mvs.core.named_registry import NamedRegistry
from pano_mvs.engine.cache.store import Store
from pano_mvs.engine.executors.choose import SerialExecutor
from pano_mvs.engine.executors.execute import _called
from pano_mvs.engine.executors.processes import WorkerProcess
from pano_mvs.engine.planning.plan import RunOptions
from pano_mvs.engine.running.run import Run
from pano_mvs.engine.stages.context import Context
from pano_mvs.engine.stages.params import Params, RegisteredIn
from tests.engine.conftest import Toy, ran, start
from tests.engine.running.test_executors import Make, files_below, one_process, run_with, told
from tests.engine.running.test_run import ALL_UNITS

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="this system has no fork")


def ended(pids: Path) -> bool:
    """Return whether all processes whose ids are in a file have ended, within some seconds."""
    numbers = [int(line) for line in pids.read_text().split()]
    for _ in range(100):
        states = [Path(f"/proc/{pid}/stat") for pid in numbers]
        if all(not path.exists() or path.read_text().rpartition(")")[2].split()[0] == "Z" for path in states):
            return True
        time.sleep(0.1)
    return False


@pytest.mark.slow
@pytest.mark.parametrize("make", [SerialExecutor, one_process])
@pytest.mark.parametrize("at_import", [False, True])
def test_changed_libraries_do_not_reach_other_units(toy: Toy, make: Make, at_import: bool) -> None:
    """A plugin that switched OpenCV's optimisation off changed 12 of 12 files of built-in stages, with exit 0."""
    clean = run_with(toy, SerialExecutor, name="clean")
    toy.begin("""import cv2
import numpy as np
if not cv2.useOptimized() or np.geterr()["over"] == "raise": raise ValueError("tainted")
cv2.setUseOptimized(False)
np.seterr(over="raise")""")
    if at_import:
        change = "import cv2\ncv2.setUseOptimized(False)\nimport time"
        toy.edit("plug.py", lambda text: text.replace("import time", change, 1))
    result = run_with(toy, make)
    assert result.exit_code == 0
    assert files_below(toy.folder / "out-x") == files_below(toy.folder / "out-clean")
    assert ran(result) == ran(clean) == ALL_UNITS
    notes = {note for stage in result.stages for note in stage.notes}
    change = "OpenCV's optimisation, numpy's handling of errors"
    assert any(f"it changed {change} in its process; this was undone" in note for note in notes)


@pytest.mark.parametrize(("part", "left"), [("ours", "1"), ("theirs", "")])
def test_changes_by_a_plugins_part_of_a_built_in_stage_are_undone(
    part: str, left: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    parts: NamedRegistry[int] = NamedRegistry("toy part", {"ours": 1})
    parts.register("theirs", 2, lambda: None)
    monkeypatch.setenv("TOY_PART", "")

    chosen = create_model(
        "Chosen", __doc__="Settings.", __base__=Params, part=(Annotated[str, RegisteredIn(parts)], "ours")
    )

    def built_in() -> str:
        os.environ["TOY_PART"] = "1"
        return "value"

    spec = SimpleNamespace(function=built_in, extras={}, is_built_in=True)
    unit: Any = SimpleNamespace(
        entry=SimpleNamespace(spec=spec, params=chosen.model_validate({"part": part})), source=None
    )
    context = Context(np.random.default_rng(0), tmp_path)
    assert _called(unit, {}, context) == "value"
    assert os.environ["TOY_PART"] == left
    assert bool(context.notes) == (not left)


@pytest.mark.slow
def test_a_forked_child_neither_stores_nor_answers(toy: Toy) -> None:
    """Units got the results of other units, since a forked child of the stage answered too, or failed."""
    clean = run_with(toy, SerialExecutor, name="clean")
    pids = toy.folder / "pids"
    toy.begin(f"""if (child := os.fork()) == 0:
    if x.value > 30: raise ValueError("child")
    return Number(666.0)
open({str(pids)!r}, "a").write(f"{{child}} ")""")
    result = run_with(toy, one_process)
    assert told(result) == told(clean)
    assert files_below(toy.folder / "out-x") == files_below(toy.folder / "out-clean")
    assert ended(pids)


@pytest.mark.slow
@pytest.mark.parametrize("child", ["os.fork() == 0", "subprocess.Popen(['sleep', '600']) is None"])
def test_a_timeout_ends_what_the_unit_started(toy: Toy, child: str) -> None:
    """A child that held the pipe of the worker made the run wait for it for ever."""
    pids = toy.folder / "pids"
    toy.begin(f"""import subprocess
if x.value == 20:
    {child}
    open({str(pids)!r}, "a").write(f"{{os.getpid()}} ")
    time.sleep(600)""")
    result = run_with(toy, one_process, "scaled.timeout_s=3")
    assert [(failure.stage, failure.item) for failure in result.failures if "timeout_s: 3" in failure.cause] == [
        ("scaled", "2.txt")
    ]
    assert ended(pids)


@pytest.mark.slow
def test_a_unit_that_dies_leaves_no_process_that_holds_its_pipe(toy: Toy) -> None:
    pids = toy.folder / "pids"
    toy.begin(f"""if x.value == 20:
    if os.fork() == 0:
        open({str(pids)!r}, "a").write(f"{{os.getpid()}} ")
        time.sleep(600)
    os._exit(3)""")
    result = run_with(toy, one_process)
    assert ["its worker process died (exit code 3)" in failure.cause for failure in result.failures][:1] == [True]
    assert ended(pids)


@pytest.mark.slow
def test_isolated_units_have_processes_of_their_own(toy: Toy) -> None:
    pids = toy.folder / "pids"
    toy.begin(f'open({str(pids)!r}, "a").write(f"{{os.getpid()}} ")')
    session = toy.session(cache=toy.folder / "cache-x")
    store = Store(session.store_root)
    options = RunOptions(until=("scaled",), isolate=True)
    executor = one_process(store)
    try:
        Run(session.workflow, session.graph, store, out=toy.folder / "o", executor=executor, options=options).execute()
    finally:
        executor.close()
    numbers = pids.read_text().split()
    assert len(numbers) == len(set(numbers)) == 5
    with pytest.raises(UsageError, match="--isolate has no effect with --executor serial"):
        Run(session.workflow, session.graph, store, out=toy.folder / "o", options=options)


def test_answers_to_other_requests_are_ignored(tmp_path: Path) -> None:
    worker = WorkerProcess(1, tmp_path / "errors.txt")
    process = subprocess.Popen([sys.executable, "-c", ""])
    lines: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
    for line in (
        b'{"ready": true}\n',
        b'{"nonce": "old", "key": "k", "outcome": {"status": "failed", "record": null, "cause": "a child"}}\n',
        b'{"nonce": "new", "key": "other", "outcome": {"status": "failed", "record": null, "cause": "a child"}}\n',
        b'{"nonce": "new", "key": "k", "outcome": {"status": "failed", "record": null, "cause": "mine"}}\n',
    ):
        lines.put(line)
    worker._lines = lines
    found = worker._listen(process, {"nonce": "new", "key": "k"}, math.inf)
    process.wait()
    assert found is not None
    assert found.cause == "mine"


def leave_behind(toy: Toy, way: str, then: str = "") -> Path:
    """Let the second unit of a stage leave a process of another session behind; return the file with its id."""
    pids = toy.folder / "pids"
    daemon = f"""if os.fork() == 0:
    os.setsid()
    if os.fork() == 0:
        open({str(pids)!r}, "a").write(f"{{os.getpid()}} ")
        time.sleep(600)
    os._exit(0)"""
    command = f"""import subprocess
child = subprocess.Popen(["sleep", "600"], start_new_session=True, env={{}})
open({str(pids)!r}, "a").write(f"{{child.pid}} ")"""
    lines = (
        f"{daemon if way == 'daemon' else command}\nwhile not os.path.exists({str(pids)!r}): time.sleep(0.01)\n{then}"
    )
    toy.begin("if x.value == 20:\n" + "\n".join(f"    {line}" for line in lines.splitlines()))
    return pids


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="other systems do not show what left the group of a process")
@pytest.mark.parametrize(
    ("way", "end"),  # nothing connects a command without environment with a worker that has died
    [("command", "run"), ("command", "timeout"), ("daemon", "SIGTERM"), ("command", "SIGKILL"), ("daemon", "death")],
)
def test_processes_of_other_sessions_end_with_the_run(toy: Toy, way: str, end: str) -> None:
    """A child that had left the process group of its worker outlived the run."""
    then = {"run": "", "death": "os._exit(3)"}.get(end, "time.sleep(600)")
    pids = leave_behind(toy, way, then)
    if not end.startswith("SIG"):
        assert run_with(toy, one_process, "scaled.timeout_s=3").exit_code == (0 if end == "run" else 3)
    else:
        process = start(toy, "--executor", "processes", "--workers", "2")
        while not pids.exists():
            assert process.poll() is None
            time.sleep(0.05)
        for _ in range(2):  # the second one does not wait for running units
            process.send_signal(signal.Signals[end])
            time.sleep(1)
        process.communicate(timeout=30)
    assert ended(pids)
