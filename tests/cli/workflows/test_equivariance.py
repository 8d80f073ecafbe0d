"""Laws of whole runs: what turns, names or executors change, and what they do not."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pano_mvs.cli import inspect_command as inspect_text
from pano_mvs.engine.cache.packs import RECORD
from pano_mvs.engine.cache.store import Store
from pano_mvs.results.figures import figure
from pano_mvs.testing.room import capture_poses, default_room
from tests.cli.conftest import deliverables, made_once
from tests.synthetic.capture_files import write_capture


def stored(folder: Path) -> dict[str, object]:
    """Return the records of a store without their times, whether they have files of their own or are in packs."""
    store = Store(folder)
    keys = {path.stem for path in (folder / "records").rglob("*.json")}
    keys |= {packed.digest for packed in store.blobs.packs.each() if packed.kind == RECORD}
    records = {key: store.read_record(key) for key in sorted(keys)}
    return {key: record and replace(record, seconds=0.0) for key, record in records.items()}


def run_into(folder: Path, capture: Path, *options: str) -> None:
    # Nothing is bound from outside: what bounds the libraries is ours.
    unbound = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    settings = ("depth.planes=16", "depth.near=1", "depth.far=40", "views.sources=2", "features.max_keypoints=1500")
    command = [
        sys.executable,
        *f"-m pano_mvs run quickstart --images {capture / 'images'}".split(),
        *(word for setting in settings for word in ("--set", setting)),
        *f"--out {folder / 'out'} --cache {folder / 'cache'}".split(),
        *options,
    ]
    done = subprocess.run(command, env=unbound, capture_output=True, text=True, check=False, timeout=600)
    assert done.returncode in (0, 3), done.stdout + done.stderr  # 3: a camera may be doubtful at this size


def check_same_bytes(options: Sequence[str], of_all_processes: Path, folder: Path) -> None:
    """Check that a run with some options delivers and stores what a serial one does."""

    def make(place: Path) -> None:
        write_capture(place / "capture", default_room(), capture_poses(3, spread=0.4), size_hw=(112, 224))
        run_into(place, place / "capture", "--executor", "serial", "--threads-per-worker", "2")

    serial = made_once(of_all_processes / "serial", make)
    run_into(folder, serial / "capture", *options)
    assert deliverables(folder / "out") == deliverables(serial / "out")
    assert stored(folder / "cache") == stored(serial / "cache")
    assert len(stored(folder / "cache")) > 20
    assert len(deliverables(folder / "out")) > 10


@pytest.mark.slow
def test_processes_give_the_same_bytes(of_all_processes: Path, tmp_path: Path) -> None:
    two = ("--executor", "processes", "--workers", "2", "--threads-per-worker", "1")
    check_same_bytes(two, of_all_processes, tmp_path)


@pytest.mark.parametrize(
    "shown",
    [
        figure(-0.0),
        figure([-0.0, 1.0]),
        inspect_text._vector(np.array([-1e-9, 0.0, 1.0])),
    ],
)
def test_zero_has_no_sign(shown: str) -> None:
    assert "-" not in shown
    assert "0" in shown
