"""Kill runs at random and see that nothing is lost.

Two runs go on at the same time on one store, each into a folder of its own. Many times, at a random moment, one of them
gets a SIGKILL, or one of its worker processes does; a main process that was killed is started again with the same
command, and so is one that ended because a unit's worker was killed three times. Most moments are some units after
the kill before, so that every stage is met; the others are random times, so that starting and ending are met too.
Whenever both have come to their end, the files that they delivered must be, byte for byte, those of a clean run in a
store of its own, `cache verify` must find nothing damaged, and nothing half written may lie about. Then both start anew
in an empty store, until enough have been killed.

With `--packed`, results are moved into packs after every few files, so that runs also read what others are packing.
With `--full`, the disk of the store is full once in every round; a run that says so is started again with more room.

Without `--workflow`, a toy workflow whose stages take some hundredths of a second each. With it, any workflow; its
deliverables must be the same from run to run, as they are to be anyway.
"""

from __future__ import annotations

import math
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import typer

from pano_mvs.engine.cache.packs import RECORD, Packs
from tools.stress.captures import SLEEP_VARIABLE, deliverables, write_toy
from tools.stress.world import Disk, small_disk

_LOOK_S = 0.02
_LONGEST_S = 600.0
_FAILED_ITEMS = 3
_MOST_UNITS = 12
_SHARE_OF_TIMES = 0.25
_FULL = 4
PACKING = (
    "from pano_mvs.engine.cache import maintenance; maintenance._MIN_PACKED_FILES = 20; "
    "from pano_mvs.cli.app import main; main()"
)
"""The command `pano-mvs`, but packs are made of fewer files."""


class Moments:
    """When to kill: so many units after the kill before, or after a time; ever more seldom, so that runs end."""

    def __init__(self, rng: random.Random, typical_s: float) -> None:
        self._rng = rng
        self._longest_s = typical_s
        self._most_units = float(_MOST_UNITS)
        self.draw(0)

    def draw(self, records: int) -> None:
        """Choose the next moment."""
        by_time = self._rng.random() < _SHARE_OF_TIMES
        self._units = records + self._rng.uniform(1, self._most_units)
        self._time = time.monotonic() + (self._rng.uniform(0, 1) if by_time else 3) * self._longest_s
        self._longest_s *= 1.02
        self._most_units *= 1.05

    def has_come(self, records: int) -> bool:
        """Return whether it is time."""
        return records >= self._units or time.monotonic() > self._time


@dataclass
class Setting:
    """What is run, and how."""

    command: list[str]
    environment: dict[str, str]
    folder: Path
    disk: Disk | None = None

    @property
    def store(self) -> Path:
        """The store that the killed runs share."""
        return (self.disk.folder if self.disk else self.folder) / "store"


@dataclass
class Killed:
    """What was killed, and what came of it."""

    mains: int = 0
    workers: int = 0
    full: int = 0
    rounds: int = 0
    wrong: list[str] = field(default_factory=list)
    at: Counter[int] = field(default_factory=Counter)
    units: int = 0

    @property
    def total(self) -> int:
        return self.mains + self.workers


class Runner:
    """One of the runs: the same command again and again, until it ends of itself."""

    def __init__(self, setting: Setting, name: str, store: Path) -> None:
        self._setting = setting
        self._store = store
        self.out = setting.folder / name
        self.done = False
        self.process = self._start()

    def _start(self) -> subprocess.Popen[str]:
        command = [*self._setting.command, "--cache", str(self._store), "--out", str(self.out)]
        return subprocess.Popen(
            command,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env=self._setting.environment,
            cwd=self._setting.folder,
        )

    def look(self) -> str:
        """Start again if it was killed; return what is wrong, if anything."""
        code = self.process.poll()
        if code is None or self.done:
            return ""
        said, _ = self.process.communicate()
        if code == -signal.SIGKILL:
            self.process = self._start()
            return ""
        if code == _FAILED_ITEMS and "killed by SIGKILL" in said:
            self.process = self._start()
            return ""
        if self._setting.disk and code == _FULL and ("is full" in said or "No space left" in said):
            self._setting.disk.grow()
            self.process = self._start()
            return ""
        self.done = True
        return "" if code == 0 else f"{self.out.name} ended with exit code {code}:\n{said}"

    def kill(self, rng: random.Random, killed: Killed, records: int) -> None:
        """Kill the main process or one of its workers, whichever comes."""
        victim = rng.choice([self.process.pid, *children(self.process.pid)])
        try:
            os.kill(victim, signal.SIGKILL)
        except ProcessLookupError:
            return  # it has just ended
        if victim == self.process.pid:
            self.process.wait()
            killed.mains += 1
        else:
            killed.workers += 1
        killed.at[records] += 1

    def end(self) -> None:
        """Kill it for good."""
        if self.process.poll() is None:
            self.process.kill()
            self.process.communicate()


def children(process: int) -> list[int]:
    """Return the child processes of a process (Linux; elsewhere none are found, and main processes alone killed)."""
    found: list[int] = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[1]) == process and fields[0] != "Z":
            found.append(int(stat.parent.name))
    return found


def kill_runs(setting: Setting, count: int, rng: random.Random) -> Killed:
    """Kill until so many have been killed, and both runs have come to their end after that."""
    killed = Killed()
    started = time.monotonic()
    clean = Runner(setting, "clean", setting.folder / "clean-store")
    while not clean.done:
        time.sleep(_LOOK_S)
        wrong = clean.look()
        if wrong:
            killed.wrong.append(wrong)
            return killed
    typical_s = time.monotonic() - started
    expected = deliverables(clean.out)
    killed.units = records_in(setting.folder / "clean-store")
    while killed.total < count and not killed.wrong:
        killed.rounds += 1
        _one_round(setting, killed, count, rng, typical_s=typical_s, expected=expected)
        print(
            f"round {killed.rounds}: {killed.total} of {count} killed, "
            f"{killed.wrong[-1] if killed.wrong else 'all as it should be'}",
            flush=True,
        )
    return killed


def _one_round(
    setting: Setting,
    killed: Killed,
    count: int,
    rng: random.Random,
    *,
    typical_s: float,
    expected: dict[str, bytes],
) -> None:
    """Start two runs in an empty store and kill them, ever more seldom, until both have come to their end."""
    for path in (setting.folder / "a", setting.folder / "b", setting.store):
        shutil.rmtree(path, ignore_errors=True)
    runners = [Runner(setting, name, setting.store) for name in ("a", "b")]
    full_at = rng.uniform(1, killed.units) if setting.disk else math.inf
    moments, deadline = Moments(rng, typical_s), time.monotonic() + _LONGEST_S
    try:
        while not all(runner.done for runner in runners):
            time.sleep(_LOOK_S)
            killed.wrong.extend(filter(None, [runner.look() for runner in runners]))
            if killed.wrong or time.monotonic() > deadline:
                killed.wrong.append("it does not come to an end") if not killed.wrong else None
                return
            living, records = [runner for runner in runners if not runner.done], records_in(setting.store)
            if setting.disk and living and records >= full_at:
                setting.disk.fill()
                killed.full, full_at = killed.full + 1, math.inf
            if living and killed.total < count and moments.has_come(records):
                rng.choice(living).kill(rng, killed, records)
                moments.draw(records)
    finally:
        for runner in runners:
            runner.end()
    killed.wrong.extend(_faults(setting, runners, expected))


def records_in(store: Path) -> int:
    """Return how many units are done."""
    return len(record_keys(store))


def record_keys(store: Path) -> set[str]:
    """Return the keys of all records, in files of their own and in packs."""
    keys = {path.stem for path in (store / "records").glob("*/*.json")}
    return keys | {packed.digest for packed in Packs(store).each() if packed.kind == RECORD}


def _faults(setting: Setting, runners: list[Runner], expected: dict[str, bytes]) -> list[str]:
    faults: list[str] = []
    for runner in runners:
        found = deliverables(runner.out)
        names = [name for name in {*found, *expected} if found.get(name) != expected.get(name)]
        if names:
            faults.append(f"{runner.out.name} differs from a clean run in {', '.join(sorted(names))}")
    store = setting.store
    verified = subprocess.run(
        [sys.executable, "-m", "pano_mvs", "cache", "verify", "--cache", str(store)],
        capture_output=True,
        text=True,
        env=setting.environment,
        check=False,
    )
    if verified.returncode or ", 0 damaged" not in " ".join(verified.stdout.split()):
        faults.append(f"cache verify: {verified.stdout}{verified.stderr}")
    if "not of the cache" in verified.stdout:
        faults.append(f"left in the store: {verified.stdout}")
    faults.extend(_leftovers(setting, runners[0], store))
    return faults


def _leftovers(setting: Setting, runner: Runner, store: Path) -> list[str]:
    """Return what is wrong with a run that has nothing to compute, and with what it leaves in the store's `tmp/`.

    `cache verify` names what lies there, but that is no fault while runs may go on. The next run on a store removes
    what killed processes have left.
    """
    again = subprocess.run(
        [*setting.command, "--cache", str(store), "--out", str(runner.out)],
        capture_output=True,
        text=True,
        env=setting.environment,
        cwd=setting.folder,
        check=False,
    )
    faults = [] if "0 units computed" in again.stdout else [f"a run after all has units to compute:\n{again.stdout}"]
    left = half_written(store)
    return [*faults, f"half written files are left: {', '.join(left)}"] if left else faults


def half_written(store: Path) -> list[str]:
    """Return the files and folders in a store that a process was writing when it ended."""
    found = {*store.rglob(".tmp-*"), *(store / "tmp").glob("*")}
    return sorted(path.relative_to(store).as_posix() for path in found)


def main(
    count: Annotated[int, typer.Argument()] = 200,
    workflow: str = "",
    executor: str = "processes",
    workers: int = 2,
    seed: int = 0,
    more: list[str] | None = None,
    packed: bool = False,
    full: bool = False,
) -> int:
    """Kill, print what came of it, and return the exit code.

    Args:
        count: how many are killed.
        workflow: a workflow file or a preset; by default a toy.
        executor: serial, processes or dask.
        workers: of processes and dask.
        seed: of the moments.
        more: further arguments of `pano-mvs run`.
        packed: whether results are packed early.
        full: whether the disk of the store is full once a round; needs the right to mount.
    """
    with tempfile.TemporaryDirectory(prefix="pano-mvs-kills-") as name, ExitStack() as stack:
        folder = Path(name)
        disk = stack.enter_context(small_disk(folder / "disk")) if full else None
        if disk and not disk.is_mounted:
            raise SystemExit("--full needs the right to mount a disk")
        used = workflow or str(write_toy(folder))
        used = str(Path(used).absolute()) if Path(used).is_file() else used  # else a preset
        number = [] if executor == "serial" else ["--workers", str(workers)]
        program = ("-c", PACKING) if packed else ("-m", "pano_mvs")
        options = ["--executor", executor, *number, *(["--min-free", "0"] if full else []), *(more or ())]
        command = [sys.executable, *program, "run", used, *options]
        environment = os.environ | {SLEEP_VARIABLE: os.environ.get(SLEEP_VARIABLE, "0.05"), "COLUMNS": "400"}
        started = time.monotonic()
        killed = kill_runs(Setting(command, environment, folder, disk), count, random.Random(seed))
    quarters = [
        sum(n for done, n in killed.at.items() if quarter == min(3, 4 * done // max(1, killed.units)))
        for quarter in range(4)
    ]
    print(
        f"{killed.total} killed ({killed.mains} main processes, {killed.workers} workers; {quarters} in the quarters "
        f"of {killed.units} units) in {killed.rounds} rounds of two runs on one store, "
        f"the disk full {killed.full} times, "
        f"{time.monotonic() - started:.0f} s"
    )
    print("FAILED: " + "\n".join(killed.wrong) if killed.wrong else "deliverables as of a clean run, 0 bad records")
    return 1 if killed.wrong else 0
