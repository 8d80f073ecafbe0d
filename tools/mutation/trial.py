"""Run tests against one fault after another, each in a process forked from one that has loaded the libraries."""

from __future__ import annotations

import json
import os
import resource
import shutil
import signal
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from importlib import import_module
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING

from tools.mutation.mutants import Mutant

if TYPE_CHECKING:
    from coverage import Coverage

FOLDERS = ("pano_mvs", "tests", "tools", "docs", "workflows", "plugins")
COPIED = (*FOLDERS, "pyproject.toml", "README.md", "CONTRIBUTING.md")
NOT_COPIED = shutil.ignore_patterns("__pycache__", ".git", ".hypothesis")
SECONDS = 10.0
_LATER = count(int(time.time()) + 2, 2)  # times of files, each after the last
LOG = "mutation.log"
MEMORY_BYTES = 12 << 30
CRASHED = 99


@dataclass
class Baseline:
    """What the tests do with the code as it is.

    Attributes:
        seconds: of each test.
        tests: module to line to the tests that run it; line 0 has those that run anything in the module.
        libraries: modules of others that are loaded.
    """

    seconds: dict[str, float] = field(default_factory=dict)
    tests: dict[str, dict[int, list[str]]] = field(default_factory=dict)
    libraries: list[str] = field(default_factory=list)

    def of(self, mutant: Mutant) -> list[str]:
        """Return the tests that run the lines of a fault, the quickest first, as far as `SECONDS` go."""
        lines = self.tests.get(mutant.path, {})
        first, last = mutant.lines
        found = {test for line in range(first, last + 1) for test in lines.get(line, ())}
        if mutant.on_import:
            found |= set(lines.get(0, ()))
        chosen: list[str] = []
        total = 0.0
        for test in sorted(found, key=lambda one: (self.seconds[one], one)):
            total += self.seconds[test]
            if chosen and total > SECONDS:
                break
            chosen.append(test)
        return chosen


def copy_tree(root: Path, folder: Path) -> None:
    """Copy what the tests need of a repository."""
    for name in COPIED:
        if (root / name).is_dir():
            shutil.copytree(root / name, folder / name, ignore=NOT_COPIED)
        elif (root / name).exists():
            shutil.copy(root / name, folder / name)


def measure(tree: Path, sources: Sequence[str], tests: Sequence[str]) -> Baseline:
    """Run all tests once, without faults, and find out which lines each of them runs.

    Raises:
        RuntimeError: if a test fails.
    """
    status = _in_child(tree, lambda: _measured(tree, sources, tests), 3600)
    if status != 0:
        raise RuntimeError(f"the tests fail without any fault:\n{(tree / LOG).read_text('utf-8')}")
    values = json.loads((tree / "baseline.json").read_text())
    tests_of = {path: {int(line): found for line, found in lines.items()} for path, lines in values["tests"].items()}
    baseline = Baseline(values["seconds"], tests_of, values["libraries"])
    for name in baseline.libraries:
        with suppress(Exception):
            import_module(name)
    control = max(baseline.tests, key=lambda path: len(baseline.tests[path][0]))
    unchanged = Mutant(control, (0, 0), "", True, "", (tree / control).read_text("utf-8"), "")
    if outcome_of(tree, unchanged, baseline) != "survived":
        raise RuntimeError(f"a fork of the tests fails without any fault:\n{(tree / LOG).read_text('utf-8')}")
    return baseline


def outcome_of(tree: Path, mutant: Mutant, baseline: Baseline) -> str:
    """Return whether tests notice a fault: `killed`, `survived`, `timeout`, or `uncovered` if none runs it."""
    chosen = baseline.of(mutant)
    if not chosen:
        return "uncovered"
    path = tree / mutant.path
    original = path.read_bytes()
    _write(path, mutant.text.encode())
    try:
        limit = 60 + 6 * sum(baseline.seconds[test] for test in chosen)
        status = _in_child(tree, lambda: _pytest(["-x", *chosen]), limit)
    finally:
        _write(path, original)
        shutil.rmtree(tree / ".hypothesis", ignore_errors=True)
    return "timeout" if status is None else "survived" if status == 0 else "killed"


def _write(path: Path, data: bytes) -> None:
    """Write a module so that no compiled file of another text is taken for it."""
    path.write_bytes(data)
    os.utime(path, (later := next(_LATER), later))


def _in_child(tree: Path, work: Callable[[], int], limit_s: float) -> int | None:
    """Return the exit status of work that is done in a forked process, or None if it took too long."""
    sys.stdout.flush()
    pid = os.fork()
    if pid == 0:
        os.setsid()
        try:
            os.chdir(tree)
            os.environ["PYTHONPATH"] = str(tree)
            resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
            sys.path[:] = [str(tree), *(one for one in sys.path[1:] if one)]
            for name in [one for one in sys.modules if one.partition(".")[0] in ("tests", "pano_mvs")]:
                del sys.modules[name]
            status = work()
        except BaseException:
            traceback.print_exc()
            status = CRASHED
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)
    ends = time.monotonic() + limit_s
    try:
        while time.monotonic() < ends:
            done, status = os.waitpid(pid, os.WNOHANG)
            if done:
                return os.waitstatus_to_exitcode(status)
            time.sleep(0.02)
        return None
    finally:
        with suppress(ProcessLookupError):
            os.killpg(pid, signal.SIGKILL)
        with suppress(ChildProcessError):
            os.waitpid(pid, 0)


def _pytest(arguments: Sequence[str], plugins: Sequence[object] = ()) -> int:
    import pytest

    log = os.open(LOG, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
    for number in (1, 2):
        os.dup2(log, number)
    options = ["-q", "-p", "no:cacheprovider", "-p", "no:xdist", "--assert=plain", "--hypothesis-seed=0"]
    return int(pytest.main([*options, *arguments], [_WithoutShrinking(), *plugins]))


class _WithoutShrinking:
    """Lets hypothesis stop at the first example that fails: it counts that there is one."""

    def pytest_sessionstart(self) -> None:
        from hypothesis import Phase, settings

        phases = (Phase.explicit, Phase.generate)
        settings.register_profile("mutation", settings.get_profile("untimed"), phases=phases, database=None)
        settings.load_profile("mutation")


class _PerTest:
    """Tells coverage which test runs, and measures its time."""

    def __init__(self, watch: Coverage) -> None:
        self.watch = watch
        self.seconds: dict[str, float] = {}

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        self.watch.switch_context(nodeid)
        self.seconds[nodeid] = -time.perf_counter()

    def pytest_runtest_logfinish(self, nodeid: str) -> None:
        self.watch.switch_context("")
        self.seconds[nodeid] += time.perf_counter()


def _measured(tree: Path, sources: Sequence[str], arguments: Sequence[str]) -> int:
    import coverage

    before = set(sys.modules)
    watch = coverage.Coverage(data_file=None, include=[str(tree / one) for one in sources], config_file=False)
    timer = _PerTest(watch)
    watch.start()
    status = _pytest(arguments, [timer])
    watch.stop()
    tests: dict[str, dict[int, list[str]]] = {}
    for file in watch.get_data().measured_files():
        by_line = watch.get_data().contexts_by_lineno(file)
        lines = {line: sorted(one for one in found if one) for line, found in by_line.items()}
        lines[0] = sorted({one for found in lines.values() for one in found})
        tests[Path(file).relative_to(tree).as_posix()] = lines
    libraries = [name for name in set(sys.modules) - before if _is_library(name)]
    values = {"seconds": timer.seconds, "tests": tests, "libraries": sorted(libraries)}
    Path("baseline.json").write_text(json.dumps(values))
    return status


def _is_library(name: str) -> bool:
    file = getattr(sys.modules[name], "__file__", None) or ""
    return "site-packages" in file and not name.startswith(("pano_mvs", "tests", "_pytest", "distributed", "dask"))
