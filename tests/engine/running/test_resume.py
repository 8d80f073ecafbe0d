from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

from tests.engine.conftest import Toy, finished_records, start, wait_for_records

EXEMPT = {"run.json", "report.html"}


def deliverables(toy: Toy) -> dict[str, bytes]:
    return {name: data for name, data in toy.deliverables().items() if name not in EXEMPT}


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
    output = "".join(resumed.communicate(timeout=120))
    assert resumed.returncode == 0, output
    assert f"{28 - kept} units computed, {kept} cached" in output
    assert deliverables(toy) == clean


def test_interrupt_ends_with_exit_code_130_and_says_how_to_go_on(toy: Toy) -> None:
    process = start(toy, sleep_s=0.3)
    wait_for_records(toy, process, 18)
    process.send_signal(signal.SIGINT)
    output = "".join(process.communicate(timeout=60))
    assert process.returncode == 130
    assert "run the same command again" in output
