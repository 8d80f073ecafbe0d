"""Bad items, killed workers and a full disk in one run.

Of many tiny panoramas one in a hundred is bad, in ten ways (see `bad_items`). The capture is run by worker processes,
or by a dask scheduler that exists. Workers are killed at random moments. Once the disk of the cache is full: the run
must end with exit code 4, and the same command goes on when there is room. A worker's death costs a unit one of three
tries; where a good item was hit three times, the same command is given again. In the end the exit code must be 3,
exactly the bad items must have failed, all that is delivered must be, byte for byte, what a clean run delivers of the
same capture without its bad items, and the cache must be undamaged, with nothing half written left in it.

The disk is a small tmpfs that grows where we may mount one (as root), else the plugin of the workflow plays it. A dask
scheduler and its workers are started as a person would start them.
"""

from __future__ import annotations

import json
import os
import random
import resource
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import typer

from tools.stress.bad_items import Capture, write_capture
from tools.stress.captures import deliverables
from tools.stress.kills import children
from tools.stress.world import Disk, small_disk

_FULL_EXIT, _FAILED_EXIT = 4, 3
_MOST_RUNS = 8
_LONGEST_S = 3 * 3600
_LOOK_S = 0.2
_OURS = "pano_mvs"


@dataclass
class Verdict:
    """What came of a load.

    Attributes:
        wrong: what is not as it must be.
        runs: how often the command was given.
        killed: how many workers were.
        cpu_s: of all processes.
        wall_s: from the first command to the last.
        peak_mb: of the largest process.
        units: that were computed, or failed, in all runs.
    """

    wrong: list[str] = field(default_factory=list)
    runs: int = 0
    killed: int = 0
    cpu_s: float = 0.0
    wall_s: float = 0.0
    peak_mb: float = 0.0
    units: int = 0


class Killer:
    """Kills random worker processes below some processes, after so many seconds each in the mean."""

    def __init__(self, kills: int, every_s: float, seed: int) -> None:
        self.killed = 0
        self._left = kills
        self._every_s = every_s
        self._rng = random.Random(seed)

    def watch(self, process: subprocess.Popen[bytes], others: list[int]) -> int:
        """Kill until the process ends; return its exit code."""
        due = time.monotonic() + self._rng.uniform(0, 2 * self._every_s)
        deadline = time.monotonic() + _LONGEST_S
        while process.poll() is None:
            time.sleep(_LOOK_S)
            if time.monotonic() > deadline:
                process.kill()
            if self._left and time.monotonic() > due:
                due = time.monotonic() + self._rng.uniform(0, 2 * self._every_s)
                self._kill([process.pid, *others])
        return process.returncode

    def _kill(self, roots: list[int]) -> None:
        victims = sorted(_workers_below(roots))
        if victims:
            try:
                os.kill(self._rng.choice(victims), signal.SIGKILL)
            except ProcessLookupError:
                return  # it has just ended
            self._left -= 1
            self.killed += 1


def load(
    folder: Path,
    *,
    count: int,
    bad: int,
    executor: str = "processes",
    workers: int = 2,
    kills: int = 5,
    every_s: float = 3.0,
    seed: int = 0,
) -> Verdict:
    """Run a capture with all that can go wrong, and compare with a clean run; `folder` is an empty one."""
    capture = write_capture(folder / "capture", count=count, bad=bad, seed=seed)
    clean = _command(capture.clean, folder / "clean-cache", folder / "clean", "--executor", "serial")
    done = subprocess.run(clean, capture_output=True, text=True, check=False, cwd=folder)
    if done.returncode != 0:
        return Verdict([f"the clean run ended with {done.returncode}: {done.stdout}{done.stderr}"])
    verdict, killer = Verdict(), Killer(kills, every_s, seed)
    started, before = time.monotonic(), resource.getrusage(resource.RUSAGE_CHILDREN)
    with small_disk(folder / "disk") as disk:
        options = ["--executor", executor, "--workers", str(workers), "--min-free", "0"]
        none: AbstractContextManager[tuple[str, list[int]]] = nullcontext(("", []))
        with _dask_cluster(folder / "cluster", workers, disk) if executor == "dask" else none as (address, others):
            options += ["--scheduler", address] if address else []
            command = _command(capture.workflow, disk.folder / "cache", folder / "out", *options)
            _until_it_ends(command, others, disk, killer, verdict, folder=folder, half=2 * count + count // 10)
        verdict.killed, verdict.wall_s = killer.killed, time.monotonic() - started
        verdict.wrong += _differences(folder, capture, disk.folder / "cache")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    verdict.cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    verdict.peak_mb = after.ru_maxrss / 1000
    return verdict


def _until_it_ends(
    command: list[str], others: list[int], disk: Disk, killer: Killer, verdict: Verdict, *, folder: Path, half: int
) -> None:
    """Give a command until nothing but bad items fails: after the disk was full, and where good items were hit."""
    was_full = False
    while verdict.runs < _MOST_RUNS:
        verdict.runs += 1
        with (folder / "said.txt").open("wb") as said:
            process = subprocess.Popen(command, stdout=said, stderr=said, cwd=folder, env=disk.environment)
            filling = threading.Thread(target=disk.fill_after, args=(half, process))
            if not was_full:
                filling.start()
            code = killer.watch(process, others)
        if not was_full:
            filling.join()
        last = _run_json(folder / "out")
        verdict.units += last.get("units", {}).get("run", 0) + last.get("units", {}).get("failed", 0)
        if code == _FULL_EXIT and not was_full:
            was_full = True
            disk.grow()
            continue
        if code != _FAILED_EXIT or not was_full:
            text = (folder / "said.txt").read_text(errors="replace")[-2000:]
            verdict.wrong.append(f"exit code {code}, {'after' if was_full else 'before'} the disk was full: {text}")
            return
        if not any("SIGKILL" in failure["cause"] for failure in last["failures"]):
            return
    verdict.wrong.append(f"not at its end after {_MOST_RUNS} runs")


def _differences(folder: Path, capture: Capture, cache: Path) -> list[str]:
    """Return what is not as a clean run has it, which items failed that are good, and what is left in the cache."""
    expected, found = deliverables(folder / "clean"), deliverables(folder / "out")
    wrong = [f"{name} is missing" for name in sorted(expected.keys() - found.keys())]
    wrong += [f"{name} should not be there" for name in sorted(found.keys() - expected.keys())]
    wrong += [f"{name} differs" for name in sorted(expected.keys() & found.keys()) if expected[name] != found[name]]
    last = _run_json(folder / "out")
    failed = {failure["item"] for failure in last.get("failures", [])}
    wrong += [f"{name} should have failed: {capture.bad[name]}" for name in sorted(capture.bad.keys() - failed)]
    wrong += [f"{name} should not have failed" for name in sorted(failed - capture.bad.keys())]
    command = [sys.executable, "-m", _OURS, "cache", "verify", "--cache", str(cache)]
    verified = subprocess.run(command, capture_output=True, text=True, check=False)
    if verified.returncode or "not of the cache" in verified.stdout:
        wrong.append(f"cache verify: {verified.stdout}{verified.stderr}")
    left = [path.name for path in (cache / "tmp").glob("*") if path.name.startswith(".tmp-")]
    return wrong + [f"left in the cache: {name}" for name in left]


@contextmanager
def _dask_cluster(folder: Path, workers: int, disk: Disk) -> Iterator[tuple[str, list[int]]]:
    """Start a scheduler and workers; yield its address and the processes below which units are computed."""
    folder.mkdir()
    environment = disk.environment | {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    address_file = folder / "scheduler.json"

    def start(*command: str) -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            [sys.executable, "-m", *command, "--scheduler-file", str(address_file)],
            cwd=folder,
            env=environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )

    processes = [start("distributed.cli.dask_scheduler", "--port", "0", "--no-dashboard")]
    try:
        while not address_file.exists():
            time.sleep(_LOOK_S)
        processes += [start("distributed.cli.dask_worker", "--nthreads", "1", "--no-dashboard") for _ in range(workers)]
        address = json.loads(address_file.read_text())["address"]
        from distributed import Client

        connect: Any = Client  # which has no types
        with connect(address, timeout=60, set_as_default=False) as client:
            client.wait_for_workers(workers, timeout=120)
        yield address, [process.pid for process in processes[1:]]
    finally:
        for process in reversed(processes):
            process.terminate()
        for process in processes:
            process.wait()


def _workers_below(roots: list[int]) -> Iterator[int]:
    """Yield the processes below others in which units are computed."""
    for process in roots:
        for child in children(process):
            try:
                is_worker = b"executors.worker" in Path(f"/proc/{child}/cmdline").read_bytes()
            except OSError:
                continue
            if is_worker:
                yield child
            yield from _workers_below([child])


def _command(workflow: Path, cache: Path, out: Path, *options: str) -> list[str]:
    return [sys.executable, "-m", _OURS, "run", str(workflow), "--cache", str(cache), "--out", str(out), *options]


def _run_json(out: Path) -> dict[str, Any]:
    try:
        found = json.loads((out / "run.json").read_bytes())
    except (OSError, ValueError):
        return {}
    return dict(found)


def main(
    count: Annotated[int, typer.Argument()] = 2000,
    bad: int = 0,
    executors: list[str] | None = None,
    workers: int = 2,
    kills: int = 20,
    every_s: float = 10.0,
    folder: Path | None = None,
    seed: int = 0,
) -> int:
    """Load each executor, print what came of it, and return the exit code.

    Args:
        count: number of panoramas.
        bad: how many of them are bad; by default one in a hundred, ten at least.
        executors: one after the other; default processes and dask.
        workers: number of worker processes.
        kills: how many workers are killed.
        every_s: mean time between two kills.
        folder: where all is made; default a temporary folder.
        seed: of what is bad and of the kills.
    """
    bad, failed = bad or max(10, count // 100), False
    settings: dict[str, Any] = {"workers": workers, "kills": kills, "every_s": every_s, "seed": seed}
    for executor in executors or ("processes", "dask"):
        with tempfile.TemporaryDirectory(prefix="pano-mvs-load-", dir=folder) as name:
            verdict = load(Path(name), count=count, bad=bad, executor=executor, **settings)
        per_unit_ms = 1000 * verdict.cpu_s / max(1, verdict.units)
        print(
            f"{executor}: {count} panoramas, {bad} bad, {verdict.units} units, {verdict.killed} workers "
            f"killed, {verdict.runs} runs, {verdict.wall_s:.0f} s, {verdict.cpu_s:.0f} CPU s "
            f"({per_unit_ms:.0f} ms a unit), peak {verdict.peak_mb:.0f} MB",
            *verdict.wrong[:20],
            sep="\n  WRONG: ",
            flush=True,
        )
        failed |= bool(verdict.wrong)
    print("FAILED" if failed else "all that was delivered is as of a clean run, and only what is bad is missing")
    return int(failed)
