"""Disturb runs in every way that a long run may meet, and see that nothing is lost.

`FAULTS` is the table: each fault, and what must hold. For every try, a toy run goes on in a cache of its own; it is
held inside a unit of some stage while the fault sets in. Then, whatever the fault:

- the run ends with one of the fault's exit codes, and if it is not 0, says why without a traceback;
- no process that it started is left;
- every result that was in the cache when the fault set in is still there, unless the fault itself damages the cache;
- the same run, without the fault, ends with exit code 0 and computes no more units than were lost;
- the files that it delivers are, byte for byte, those of an undisturbed run, and the cache is undamaged.

What this machine cannot do (only root may mount a disk that fills up) is listed as such.
"""

from __future__ import annotations

import os
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pano_mvs
from pano_mvs.core.digest import digest_from_file
from pano_mvs.engine.cache import maintenance
from pano_mvs.engine.cache.blobs import BlobRef
from pano_mvs.engine.cache.packs import Packed
from pano_mvs.engine.cache.store import Store
from tests.permissions import drop_right_to_ignore_permissions
from tools.stress.captures import HOLD_VARIABLE, TOY_STAGES, deliverables, write_toy
from tools.stress.damage import damaged
from tools.stress.kills import PACKING, half_written, record_keys
from tools.stress.world import ImpossibleHereError, make_clock, memory_limit, read_only, small_disk, unsteady

_OWNER = "PANO_MVS_STRESS"
_ROOT = Path(__file__).parents[2]
_NUMBERS = 5
_YEARS_S = 5 * 365 * 86400
_LONGEST_S = 900.0
_ORPHANS_S = 10.0


@dataclass(frozen=True)
class Ended:
    """How a run ended: its exit code, what it printed, and where it delivered."""

    code: int
    said: str
    out: Path


@dataclass(frozen=True)
class Clean:
    """A toy workflow, with what an undisturbed run of it delivers and stores."""

    workflow: Path
    cache: Path
    expected: Mapping[str, bytes]
    units: int

    @staticmethod
    def make(folder: Path, *, python_path: str = str(_ROOT), change: tuple[str, str] = ("", "")) -> Clean:
        """Write the toy into a new folder, with a change of its plugin, and run it."""
        workflow = write_toy(folder / "toy", numbers=_NUMBERS)
        plugin = folder / "toy" / "plug.py"
        plugin.write_text(plugin.read_text().replace(*change) if change[0] else plugin.read_text())
        cache, out = folder / "cache", folder / "out"
        command = _command(workflow, cache, out, ["--executor", "serial"])
        done = subprocess.run(
            command,
            env=os.environ | {"PYTHONPATH": python_path},
            cwd=folder,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return Clean(workflow, cache, deliverables(out), len(intact(cache)))


@dataclass
class Case:
    """One try: a folder with cache and output, and the processes that belong to it.

    Attributes:
        kept: keys of the results that were in the cache when the fault set in.
        repairs: what ends the fault.
        stack: is closed when the try is over.
    """

    folder: Path
    clean: Clean
    number: int
    executor: str
    rng: random.Random
    pause_s: float
    repairs: ExitStack
    stack: ExitStack
    options: list[str] = field(default_factory=list)
    kept: set[str] = field(default_factory=set)
    owner: str = field(default_factory=lambda: uuid.uuid4().hex)

    def __post_init__(self) -> None:
        self.cache: Path
        self.out: Path
        self.hold: Path
        self.cache, self.out, self.hold = (self.folder / name for name in ("cache", "out", "hold"))
        self.hold.mkdir()

    @property
    def stage(self) -> str:
        """The stage in which the run is held: another one in each try of a fault."""
        return TOY_STAGES[self.number % len(TOY_STAGES)]

    def start(
        self,
        *,
        out: str = "",
        clean: Clean | None = None,
        program: Iterable[str] = ("-m", "pano_mvs"),
        environment: dict[str, str] | None = None,
        prepare: Callable[[], None] | None = None,
    ) -> tuple[subprocess.Popen[str], Path]:
        """Start the run, or another one on the same cache into a folder of its own, which is not held."""
        place = self.folder / out if out else self.out
        options = ["--executor", self.executor, *(["--workers", "2"] if self.executor != "serial" else [])]
        command = _command((clean or self.clean).workflow, self.cache, place, [*options, *self.options], program)
        basic = {
            "PYTHONPATH": str(_ROOT),
            "COLUMNS": "400",
            _OWNER: self.owner,
            HOLD_VARIABLE: "" if out else str(self.hold),
        }
        with place.with_suffix(".said").open("w") as said:
            process = subprocess.Popen(
                command,
                env=os.environ | basic | (environment or {}),
                cwd=self.folder,
                stdout=said,
                stderr=said,
                text=True,
                preexec_fn=partial(_prepare, prepare),
            )
        return process, place

    def end(self, started: tuple[subprocess.Popen[str], Path]) -> Ended:
        """Wait for the end of a run."""
        process, out = started
        try:
            process.wait(_LONGEST_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        return Ended(process.returncode, out.with_suffix(".said").read_text(errors="replace"), out)

    @contextmanager
    def held(self, stage: str = "", **settings: Any) -> Iterator[tuple[tuple[subprocess.Popen[str], Path], int]]:
        """Start a run; yield it, with the process that computes a unit of the stage, which goes on afterwards."""
        flag, met = self.hold / (stage or self.stage), self.hold / "met"
        flag.touch()
        started = self.start(**settings)
        while not met.exists() and started[0].poll() is None:
            time.sleep(0.01)
        assert met.exists(), f"the run has ended before the fault: {self.end(started).said}"
        self.kept = intact(self.cache)
        yield started, int(met.read_text())
        flag.unlink(missing_ok=True)

    def processes(self) -> list[int]:
        """Return all processes of this try that are alive."""
        mark, found = f"{_OWNER}={self.owner}".encode(), []
        for place in Path("/proc").glob("[0-9]*"):
            with suppress(OSError):
                state = (place / "stat").read_text().rpartition(")")[2].split()[0]
                if state not in "ZX" and mark in (place / "environ").read_bytes().split(b"\0"):
                    found.append(int(place.name))
        return found

    def signal(self, number: int, processes: Iterable[int]) -> None:
        """Send a signal to processes, some of which may have ended."""
        for process in processes:
            with suppress(ProcessLookupError):
                os.kill(process, number)

    def use_clean_cache(self) -> None:
        """Begin with the cache of an undisturbed run."""
        shutil.copytree(self.clean.cache, self.cache)


def _prepare(more: Callable[[], None] | None) -> None:
    signal.signal(signal.SIGHUP, signal.SIG_DFL)  # which `nohup` ignores
    if more:
        more()


def _command(
    workflow: Path, cache: Path, out: Path, options: Iterable[str], program: Iterable[str] = ("-m", "pano_mvs")
) -> list[str]:
    places = ["--cache", str(cache), "--out", str(out)]
    return [sys.executable, *program, "run", str(workflow), *places, *options]


def intact(cache: Path) -> set[str]:
    """Return the keys of the records that are undamaged and whose values are."""
    if not (cache / "records").is_dir():
        return set()
    store = Store(cache, for_reading=True)
    found = {key: store.find(key) for key in record_keys(cache)}
    return {
        key for key, record in found.items() if record and all(_is_intact(store, ref) for ref in record.own_blobs())
    }


def _is_intact(store: Store, ref: BlobRef) -> bool:
    place = store.blobs.place(ref)
    try:
        return (place.content_digest() if isinstance(place, Packed) else digest_from_file(place)) == ref.digest
    except OSError:
        return False


# The faults. Each starts a run, disturbs it, and returns how it ended.


def _clock_changes(case: Case, to_s: float) -> list[Ended]:
    """The clock is set while a unit is being computed."""
    clock = make_clock(case.folder / "clock")
    with case.held(environment=clock.environment) as (run, _):
        clock.shift(to_s)
    return [case.end(run)]


def _clock_is_wrong(case: Case, shift_s: float) -> list[Ended]:
    clock = make_clock(case.folder / "clock")
    clock.shift(shift_s)
    return [case.end(case.start(environment=clock.environment))]


def _another_has_a_clock_ahead(case: Case) -> list[Ended]:
    """A second run on the same cache starts in five years while the first one is computing a unit."""
    clock = make_clock(case.folder / "clock")
    clock.shift(_YEARS_S)
    with case.held("toy.write_table") as (run, _):  # it has a folder in the cache
        other = case.end(case.start(out="other", environment=clock.environment))
    return [case.end(run), other]


def _stopped(case: Case, whom: str, *, timeout_s: float = 0.0) -> list[Ended]:
    """SIGSTOP, and SIGCONT after a pause."""
    if timeout_s:
        case.options += ["--set", f"mean.timeout_s={timeout_s}"]
    with case.held("toy.mean" if timeout_s else "") as (run, worker):
        chosen = {"main": [run[0].pid], "worker": [worker], "all": case.processes()}[whom]
        case.signal(signal.SIGSTOP, chosen)
    time.sleep(case.pause_s)
    case.signal(signal.SIGCONT, chosen)
    case.options.clear()
    return [case.end(run)]


def _disk_fills_up(case: Case, place: str, *, inodes: bool = False) -> list[Ended]:
    disk = case.stack.enter_context(small_disk(case.folder / "disk"))
    if not disk.is_mounted:
        raise ImpossibleHereError("needs the right to mount")
    case.repairs.callback(disk.grow)
    setattr(case, place, disk.folder / place)
    case.options += ["--min-free", "0"]
    with case.held("toy.write_each" if place == "out" else "") as (run, _):
        disk.fill(inodes=inodes)
    return [case.end(run)]


def _is_read_only(case: Case, place: str) -> list[Ended]:
    """The cache, which has all results, or the output folder is read-only when the run starts."""
    case.use_clean_cache()
    case.out.mkdir()
    case.repairs.enter_context(read_only(getattr(case, place)))
    return [case.end(case.start())]


def _becomes_read_only(case: Case, place: str) -> list[Ended]:
    with case.held("toy.write_each" if place == "out" else "") as (run, _):
        case.repairs.enter_context(read_only(getattr(case, place)))
    return [case.end(run)]


def _file_system_pauses(case: Case, how: str) -> list[Ended]:
    """The file system of the cache does not answer, or answers with errors, and then does again."""
    (case.folder / "disk").mkdir()
    flag = case.folder / "flag"
    case.cache = case.stack.enter_context(unsteady(case.folder / "disk", flag)) / "cache"
    with case.held() as (run, _):
        flag.write_text(how)
    time.sleep(case.pause_s if how == "stall" else 0.5)
    flag.unlink()
    return [case.end(run)]


def _worker_killed(case: Case) -> list[Ended]:
    with case.held() as (run, worker):
        case.signal(signal.SIGKILL, [worker])
    return [case.end(run)]


def _memory_runs_out(case: Case) -> list[Ended]:
    """A unit takes memory until the system kills its process."""
    group = case.stack.enter_context(memory_limit(1_500_000_000))
    (case.hold / case.stage).write_text("eat")
    run = case.start(prepare=partial(_join, group))
    ended = case.end(run)
    assert (case.hold / "met").exists(), ended.said
    return [ended]


def _join(group: Path) -> None:
    group.write_text(str(os.getpid()))


def _main_ends(case: Case, number: int) -> list[Ended]:
    with case.held() as (run, _):
        case.signal(number, [run[0].pid])
        ended = case.end(run)
    return [ended]


def _killed_while_packing(case: Case) -> list[Ended]:
    """SIGKILL while results are moved into packs, or just after."""
    run = case.start(program=("-c", PACKING))
    while run[0].poll() is None and not list(case.cache.glob("tmp/*.pack")) + list(case.cache.glob("packs/*")):
        time.sleep(0.001)
    time.sleep(case.rng.uniform(0, 0.03))
    case.signal(signal.SIGKILL, [run[0].pid])
    return [case.end(run)]


def _two_versions(case: Case) -> list[Ended]:
    """Another version of package and plugin runs on the same cache at the same time."""
    tree = case.folder / "tree"
    shutil.copytree(_ROOT / "pano_mvs", tree / "pano_mvs", ignore=shutil.ignore_patterns("__pycache__"))
    initial = tree / "pano_mvs" / "__init__.py"
    initial.write_text(re.sub(r'__version__ = "[^"]*"', '__version__ = "99.0.0"', initial.read_text()))
    (case.folder / "elsewhere").mkdir()
    change = ("* params.by / 2)", "* params.by / 2 + 1)")
    other = Clean.make(case.folder / "elsewhere", python_path=str(tree), change=change)
    assert other.expected != case.clean.expected
    with case.held() as (run, _):
        second = case.start(out="second", clean=other, environment={"PYTHONPATH": str(tree)})
    ended = case.end(second)
    wrong = deliverables(ended.out) != other.expected
    return [case.end(run), Ended(1 if wrong else ended.code, ended.said, case.out)]


def _two_runs(case: Case) -> list[Ended]:
    """Two runs of one workflow go on in one cache, and one of them is killed."""
    with case.held() as (run, _):
        other = case.start(out="other")
        time.sleep(case.rng.uniform(0, 3))
        case.signal(signal.SIGKILL, [run[0].pid])
    return [case.end(run), case.end(other)]


def _little_address_space(case: Case) -> list[Ended]:
    """`ulimit -v`, with which the command cannot start, or a unit reaches the limit."""
    size = int(case.rng.choice([case.rng.uniform(0.1, 1), case.rng.uniform(1, 2)]) * 1e9)
    (case.hold / case.stage).write_text("eat")
    ended = case.end(case.start(prepare=partial(resource.setrlimit, resource.RLIMIT_AS, (size, size))))
    (case.hold / case.stage).unlink(missing_ok=True)
    return [ended]


def _damaged(case: Case, places: tuple[str, ...]) -> list[Ended]:
    case.use_clean_cache()
    if "packs" in places:
        with patch.object(maintenance, "_MIN_PACKED_FILES", 1):
            assert maintenance.pack(Store(case.cache))
    files = [path for name in places for path in sorted((case.cache / name).rglob("*")) if path.is_file()]
    for path in case.rng.sample(files, min(12, len(files))):
        path.write_bytes(damaged(path.read_bytes(), case.rng))
    return [case.end(case.start())]


def _power_lost(case: Case) -> list[Ended]:
    """Of the newest files of the cache, nothing or zeros or a part have reached the disk."""
    with case.held() as (run, _):
        case.signal(signal.SIGKILL, case.processes())
        ended = case.end(run)
    files = sorted((path for path in case.cache.rglob("*") if path.is_file()), key=lambda path: path.stat().st_mtime_ns)
    for path in files[-15:]:
        size = path.stat().st_size
        path.write_bytes(case.rng.choice([b"", bytes(size), path.read_bytes()[: size // 2]]))
    return [ended]


def _removed(case: Case, place: str) -> list[Ended]:
    with case.held() as (run, _):
        shutil.rmtree(getattr(case, place), ignore_errors=True)
    return [case.end(run)]


def _forbidden(case: Case) -> list[Ended]:
    """`chmod 000` of a folder."""
    name = case.rng.choice(["cache", "cache/records", "cache/blobs", "cache/tmp", "out"])
    with case.held(prepare=drop_right_to_ignore_permissions) as (run, _):
        folder = case.folder / name
        folder.mkdir(exist_ok=True)
        folder.chmod(0)
        case.repairs.callback(folder.chmod, 0o755)
    return [case.end(run)]


@dataclass(frozen=True)
class Fault:
    """A fault, and what must hold beyond what must hold for each.

    Attributes:
        kind: what happens.
        disturb: starts a run, disturbs it, and returns how it ended, and others with it.
        codes: exit codes with which the run may end; negative for a signal.
        says: what it prints if its exit code is positive.
        tries: how many of a hundred.
        keeps: whether all that was in the cache must be there afterwards.
        executors: one after the other.
    """

    kind: str
    disturb: Callable[[Case], list[Ended]]
    codes: tuple[int, ...]
    says: str = ""
    tries: int = 3
    keeps: bool = True
    executors: tuple[str, ...] = ("processes", "serial")


_PROCESSES = ("processes",)
_KILLED = -int(signal.SIGKILL)
_FULL = "full|Free some space"
_DENIED = "cannot be (written|read|created)|cannot be started"

FAULTS = (
    Fault("the clock is set back by an hour in a unit", partial(_clock_changes, to_s=-3600), (0,), tries=3),
    Fault("the clock is set to 1970 in a unit", partial(_clock_changes, to_s=-time.time() + 60), (0,), tries=2),
    Fault("the clock says 1970 for a whole run", partial(_clock_is_wrong, shift_s=-time.time() + 60), (0,), tries=2),
    Fault(
        "the clock is five years ahead, and right for the next run",
        partial(_clock_is_wrong, shift_s=_YEARS_S),
        (0,),
        tries=2,
    ),
    Fault("a second run starts with a clock five years ahead", _another_has_a_clock_ahead, (0,), tries=2),
    Fault("SIGSTOP of the main process, SIGCONT", partial(_stopped, whom="main"), (0,)),
    Fault("SIGSTOP of a worker, SIGCONT", partial(_stopped, whom="worker"), (0,), tries=2),
    Fault(
        "SIGSTOP of all processes, longer than `timeout_s`",
        partial(_stopped, whom="all", timeout_s=2),
        (0,),
        executors=_PROCESSES,
        tries=2,
    ),
    Fault(
        "SIGSTOP of a worker alone, longer than `timeout_s`",
        partial(_stopped, whom="worker", timeout_s=2),
        (3,),
        "timeout_s: 2",
        executors=_PROCESSES,
        tries=2,
    ),
    Fault(
        "the disk of the cache fills up, in each stage", partial(_disk_fills_up, place="cache"), (4,), _FULL, tries=11
    ),
    Fault("the disk of the output folder fills up", partial(_disk_fills_up, place="out"), (4,), _FULL, tries=2),
    Fault(
        "the disk of the cache has no inodes left",
        partial(_disk_fills_up, place="cache", inodes=True),
        (4,),
        _FULL,
        tries=3,
    ),
    Fault("the cache is read-only", partial(_is_read_only, place="cache"), (0,), tries=2),
    Fault("the output folder is read-only", partial(_is_read_only, place="out"), (2, 4), _DENIED, tries=2),
    Fault("the cache becomes read-only", partial(_becomes_read_only, place="cache"), (4,), _DENIED, tries=3),
    Fault("the output folder becomes read-only", partial(_becomes_read_only, place="out"), (4,), _DENIED, tries=2),
    Fault("the file system of the cache stalls", partial(_file_system_pauses, how="stall"), (0,), tries=4),
    Fault(
        "the file system of the cache fails for a while",
        partial(_file_system_pauses, how="fail"),
        (0, 3, 4),
        _DENIED,
        keeps=False,
    ),
    Fault("SIGKILL of a worker in a unit", _worker_killed, (0,), tries=3, executors=_PROCESSES),
    Fault("the system kills a worker that takes too much memory", _memory_runs_out, (0,), executors=_PROCESSES),
    Fault("`ulimit -v`", _little_address_space, (3, 4), "[Mm]emory", tries=4),
    Fault("SIGKILL of the main process in a unit", partial(_main_ends, number=signal.SIGKILL), (_KILLED,), tries=4),
    Fault(
        "the terminal closes (SIGHUP)",
        partial(_main_ends, number=signal.SIGHUP),
        (-int(signal.SIGHUP), 129, 130),
        tries=2,
    ),
    Fault("SIGKILL while results are packed", _killed_while_packing, (_KILLED, 0), tries=4),
    Fault("two runs in one cache, one of them killed", _two_runs, (0, _KILLED)),
    Fault("two versions in one cache at once", _two_versions, (0,), tries=2),
    Fault("damaged records", partial(_damaged, places=("records",)), (0,), keeps=False),
    Fault("damaged values", partial(_damaged, places=("blobs",)), (0,), keeps=False),
    Fault("damaged packs", partial(_damaged, places=("packs",)), (0,), keeps=False, tries=2),
    Fault("power is lost: the newest files are empty, zero or cut", _power_lost, (_KILLED,), keeps=False, tries=4),
    Fault(
        "the cache is removed in a unit",
        partial(_removed, place="cache"),
        (0, 3, 4),
        "cache|damaged|missing",
        keeps=False,
    ),
    Fault("the output folder is removed in a unit", partial(_removed, place="out"), (0, 4), _DENIED, tries=2),
    Fault(
        "`chmod 000` of a folder of the cache or of the output", _forbidden, (0, 3, 4), "cannot|[Pp]ermission", tries=4
    ),
)
"""Without those that take ten minutes."""

LONG = Fault(
    "SIGSTOP of all processes for ten minutes",
    partial(_stopped, whom="all"),
    (0,),
    tries=2,
    executors=("processes", "dask"),
)


@dataclass
class Row:
    """What came of the tries of one fault."""

    tried: int = 0
    held: int = 0
    impossible: str = ""


def attempt(fault: Fault, clean: Clean, number: int, *, folder: Path, seed: int = 0, pause_s: float = 5.0) -> list[str]:
    """Try a fault in a new folder; return what does not hold.

    Raises:
        ImpossibleHereError: if this machine or this user cannot have the fault.
    """
    folder.mkdir()
    executor = fault.executors[number % len(fault.executors)]
    with ExitStack() as stack:
        repairs = stack.enter_context(ExitStack())
        rng = random.Random(f"{seed} {number} {fault.kind}")
        number += random.Random(fault.kind).randrange(len(TOY_STAGES))
        case = Case(folder, clean, number, executor, rng, pause_s, repairs, stack)
        stack.callback(lambda: case.signal(signal.SIGKILL, case.processes()))
        ended = fault.disturb(case)
        wrong = [text for run in ended for text in _wrong_end(fault, case, run)]
        wrong += _orphans(case)
        repairs.close()
        left = intact(case.cache)
        if fault.keeps and case.kept - left:
            wrong.append(f"{len(case.kept - left)} of {len(case.kept)} results are lost")
        if not fault.keeps:
            maintenance.verify(Store(case.cache))  # what no unit had to read may be damaged still
        wrong += _not_healed(case, left)
        return [f"{fault.kind}, {executor}, {case.stage}: {text}" for text in wrong]


def _wrong_end(fault: Fault, case: Case, run: Ended) -> list[str]:
    text = f"exit code {run.code}: {run.said[-1500:]}"
    if run.code not in fault.codes:
        return [text]
    if run.code == 0:
        return _differences(run.out, case.clean.expected)
    is_named = run.code < 0 or (re.search(fault.says, run.said) and "Traceback" not in run.said)
    return [] if is_named and "internal error" not in run.said else [f"not named: {text}"]


def _differences(out: Path, expected: Mapping[str, bytes]) -> list[str]:
    found = deliverables(out)
    names = sorted(name for name in found.keys() | expected.keys() if found.get(name) != expected.get(name))
    return [f"{out.name} differs from an undisturbed run in {', '.join(names)}"] if names else []


def _orphans(case: Case) -> list[str]:
    deadline = time.monotonic() + _ORPHANS_S
    while (left := case.processes()) and time.monotonic() < deadline:
        time.sleep(0.1)
    return [f"{len(left)} processes are left"] if left else []


def _not_healed(case: Case, left: set[str]) -> list[str]:
    """Run the same once more without the fault; return what is not as it should be afterwards."""
    # In this process, because starting another takes most of the time of such a small run.
    summary = pano_mvs.run(case.clean.workflow, out=case.out, cache=case.cache, executor="serial").summary
    if summary.exit_code:
        return [f"the next run ended with {summary.exit_code}: {summary.stopped} {summary.failures}"]
    wrong = [f"after the next run, {text}" for text in _differences(case.out, case.clean.expected)]
    if summary.units.run > case.clean.units - len(left & intact(case.clean.cache)):
        wrong.append(f"the next run computed {summary.units.run} of {case.clean.units}, but {len(left)} were there")
    damage = maintenance.verify(Store(case.cache))
    found = [*damage.removed, *damage.incomplete, *damage.foreign, *half_written(case.cache)]
    return [*wrong, *(f"in the cache: {name}" for name in found)]


def schedule(count: int) -> list[tuple[Fault, int]]:
    """Return the tries of a run of `count`: each fault with its number of tries, in turn."""
    share = count / sum(fault.tries for fault in (*FAULTS, LONG))
    tries = [(fault, max(1, round(fault.tries * share))) for fault in FAULTS]
    return [(fault, number) for number in range(max(n for _, n in tries)) for fault, n in tries if number < n]


def main(
    count: int = 100, *, long_s: float = 600.0, pause_s: float = 5.0, at_once: int = 1, seed: int = 0, only: str = ""
) -> int:
    """Try all faults, print the table, and return the exit code.

    Args:
        count: how many tries, about.
        long_s: the pause of `LONG`, which goes on beside the others; 0 to leave it out.
        pause_s: the other pauses.
        at_once: how many tries go on at a time.
        seed: of what is random.
        only: a regular expression; faults of other kinds are left out.
    """
    rows: dict[str, Row] = {}
    started = time.monotonic()
    long = [(LONG, number) for number in range(LONG.tries if long_s else 0)]
    tries = [(fault, number) for fault, number in [*long, *schedule(count)] if re.search(only, fault.kind)]
    with (
        tempfile.TemporaryDirectory(prefix="pano-mvs-faults-") as name,
        ProcessPoolExecutor(at_once + len(long), mp_context=get_context("spawn")) as pool,
    ):
        (Path(name) / "clean").mkdir()
        clean = Clean.make(Path(name) / "clean")
        waiting: dict[Future[list[str]], str] = {}
        for place, (fault, number) in enumerate(tries):
            settings: Any = {"seed": seed, "pause_s": long_s if fault is LONG else pause_s}
            future = pool.submit(attempt, fault, clean, number, folder=Path(name) / str(place), **settings)
            waiting[future] = fault.kind
            rows[fault.kind] = Row()
        for future in as_completed(waiting):
            _enter(rows[waiting[future]], waiting[future], future)
    return _report(rows, time.monotonic() - started)


def _enter(row: Row, kind: str, future: Future[list[str]]) -> None:
    try:
        wrong = future.result()
    except ImpossibleHereError as error:
        row.impossible = str(error)
        return
    except AssertionError as error:  # the fault did not set in
        wrong = [f"{kind}: {error}"]
    row.tried += 1
    row.held += not wrong
    print("\n".join(wrong) or f"held: {kind}", flush=True)


def _report(rows: Mapping[str, Row], seconds: float) -> int:
    print(f"\n{'tried':>5} {'held':>5}  fault")
    for kind, row in rows.items():
        impossible = row.impossible and f" (not possible here: {row.impossible})"
        print(f"{row.tried:>5} {row.held:>5}  {kind}{impossible}")
    tried, held = (sum(getattr(row, name) for row in rows.values()) for name in ("tried", "held"))
    print(f"{tried:>5} {held:>5}  in {seconds:.0f} s")
    return 0 if tried and held == tried else 1
