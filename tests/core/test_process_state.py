"""What a plugin can change in its process is noticed, named, and undone."""

from __future__ import annotations

import ctypes
import locale
import os
import random
import subprocess
import sys
import warnings
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from pano_mvs.core import process_state
from pano_mvs.core.process_state import restored_state

_UPWARD = 0x800  # FE_UPWARD of x86
CHANGES: dict[str, tuple[Callable[[], object], str]] = {
    "optimisation": (lambda: cv2.setUseOptimized(not cv2.useOptimized()), "OpenCV's optimisation"),
    "threads": (lambda: cv2.setNumThreads(cv2.getNumThreads() + 1), "OpenCV's threads"),
    "numpy errors": (lambda: np.seterr(divide="ignore", over="raise"), "numpy's handling of errors"),
    "random": (lambda: random.seed(1), "the random numbers of Python"),
    "numpy random": (lambda: np.random.seed(1), "the random numbers of numpy"),  # noqa: NPY002
    "folder": (lambda: os.chdir("/"), "the working folder"),
    "variable": (lambda: os.environ.update(OMP_NUM_THREADS="77"), "the environment"),
    "no variables": (os.environ.clear, "the environment"),
    "locale": (lambda: locale.setlocale(locale.LC_ALL, "C.UTF-8"), "the locale"),
    "warnings": (lambda: warnings.simplefilter("error"), "the filters of warnings"),
    "recursion": (lambda: sys.setrecursionlimit(sys.getrecursionlimit() + 1), "the recursion limit"),
    "rounding": (lambda: ctypes.CDLL(None).fesetround(_UPWARD), "the floating-point modes"),
}


@pytest.mark.parametrize("what", CHANGES)
def test_changes_are_named_and_undone(what: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    change, name = CHANGES[what]
    if what == "rounding" and (sys.platform != "linux" or os.uname().machine != "x86_64"):
        pytest.skip("the number of this mode is that of Linux on x86")
    monkeypatch.chdir(tmp_path)
    with restored_state() as found:
        change()
    assert found == [name]
    with restored_state() as found:
        pass
    assert found == []


@pytest.mark.skipif(sys.platform == "win32", reason="limits of POSIX")
def test_a_lower_limit_of_open_files_is_undone() -> None:
    """Units after that of the plugin could open no files."""
    import resource

    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    with restored_state() as found:
        resource.setrlimit(resource.RLIMIT_NOFILE, (5, before[1]))
    assert resource.getrlimit(resource.RLIMIT_NOFILE) == before
    assert found == ["the limits of memory and files"]


def test_windows_has_its_floating_point_modes_in_a_library_of_that_name(monkeypatch: pytest.MonkeyPatch) -> None:
    names: list[str | None] = []

    def library(name: str | None) -> object:
        names.append(name)
        raise OSError("not found")

    monkeypatch.setattr(process_state, "_mathematics", process_state._mathematics.__wrapped__)
    monkeypatch.setattr(ctypes, "CDLL", library)
    monkeypatch.setattr(os, "name", "nt")
    process_state.ProcessState.now().restore()
    monkeypatch.undo()
    assert set(names) == {"ucrtbase"}  # there, None is a TypeError


@pytest.mark.skipif(sys.platform == "win32", reason="limits of POSIX")
def test_a_hard_limit_that_stays_low_leaves_the_soft_one_as_near_as_possible() -> None:
    """In a process of its own, as the limit cannot be raised again by everybody."""
    code = """
import resource
from pano_mvs.core.process_state import restored_state
kind = resource.RLIMIT_NOFILE
resource.setrlimit(kind, (200, 400))
for lowered, expected in ((300, 200), (100, 100)):
    with restored_state():
        resource.setrlimit(kind, (50, lowered))
    soft, hard = resource.getrlimit(kind)
    assert (soft, hard) in ((200, 400), (expected, lowered)), (soft, hard)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
