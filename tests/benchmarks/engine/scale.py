"""Captures of thousands of panoramas: `python -m tests.benchmarks.engine.scale [COUNT…] [--folder DIR] [--real]`.

For each size a simulated capture (see `simulated_capture`) goes through the commands as a user would call them: a plan
before anything is cached, a run that is interrupted half-way, its resumption, a run and a plan when all is cached,
status, report, a plan and a run after one picture has changed, and collections: one that has nothing to collect, and
one of everything. CPU time and peak memory are those of the command; the last line is the largest number of entries
of one folder in the cache and in the output folder.

Units are recorded without being computed (see `simulated_executor`); with `--real` they are, one after another.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from tests.benchmarks.engine.simulated_capture import UNITS_PER_PICTURE, write_picture, write_simulated
from tests.benchmarks.engine.simulated_executor import STOP_VARIABLE

COUNTS = (1000, 2000, 5000)


@dataclass(frozen=True)
class Step:
    """What one command took.

    Attributes:
        name: of the step.
        cpu_s: of the command.
        wall_s: by the clock.
        peak_mb: of the command.
        exit_code: of the command.
        said: the last line that it printed.
    """

    name: str
    cpu_s: float
    wall_s: float
    peak_mb: float
    exit_code: int
    said: str


def measure(folder: Path, count: int, *, module: str, show: Callable[[Step], None]) -> None:
    """Take one size through all steps.

    Args:
        folder: an empty one.
        count: number of panoramas.
        module: which is run as the command line.
        show: called with each step.
    """
    workflow = str(write_simulated(folder, count))
    place = ["--cache", str(folder / "cache"), "--out", str(folder / "out")]
    run = ["run", workflow, *place, "--executor", "serial"]
    collect = ["cache", "gc", "--cache", str(folder / "cache")]

    def step(name: str, arguments: list[str], *, stop_after: int = 0) -> None:
        environment = os.environ | {"COLUMNS": "200", STOP_VARIABLE: str(stop_after)}
        show(_command(name, [sys.executable, "-m", module, *arguments], folder, environment))

    step("plan, nothing cached", ["plan", workflow, *place])
    step("run, interrupted half-way", run, stop_after=count * UNITS_PER_PICTURE // 2)
    step("run, resumed", run)
    step("run, all cached", run)
    step("plan, all cached", ["plan", workflow, *place])
    step("status", ["status", workflow, *place])
    step("report", ["report", str(folder / "out"), *place[:2]])
    step("cache gc", collect)
    write_picture(folder, count // 2, version=1)
    step("plan, one picture changed", ["plan", workflow, *place])
    step("run, one picture changed", run)
    print(
        f"entries: {_most_entries(folder / 'cache')} in the cache, {_most_entries(folder / 'out')} in the output, "
        f"{_count(folder / 'cache')} files in the cache",
        flush=True,
    )
    step("cache gc --delete, everything", [*collect, "--unused", "0s", "--older-than", "0s", "--delete"])


def _command(name: str, command: list[str], folder: Path, environment: dict[str, str]) -> Step:
    output = folder / "said.txt"
    started = time.perf_counter()
    with output.open("wb") as stream:
        process = subprocess.Popen(command, stdout=stream, stderr=stream, env=environment)
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    lines = output.read_text(errors="replace").strip().splitlines()
    return Step(
        name,
        usage.ru_utime + usage.ru_stime,
        time.perf_counter() - started,
        usage.ru_maxrss / 1000,
        process.returncode,
        lines[-1] if lines else "",
    )


def _most_entries(folder: Path) -> int:
    return max(len(folders) + len(files) for _, folders, files in os.walk(folder))


def _count(folder: Path) -> int:
    return sum(len(files) for _, _, files in os.walk(folder))


def main() -> None:
    """Measure each size and print a table of each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("counts", nargs="*", type=int, default=list(COUNTS))
    parser.add_argument("--folder", type=Path, help="where the captures are made; by default a temporary folder")
    parser.add_argument("--real", action="store_true", help="compute the units")
    arguments = parser.parse_args()
    module = "pano_mvs" if arguments.real else "tests.benchmarks.engine.simulated_executor"
    for count in arguments.counts:
        folder = Path(tempfile.mkdtemp(prefix="pano-mvs-scale-", dir=arguments.folder)).absolute()
        units = count * UNITS_PER_PICTURE
        print(
            f"\n{count} panoramas, {units} units\n\n| step | CPU s | CPU s per 1,000 units | peak MB | exit code |\n"
            "|---|---|---|---|---|"
        )

        def show(step: Step, units: int = units) -> None:
            print(
                f"| {step.name} | {step.cpu_s:.1f} | {1000 * step.cpu_s / units:.3f} | {step.peak_mb:.0f} | "
                f"{step.exit_code} | <!-- {step.wall_s:.0f} s by the clock: {step.said} -->",
                flush=True,
            )

        try:
            measure(folder, count, module=module, show=show)
        finally:
            shutil.rmtree(folder)


if __name__ == "__main__":
    main()
