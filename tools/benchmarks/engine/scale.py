"""Captures of thousands of panoramas.

For each size a simulated capture (see `simulated_capture`) goes through the commands as a user would call them: a plan
before anything is cached, a run that is interrupted half-way, its resumption, a run and a plan when all is cached,
status, report, a plan and a run after one picture has changed, and collections: one that has nothing to collect, and
one of everything. CPU time and peak memory are those of the command; the last line is the largest number of entries
of one folder in the cache and in the output folder.

Units are recorded without being computed (see `simulated_executor`); with `--real` they are, one after another.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import typer

from tools.benchmarks.engine.simulated_capture import UNITS_PER_PICTURE, write_picture, write_simulated
from tools.benchmarks.engine.simulated_executor import STOP_VARIABLE
from tools.benchmarks.table import print_table

Step = tuple[str, float, float, int, str]
"""Name, CPU seconds, peak in MB, exit code and last line of a command."""


def steps(folder: Path, count: int, module: str) -> Iterator[Step]:
    """Take one size through all steps.

    Args:
        folder: an empty one.
        count: number of panoramas.
        module: which is run as the command line.
    """
    workflow = str(write_simulated(folder, count))
    place = ["--cache", str(folder / "cache"), "--out", str(folder / "out")]
    run = ["run", workflow, *place, "--executor", "serial"]
    collect = ["cache", "gc", "--cache", str(folder / "cache")]

    def step(name: str, arguments: list[str], *, stop_after: int = 0) -> Step:
        environment = os.environ | {"COLUMNS": "200", STOP_VARIABLE: str(stop_after)}
        return _command(name, [sys.executable, "-m", module, *arguments], folder, environment)

    yield step("plan, nothing cached", ["plan", workflow, *place])
    yield step("run, interrupted half-way", run, stop_after=count * UNITS_PER_PICTURE // 2)
    yield step("run, resumed", run)
    yield step("run, all cached", run)
    yield step("plan, all cached", ["plan", workflow, *place])
    yield step("status", ["status", workflow, *place])
    yield step("report", ["report", str(folder / "out"), *place[:2]])
    yield step("cache gc", collect)
    write_picture(folder, count // 2, version=1)
    yield step("plan, one picture changed", ["plan", workflow, *place])
    yield step("run, one picture changed", run)
    yield step("cache gc --delete, everything", [*collect, "--unused", "0s", "--older-than", "0s", "--delete"])


def _command(name: str, command: list[str], folder: Path, environment: dict[str, str]) -> Step:
    output = folder / "said.txt"
    with output.open("wb") as stream:
        process = subprocess.Popen(command, stdout=stream, stderr=stream, env=environment)
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    cpu_s, said = usage.ru_utime + usage.ru_stime, output.read_text(errors="replace").strip().splitlines()
    return name, cpu_s, usage.ru_maxrss / 1000, process.returncode, said[-1] if said else ""


def main(
    counts: Annotated[list[int] | None, typer.Argument()] = None, folder: Path | None = None, real: bool = False
) -> None:
    """Measure each size and print a table of each.

    Args:
        counts: numbers of panoramas; default 1000, 2000 and 5000.
        folder: where the captures are made; default a temporary folder.
        real: compute the units.
    """
    module = "pano_mvs" if real else "tools.benchmarks.engine.simulated_executor"
    for count in counts or (1000, 2000, 5000):
        place = Path(tempfile.mkdtemp(prefix="pano-mvs-scale-", dir=folder)).absolute()
        units = count * UNITS_PER_PICTURE
        print(f"\n{count} panoramas, {units} units\n")
        columns = ["step", "CPU s", "CPU s per 1,000 units", "peak MB", "exit code", "last line"]
        try:
            print_table(
                columns,
                (
                    [name, f"{cpu_s:.1f}", f"{1000 * cpu_s / units:.3f}", f"{peak:.0f}", code, said]
                    for name, cpu_s, peak, code, said in steps(place, count, module)
                ),
            )
        finally:
            shutil.rmtree(place)
