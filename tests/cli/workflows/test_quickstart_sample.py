"""The shipped quickstart on its own sample, full size: the promises that its summary makes."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.cli.conftest import deliverables, run_json

pytestmark = pytest.mark.slow


def command(folder: Path, *options: str) -> list[str]:
    return [
        sys.executable,
        *f"-m pano_mvs run quickstart --out {folder / 'out'} --cache {folder / 'cache'}".split(),
        *options,
    ]


SMALL = ("--set", "images.max_width=512", "--set", "depth.planes=48")


def test_poses_and_ranges_are_as_good_as_promised(tmp_path: Path, sample_cache: Path) -> None:
    subprocess.run(command(tmp_path, "--cache", str(sample_cache)), check=True)
    scores = run_json(tmp_path / "out")["scores"]
    assert scores["poses"]["registered"] == 4
    assert scores["poses"]["median_pair_error_deg"] <= 0.15
    assert scores["poses"]["scale_ratio_error_max"] <= 0.02
    first = scores["views"]["000.png"]
    assert first["psnr_db"] >= 28
    assert first["w_delta_105"] >= 0.65
    assert first["completeness"] >= 0.99, "slats of the blinds are part of the sky behind them, and frames at its edge"


def kill_in(stage: str, folder: Path) -> None:
    """Run until the first unit of a stage is computed, and kill the run while the others are in work."""
    process = subprocess.Popen([*command(folder, *SMALL), "--json"], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
    assert process.stdout is not None
    events = (json.loads(line) for line in process.stdout)
    assert any((event["event"], event.get("stage")) == ("unit_finished", stage) for event in events)
    process.kill()
    process.communicate()


def times_of_records(folder: Path) -> dict[Path, int]:
    return {path: path.stat().st_mtime_ns for path in (folder / "cache" / "records").rglob("*.json")}


def test_killed_in_the_middle_it_resumes_to_the_same_bytes(tmp_path: Path) -> None:
    """The run is killed twice: while it matches, and in the middle of the sweep."""
    undisturbed, killed = tmp_path / "undisturbed", tmp_path / "killed"
    for folder in (undisturbed, killed):
        folder.mkdir()
    finished = subprocess.run(command(undisturbed, *SMALL), check=False).returncode
    assert finished in (0, 3), "3: at this size, a camera may be doubtful"
    whole = len(times_of_records(undisturbed))
    kill_in("matches", killed)
    matched = times_of_records(killed)
    kill_in("depth", killed)
    swept = times_of_records(killed)
    assert 0 < len(matched) < len(swept) < whole
    assert subprocess.run(command(killed, *SMALL), check=False).returncode == finished
    resumed = times_of_records(killed)
    assert len(resumed) == whole
    assert matched.items() <= swept.items() <= resumed.items()  # what was computed is not computed again
    assert deliverables(killed / "out") == deliverables(undisturbed / "out")
