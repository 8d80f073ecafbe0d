"""How long a whole capture takes.

Runs the command line on a folder of pictures twice with stores of their own, so that the second run finds its kernels
compiled and nothing else, and prints wall and CPU seconds of the second: in all, and of each stage as the run itself
recorded them. CPU seconds include worker processes; on a busy machine they say more than wall seconds.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from tools.benchmarks.dense_chain import Overrides
from tools.benchmarks.table import print_table


def run_once(arguments: list[str], out: Path) -> tuple[float, float, dict[str, Any]]:
    """Return wall and CPU seconds of one run with a store of its own, and its summary."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    started = time.perf_counter()
    command = [sys.executable, "-m", "pano_mvs", "run", *arguments, "--out", str(out), "--cache", str(out / "store")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    wall = time.perf_counter() - started
    if done.returncode not in (0, 3):  # 3: finished, some pictures were left out
        raise SystemExit(done.stdout + done.stderr)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return wall, cpu, json.loads((out / "run.json").read_text(encoding="utf-8"))


def main(images: Path, workflow: str = "quickstart", overrides: Overrides = None, warm: bool = False) -> None:
    """Print the times of one workflow on one capture; with `warm`, the kernels are compiled, and one run is enough."""
    arguments = [workflow, "--images", str(images)]
    for override in overrides or ():
        arguments += ["--set", override]
    with tempfile.TemporaryDirectory() as scratch:
        if not warm:
            run_once(arguments, Path(scratch) / "first")
        wall, cpu, summary = run_once(arguments, Path(scratch) / "second")
    print(f"`{' '.join([workflow, *(overrides or ())])}`: {wall:.1f} s wall, {cpu:.1f} s CPU, {os.cpu_count()} cores\n")
    rows = ([stage["name"], stage["run"], f"{stage['unit_seconds']:.1f}"] for stage in summary["stages"])
    print_table(["stage", "units", "seconds in units"], rows)
