"""Laws of whole runs: what turns, names or executors change, and what they do not."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pano_mvs_evaluation.ranges import tables as depth_tables

from pano_mvs.cli import inspect_command as inspect_text
from pano_mvs.engine.cache.packs import RECORD
from pano_mvs.engine.cache.store import Store
from pano_mvs.results.figures import figure
from tests.cli.conftest import SMALL, deliverables

WAYS = {
    "serial": ("--executor", "serial", "--threads-per-worker", "2"),
    "two": ("--executor", "processes", "--workers", "2", "--threads-per-worker", "1"),
    "dask": ("--executor", "dask", "--workers", "2"),
}


def stored(folder: Path) -> dict[str, object]:
    """Return the records of a store without their times, whether they have files of their own or are in packs."""
    store = Store(folder)
    keys = {path.stem for path in (folder / "records").rglob("*.json")}
    keys |= {packed.digest for packed in store.blobs.packs.each() if packed.kind == RECORD}
    records = {key: store.read_record(key) for key in sorted(keys)}
    return {key: record and replace(record, seconds=0.0) for key, record in records.items()}


@pytest.mark.slow
def test_all_executors_give_the_same_bytes(rendered: Path, tmp_path: Path) -> None:
    # Nothing is bound from outside: what bounds the libraries is ours.
    unbound = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    for name, options in WAYS.items():
        command = [
            sys.executable,
            *f"-m pano_mvs run quickstart --images {rendered}".split(),
            *SMALL,
            *["--set", "depth.planes=16", "--set", "views.sources=2"],
            *options,
            *f"--out {tmp_path / f'out-{name}'} --cache {tmp_path / f'cache-{name}'}".split(),
        ]
        done = subprocess.run(command, env=unbound, capture_output=True, text=True, check=False, timeout=600)
        assert done.returncode == 0, done.stdout + done.stderr
        assert deliverables(tmp_path / f"out-{name}") == deliverables(tmp_path / "out-serial"), name
        assert stored(tmp_path / f"cache-{name}") == stored(tmp_path / "cache-serial"), name
    assert len(stored(tmp_path / "cache-serial")) > 20
    assert len(deliverables(tmp_path / "out-serial")) > 10


@pytest.mark.parametrize(
    "shown",
    [
        figure(-0.0),
        figure([-0.0, 1.0]),
        depth_tables._shown("psnr_db", {"psnr_db": -0.0}),
        inspect_text._vector(np.array([-1e-9, 0.0, 1.0])),
    ],
)
def test_zero_has_no_sign(shown: str) -> None:
    assert "-" not in shown
    assert "0" in shown
