from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from pano_mvs.engine.cache.store import Store
from pano_mvs.engine.planning.plan import StagePlan, make_plan
from pano_mvs.engine.running.events import RunResult
from pano_mvs.engine.running.run import Run
from pano_mvs.session.session import Session, open_session
from tests.engine.toy import HELPER, PLUGIN, WORKFLOW


def heed_interrupts() -> None:
    """Let a new process take the signals that one in a script's background, or below nohup, ignores; a `preexec_fn`."""
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)


PATIENCE_S = 300.0
"""A busy machine takes long to do the quickest thing; what takes longer than this hangs."""


@dataclass
class Toy:
    """A toy capture in a folder, with shortcuts to run it."""

    folder: Path

    def number(self, name: str, text: str) -> None:
        path = self.folder / "capture" / name
        path.write_text(text)
        settle(path)

    def session(self, *overrides: str, cache: Path | None = None) -> Session:
        return open_session(
            str(self.folder / "wf.yaml"),
            overrides=overrides,
            cache=cache or self.folder / "cache",
            out=self.folder / "out",
        )

    def run(self, *overrides: str, earlier: dict[str, str] | None = None, cache: Path | None = None) -> RunResult:
        session = self.session(*overrides, cache=cache)
        run = Run(session.workflow, session.graph, Store(session.store_root), out=session.out)
        return run.execute(earlier_files=earlier)

    def plan(self, *overrides: str) -> dict[str, StagePlan]:
        session = self.session(*overrides)
        plans = make_plan(session.workflow, session.graph, Store(session.store_root))
        return {plan.name: plan for plan in plans}

    def edit(self, name: str, change: Callable[[str], str]) -> None:
        path = self.folder / name
        path.write_text(change(path.read_text()))

    def begin(self, code: str, *, of: str = "Multiply.") -> None:
        """Let a stage, by default the one that multiplies, begin with some code; `of` is its docstring."""
        mark = f'    """{of}"""\n'
        self.edit("plug.py", lambda text: text.replace(mark, f"{mark}{textwrap.indent(code.strip(), '    ')}\n"))

    def deliverables(self) -> dict[str, bytes]:
        out = self.folder / "out"
        return {p.relative_to(out).as_posix(): p.read_bytes() for p in sorted(out.rglob("*")) if p.is_file()}


def start(toy: Toy, *options: str, sleep_s: float = 0.0) -> subprocess.Popen[str]:
    """Start `pano-mvs run` on a toy capture; each mean takes `sleep_s`."""
    folder = toy.folder
    command = [sys.executable, "-m", "pano_mvs", "run", str(folder / "wf.yaml"), "--cache", str(folder / "cache")]
    return subprocess.Popen(
        [*command, "--out", str(folder / "out"), *options],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"TOY_SLEEP_S": str(sleep_s)},
        cwd=folder,
        preexec_fn=heed_interrupts,
    )


def finished_records(toy: Toy) -> int:
    return len(list((toy.folder / "cache" / "records").rglob("*.json")))


def wait_for_records(toy: Toy, process: subprocess.Popen[str], count: int) -> None:
    """Wait until a run has stored a number of results."""
    deadline = time.monotonic() + PATIENCE_S
    while finished_records(toy) < count:
        assert process.poll() is None, process.stderr.read() if process.stderr else ""
        assert time.monotonic() < deadline
        time.sleep(0.01)


def settle(path: Path) -> None:
    """Make a file old enough for its digest to be remembered by its time stamp."""
    past = time.time() - 60
    os.utime(path, (past, past))


def ran(result: RunResult) -> dict[str, int]:
    return {stage.stage: stage.run for stage in result.stages if stage.run}


@pytest.fixture
def toy(tmp_path: Path) -> Toy:
    return toy_in(tmp_path)


@pytest.fixture(scope="session")
def finished_once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a toy capture whose run has finished; not to be changed."""
    folder = tmp_path_factory.mktemp("finished")
    assert toy_in(folder).run().exit_code == 0
    return folder


@pytest.fixture
def finished(finished_once: Path, tmp_path: Path) -> Toy:
    """A toy capture whose run has finished, to be changed: a copy, since some tests damage what is stored."""
    return Toy(Path(shutil.copytree(finished_once, tmp_path, dirs_exist_ok=True)))


def toy_in(folder: Path) -> Toy:
    """Write a toy capture into a folder."""
    (folder / "capture").mkdir()
    (folder / "plug.py").write_text(PLUGIN)
    (folder / "helper.py").write_text(HELPER)
    (folder / "wf.yaml").write_text(WORKFLOW)
    made = Toy(folder)
    for number in range(1, 6):
        made.number(f"{number}.txt", str(10 * number))
    return made
