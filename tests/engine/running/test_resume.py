from __future__ import annotations

import os
import signal
import subprocess
import time
from pathlib import Path

import pytest

from tests.engine.conftest import PATIENCE_S, Toy, finished_records, start

EXEMPT = {"run.json", "report.html", "logs"}
BEFORE_MEANS = 5 + 5 + 1 + 4 + 1 + 1
"""The units of the stages above the means."""


def deliverables(toy: Toy) -> dict[str, bytes]:
    return {name: data for name, data in toy.deliverables().items() if name.split("/")[0] not in EXEMPT}


def hold_means(toy: Toy) -> Path:
    """Let means begin, and then wait as long as the file exists that is returned; each that waits leaves a mark."""
    hold = toy.folder / "hold"
    hold.touch()
    toy.edit(
        "plug.py",
        lambda text: text.replace(
            '    """Mean of the neighbours and the own."""',
            f'''    """Mean of the neighbours and the own."""
    import pathlib
    hold = pathlib.Path({str(hold)!r})
    if hold.exists(): hold.with_name(f"waits-{{own.value}}").touch()
    while hold.exists(): time.sleep(0.01)''',
        ),
    )
    return hold


def wait_for_means(toy: Toy, process: subprocess.Popen[str], count: int) -> None:
    """Wait until so many means wait."""
    deadline = time.monotonic() + PATIENCE_S
    while len(list(toy.folder.glob("waits-*"))) < count:
        assert process.poll() is None, process.stderr.read() if process.stderr else ""
        assert time.monotonic() < deadline
        time.sleep(0.01)


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="this system has no SIGKILL")
def test_killed_run_resumes_with_the_unfinished_units_only(toy: Toy, tmp_path: Path) -> None:
    hold = hold_means(toy)
    hold.unlink()
    toy.run(cache=tmp_path / "clean")
    clean = deliverables(toy)
    for path in sorted((toy.folder / "out").rglob("*"), reverse=True):
        path.unlink() if path.is_file() else path.rmdir()
    hold.touch()
    process = start(toy)
    wait_for_means(toy, process, 1)
    os.kill(process.pid, signal.SIGKILL)
    process.communicate()
    kept = finished_records(toy)
    assert kept == BEFORE_MEANS
    hold.unlink()
    resumed = start(toy)
    output = "".join(resumed.communicate(timeout=PATIENCE_S))
    assert resumed.returncode == 0, output
    assert f"{28 - kept} units computed, {kept} cached" in output
    assert deliverables(toy) == clean


@pytest.mark.slow
def test_interrupt_ends_with_exit_code_130_and_says_how_to_go_on(toy: Toy) -> None:
    hold_means(toy)
    process = start(toy)
    wait_for_means(toy, process, 1)
    process.send_signal(signal.SIGINT)
    output = "".join(process.communicate(timeout=PATIENCE_S))
    assert process.returncode == 130
    assert "run the same command again" in output
