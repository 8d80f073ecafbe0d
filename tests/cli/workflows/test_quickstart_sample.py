"""The shipped quickstart on its own sample, full size: the promises that its summary makes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.cli.conftest import deliverables, run_json

pytestmark = pytest.mark.slow


def command(folder: Path) -> list[str]:
    return [
        sys.executable,
        "-m",
        "pano_mvs",
        "run",
        "quickstart",
        "--out",
        str(folder / "out"),
        "--cache",
        str(folder / "cache"),
    ]


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sample")
    subprocess.run(command(folder), check=True)
    return folder


def test_poses_and_ranges_are_as_good_as_promised(finished: Path) -> None:
    scores = run_json(finished / "out")["scores"]
    assert scores["poses"]["registered"] == 4
    assert scores["poses"]["median_pair_error_deg"] <= 0.15
    assert scores["poses"]["scale_ratio_error_max"] <= 0.02
    first = scores["views"]["000.png"]
    assert first["psnr_db"] >= 28
    assert first["w_delta_105"] >= 0.65
    assert first["completeness"] == 1.0


def test_second_run_computes_nothing(finished: Path) -> None:
    done = subprocess.run(command(finished), check=True, capture_output=True, text=True)
    assert "0 units computed" in done.stdout


@pytest.mark.parametrize("finished_units", [20, 24])  # while matching, and in the middle of the sweep
def test_killed_in_the_middle_it_resumes_to_the_same_bytes(finished: Path, tmp_path: Path, finished_units: int) -> None:
    process = subprocess.Popen(command(tmp_path), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    records = tmp_path / "cache" / "records"
    while len(list(records.rglob("*.json"))) < finished_units:
        assert process.poll() is None
        time.sleep(0.01)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    kept = len(list(records.rglob("*.json")))
    done = subprocess.run(command(tmp_path), check=True, capture_output=True, text=True)
    assert f"{kept} cached" in done.stdout
    assert deliverables(tmp_path / "out") == deliverables(finished / "out")
