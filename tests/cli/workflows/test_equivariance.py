"""Laws of whole runs: what turns, names or executors change, and what they do not."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pano_mvs.cli import inspect_command as inspect_text
from pano_mvs.engine.cache.packs import RECORD
from pano_mvs.engine.cache.store import Store
from pano_mvs.results.figures import figure
from tests.cli.conftest import SMALL, deliverables

WAYS = {
    "serial": ("--executor", "serial", "--threads-per-worker", "2"),
    "two": ("--executor", "processes", "--workers", "2", "--threads-per-worker", "1"),
}


def stored(folder: Path) -> dict[str, object]:
    """Return the records of a store without their times, whether they have files of their own or are in packs."""
    store = Store(folder)
    keys = {path.stem for path in (folder / "records").rglob("*.json")}
    keys |= {packed.digest for packed in store.blobs.packs.each() if packed.kind == RECORD}
    records = {key: store.read_record(key) for key in sorted(keys)}
    return {key: record and replace(record, seconds=0.0) for key, record in records.items()}


def check_same_bytes(ways: Mapping[str, Sequence[str]], capture: Path, folder: Path) -> None:
    """Check that runs with some options each, by name, deliver and store the same."""
    # Nothing is bound from outside: what bounds the libraries is ours.
    unbound = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    first = next(iter(ways))
    for name, options in ways.items():
        command = [
            sys.executable,
            *f"-m pano_mvs run quickstart --images {capture}".split(),
            *SMALL,
            *["--set", "depth.planes=16", "--set", "views.sources=2", "--set", "images.max_width=256"],
            *options,
            *f"--out {folder / f'out-{name}'} --cache {folder / f'cache-{name}'}".split(),
        ]
        done = subprocess.run(command, env=unbound, capture_output=True, text=True, check=False, timeout=600)
        assert done.returncode == 0, done.stdout + done.stderr
        assert deliverables(folder / f"out-{name}") == deliverables(folder / f"out-{first}"), name
        assert stored(folder / f"cache-{name}") == stored(folder / f"cache-{first}"), name
    assert len(stored(folder / f"cache-{first}")) > 20
    assert len(deliverables(folder / f"out-{first}")) > 10


@pytest.mark.slow
def test_all_executors_give_the_same_bytes(rendered: Path, tmp_path: Path) -> None:
    check_same_bytes(WAYS, rendered, tmp_path)


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
