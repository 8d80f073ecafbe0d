"""What the engine itself costs: `python -m tests.benchmarks.engine.overhead [UNITS]`.

A capture of UNITS small text files, read and scaled twice: three stages of UNITS units each whose own work is next to
nothing, so that the time of a run is the engine's. Times are the processor's (all processes) and the wall's; the limits
are on the processor time of each unit. Then: what two one-thread workers gain over one on units that only calculate,
beside what two plain processes gain on the same arithmetic.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from pano_mvs.engine.cache.store import Store
from pano_mvs.engine.executors.choose import SerialExecutor
from pano_mvs.engine.executors.processes import ProcessExecutor
from pano_mvs.engine.executors.protocol import Executor
from pano_mvs.engine.running.events import RunResult
from pano_mvs.engine.running.run import Run
from pano_mvs.session.session import open_session
from tests.engine.toy import HELPER, PLUGIN

UNITS = 5000
CACHED_LIMIT_MS = 0.1
EXECUTED_LIMIT_MS = 10.0
GAIN_LIMIT = 0.9
SPINS, SPIN_UNITS = 40_000_000, 16

WORKFLOW = """\
pano_mvs: 1
name: many
plugins: [plug.py]
stages:
  images: {use: toy.source, path: capture}
  scaled: {use: toy.scale, by: 3}
  again:  {use: toy.scale, by: 5, in: {x: scaled}}
"""
SPIN_WORKFLOW = """\
pano_mvs: 1
name: spin
plugins: [spin.py]
stages:
  images: {use: toy.source, path: capture}
  spun:   {use: toy.spin}
"""
SPIN = '''
import hashlib


def spin(seed: int, turns: int) -> float:
    """Only calculate: digests of digests, in C and with next to no memory."""
    block = seed.to_bytes(8, "little") * 4096
    for _ in range(turns // 100_000):
        block = hashlib.blake2b(block, digest_size=64).digest() * 512
    return float(block[0])
'''
SPIN_STAGE = """

@stage("toy.spin")
def spun(x: Each[Number]) -> Number:
    return Number(spin(int(x.value), {turns}))
"""


def main() -> None:
    """Print milliseconds for each unit and the gain of two workers, with the limits."""
    units = int(sys.argv[1]) if len(sys.argv) > 1 else UNITS
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "plug.py").write_text(PLUGIN)
        (folder / "helper.py").write_text(HELPER)
        (folder / "wf.yaml").write_text(WORKFLOW)
        _write_capture(folder / "capture", units)
        for label, make in _EXECUTORS.items():
            for what in ("executed", "cached"):
                _report_run(f"{label}, {what}", folder, make, cache=folder / label)
    with tempfile.TemporaryDirectory() as name:
        _report_gain(Path(name))


_EXECUTORS: dict[str, Callable[[Store], Executor]] = {
    "serial": lambda store: SerialExecutor(store, threads=1),
    "processes-1": lambda store: ProcessExecutor(store, workers=1, threads=1),
    "processes-2": lambda store: ProcessExecutor(store, workers=2, threads=1),
}


def _report_run(label: str, folder: Path, make: Callable[[Store], Executor], *, cache: Path) -> None:
    wall, before = time.perf_counter(), _processor_s()
    result = _run(folder, "wf.yaml", make, cache)
    wall, used = time.perf_counter() - wall, _processor_s() - before
    count = result.computed + result.cached
    own = sum(stage.unit_seconds for stage in result.stages)
    limit = EXECUTED_LIMIT_MS if result.computed else CACHED_LIMIT_MS
    print(
        f"{label:22s} {count} units, each: processor {1e3 * used / count:.3f} ms, wall {1e3 * wall / count:.3f} ms, "
        f"inside units {1e3 * own / count:.3f} ms (limit {limit} ms)",
        flush=True,
    )


def _report_gain(folder: Path) -> None:
    """Compare one worker with two, in turns with the control, so that what else the machine does hits both alike."""
    (folder / "spin.py").write_text(
        PLUGIN.replace("from helper import double", "double = lambda x: 2 * x") + SPIN + SPIN_STAGE.format(turns=SPINS)
    )
    (folder / "spin_wf.yaml").write_text(SPIN_WORKFLOW)
    _write_capture(folder / "capture", SPIN_UNITS)
    gains, controls = [], []
    for turn in range(3):
        one, two = (_spun_s(folder, workers, folder / f"cache-{turn}-{workers}") for workers in (1, 2))
        gains.append(one / two)
        one, two = _control_s(1), _control_s(2)
        controls.append(one / two)
    gain, control = max(gains), max(controls)
    print(
        f"two workers gain {gain:.2f}, two plain processes {control:.2f}: ratio {gain / control:.2f} "
        f"(limit {GAIN_LIMIT}); all turns: {_shown(gains)} beside {_shown(controls)}"
    )


def _spun_s(folder: Path, workers: int, cache: Path) -> float:
    """Return the seconds from the first unit that calculates to the last, with the workers running already."""
    result = _run(folder, "spin_wf.yaml", lambda store: ProcessExecutor(store, workers=workers, threads=1), cache)
    return next(stage.seconds for stage in result.stages if stage.name == "spun")


def _control_s(processes: int) -> float:
    """Return the seconds that plain processes take for the same arithmetic, without their start."""
    share = SPIN_UNITS // processes
    code = SPIN + f"\nimport sys\nsys.stdin.readline()\nfor seed in range({share}):\n    spin(seed, {SPINS})\n"
    running = [subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE) for _ in range(processes)]
    time.sleep(0.5)
    started = time.perf_counter()
    for process in running:
        assert process.stdin is not None
        process.stdin.write(b"go\n")
        process.stdin.flush()
    for process in running:
        process.communicate()
    return time.perf_counter() - started


def _run(folder: Path, workflow: str, make: Callable[[Store], Executor], cache: Path) -> RunResult:
    session = open_session(str(folder / workflow), cache=cache, out=folder / "out")
    store = Store(session.store_root)
    executor = make(store)
    try:
        return Run(session.workflow, session.graph, store, out=session.out, executor=executor).execute()
    finally:
        executor.close()


def _write_capture(folder: Path, count: int) -> None:
    folder.mkdir()
    past = time.time() - 60
    for number in range(count):
        path = folder / f"{number:05d}.txt"
        path.write_text(str(number + 100))
        os.utime(path, (past, past))


def _processor_s() -> float:
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def _shown(values: list[float]) -> str:
    return ", ".join(f"{value:.2f}" for value in values)


if __name__ == "__main__":
    main()
