"""What all tests share."""

from __future__ import annotations

import gc
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path

# Two threads of OpenBLAS cost more than twice the time of one on the small arrays in here; it reads this when numpy
# is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# pytest rewrites the assertions of 460 modules, and the processes that tests start import 400 of the package. Where
# Python is to write no byte code beside them, it is kept elsewhere, or each process would compile all of them again.
if sys.dont_write_bytecode:
    from pano_mvs.core.kernel_cache import user_cache_folder

    sys.dont_write_bytecode = False
    sys.pycache_prefix = str(user_cache_folder() / "pano-mvs" / "byte code of tests")
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    os.environ["PYTHONPYCACHEPREFIX"] = sys.pycache_prefix

# pycolmap's wheel shows its own zlib to whatever is loaded after it: if that is OpenCV, writing a PNG ends the process.
import cv2  # noqa: F401
import pytest
import typer.main
from hypothesis import HealthCheck, settings

from tests.plugin_packages import Packages, empty_doors, packages_in

# How long it takes to draw an example depends on what else the machine does. Laws that need more say so.
settings.register_profile("untimed", deadline=None, max_examples=50, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("untimed")
# A worker takes longer to start than most of the small runs in here take; tests of the executors name theirs.
os.environ.setdefault("PANO_MVS_EXECUTOR", "serial")
# The tests write 100,000 small files. Some disks need a millisecond to delete one, and memory does not.
MEMORY = Path("/dev/shm")
if MEMORY.is_dir() and shutil.disk_usage(MEMORY).free > 4 << 30:
    os.environ.setdefault("TMPDIR", str(MEMORY))
    tempfile.tempdir = None  # pytest has asked for the folder already
# What whoever runs the tests has among their own plugins is no part of them.
os.environ["PANO_MVS_PLUGINS"] = ""
os.environ["PANO_MVS_ENVIRONMENTS"] = ""

# Neither the commands nor what is installed changes during the tests. It takes 15 ms to make the commands, which each
# `CliRunner` would do anew, and 5 ms to look for plugins among 160 installed packages, as each session does.
pytest.MonkeyPatch().setattr("typer.testing._get_command", cache(typer.main.get_command))
pytest.MonkeyPatch().setattr("pano_mvs.engine.stages.registry.entry_points", cache(entry_points))


def pytest_collection_finish() -> None:
    """Leave the tests themselves, which stay until the end, out of the garbage collector's work, and let it rest."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000, 20, 20)


@pytest.fixture
def packages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Packages]:
    """Installed packages with plugins; none at first."""
    with packages_in(tmp_path / "site", monkeypatch) as found:
        yield found


@pytest.fixture
def mine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The user's plugin folder; empty at first."""
    folder = tmp_path / "mine"
    folder.mkdir()
    monkeypatch.setenv("PANO_MVS_PLUGINS", str(folder))
    with empty_doors(monkeypatch):
        yield folder
