from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.engine.conftest import Toy
from tests.processes import heed_interrupts

EXEMPT = {"run.json", "report.html"}


def start(toy: Toy, *, sleep_s: float = 0.0) -> subprocess.Popen[str]:
    command = [
        sys.executable,
        "-m",
        "pano_mvs",
        "run",
        str(toy.folder / "wf.yaml"),
        "--cache",
        str(toy.folder / "cache"),
        "--out",
        str(toy.folder / "out"),
    ]
    return subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=os.environ | {"TOY_SLEEP_S": str(sleep_s)},
        preexec_fn=heed_interrupts,
    )


def finished_records(toy: Toy) -> int:
    return len(list((toy.folder / "cache" / "records").rglob("*.json")))


def deliverables(toy: Toy) -> dict[str, bytes]:
    return {name: data for name, data in toy.deliverables().items() if name not in EXEMPT}


def wait_for_records(toy: Toy, process: subprocess.Popen[str], count: int) -> None:
    deadline = time.monotonic() + 60
    while finished_records(toy) < count:
        assert process.poll() is None, process.stdout.read() if process.stdout else ""
        assert time.monotonic() < deadline
        time.sleep(0.01)


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="this system has no SIGKILL")
def test_killed_run_resumes_with_the_unfinished_units_only(toy: Toy, tmp_path: Path) -> None:
    toy.run(cache=tmp_path / "clean")
    clean = deliverables(toy)
    for path in sorted((toy.folder / "out").rglob("*"), reverse=True):
        path.unlink() if path.is_file() else path.rmdir()
    process = start(toy, sleep_s=0.2)
    wait_for_records(toy, process, 5 + 5 + 1 + 4 + 1 + 1 + 2)  # in the middle of the means
    os.kill(process.pid, signal.SIGKILL)
    process.communicate()
    kept = finished_records(toy)
    resumed = start(toy)
    output, _ = resumed.communicate(timeout=120)
    assert resumed.returncode == 0, output
    assert f"{28 - kept} units computed, {kept} cached" in output
    assert deliverables(toy) == clean


def test_interrupt_ends_with_exit_code_130_and_says_how_to_go_on(toy: Toy) -> None:
    process = start(toy, sleep_s=0.3)
    wait_for_records(toy, process, 18)
    process.send_signal(signal.SIGINT)
    output, _ = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "run the same command again" in output
