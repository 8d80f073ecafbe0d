"""What a plugin can change in its process is noticed, named, and undone."""

from __future__ import annotations

import ctypes
import decimal
import gc
import locale
import logging
import math
import os
import random
import re
import resource
import signal
import socket
import sys
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path

import cv2
import numba
import numpy as np
import pytest

from pano_mvs.core import process_state, text
from pano_mvs.core.process_state import ProcessState, loading_plugin
from pano_mvs.geometry import Rigid3
from pano_mvs.scene import Panorama

_MOST_FILES = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
_UPWARD = 0x800  # FE_UPWARD of x86


def _replace_code() -> None:
    text.plural.__code__ = (lambda count, one, many="": "patched").__code__


CHANGES: dict[str, tuple[Callable[[], object], str]] = {
    "optimisation": (lambda: cv2.setUseOptimized(not cv2.useOptimized()), "OpenCV's optimisation"),
    "threads": (lambda: cv2.setNumThreads(cv2.getNumThreads() + 1), "OpenCV's threads"),
    "numpy errors": (lambda: np.seterr(divide="ignore", over="raise"), "numpy's handling of errors"),
    "random": (lambda: random.seed(1), "the random numbers of Python"),
    "numpy random": (lambda: np.random.seed(1), "the random numbers of numpy"),  # noqa: NPY002
    "folder": (lambda: os.chdir("/"), "the working folder"),
    "variable": (lambda: os.environ.update(OMP_NUM_THREADS="77"), "the environment"),
    "no variables": (os.environ.clear, "the environment"),
    "handler": (lambda: signal.signal(signal.SIGTERM, signal.SIG_IGN), "the signal handlers"),
    "locale": (lambda: locale.setlocale(locale.LC_ALL, "C.UTF-8"), "the locale"),
    "function": (lambda: setattr(cv2, "remap", None), "cv2.remap"),
    "numpy function": (lambda: delattr(np.linalg, "svd"), "numpy.linalg.svd"),
    "own function": (lambda: setattr(text, "shortened", str), "pano_mvs.core.text.shortened"),
    "code": (_replace_code, "pano_mvs.core.text.plural"),
    "builtin": (lambda: setattr(math, "floor", math.ceil), "math.floor"),
    "method": (lambda: setattr(Panorama, "load", None), "pano_mvs.scene.panorama.Panorama.load"),
    "property": (lambda: setattr(Rigid3, "center", property(repr)), "pano_mvs.geometry.transforms.Rigid3.center"),
    "inherited method": (lambda: setattr(Panorama, "__repr__", str), "pano_mvs.scene.panorama.Panorama.__repr__"),
    "method of a library": (lambda: delattr(np.poly1d, "deriv"), "numpy.poly1d.deriv"),
    "code of a method": (
        lambda: setattr(Rigid3.inverse, "__code__", (lambda self: self).__code__),
        "pano_mvs.geometry.transforms.Rigid3.inverse",
    ),
    "constant": (lambda: setattr(process_state, "_FENV_BYTES", 1), "pano_mvs.core.process_state._FENV_BYTES"),
    "shadowed builtin": (lambda: setattr(text, "len", max), "pano_mvs.core.text.len"),
    "module": (lambda: sys.modules.update(cv2=np), "cv2"),
    "umask": (lambda: os.umask(0o777), "the mode of new files (umask)"),
    "recursion": (lambda: sys.setrecursionlimit(5000), "the limits of the interpreter"),
    "collection": (gc.disable, "the limits of the interpreter"),
    "digits": (lambda: sys.set_int_max_str_digits(0), "the limits of the interpreter"),
    "warnings": (lambda: warnings.simplefilter("error"), "the filters of warnings"),
    "open files": (lambda: resource.setrlimit(resource.RLIMIT_NOFILE, (100, _MOST_FILES)), "the limits of the system"),
    "blocked": (
        lambda: signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM, signal.SIGUSR1}),
        "the blocked signals",
    ),
    "timer": (lambda: signal.setitimer(signal.ITIMER_REAL, 1000), "the timers"),
    "numba": (lambda: setattr(numba.config, "DISABLE_JIT", 7), "numba's options"),
    "temporary files": (lambda: setattr(tempfile, "tempdir", "/"), "the folder for temporary files"),
    "sockets": (lambda: socket.setdefaulttimeout(0.1), "the time limit of sockets"),
    "decimals": (lambda: setattr(decimal.getcontext(), "prec", 3), "decimal numbers"),
    "logging": (lambda: logging.disable(logging.CRITICAL), "the level of logging"),
    "rounding": (lambda: ctypes.CDLL(None).fesetround(_UPWARD), "the floating-point modes"),
}


@pytest.mark.parametrize("what", CHANGES)
def test_changes_are_named_and_undone(what: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    change, name = CHANGES[what]
    if what == "rounding" and (sys.platform != "linux" or os.uname().machine != "x86_64"):
        pytest.skip("the number of this mode is that of Linux on x86")
    monkeypatch.chdir(tmp_path)
    before = ProcessState.now()
    assert not before.restore()
    change()
    found = before.restore()
    assert str(found) == name
    assert not before.restore()
    assert (cv2.remap is not None, math.floor(0.5), text.plural(2, "file")) == (True, 0, "files")


def test_values_that_cannot_be_compared_hide_no_change(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(text, "table", np.zeros(2), raising=False)
    before = ProcessState.now()
    monkeypatch.setattr(text, "table", np.ones(2))
    assert not before.restore()
    monkeypatch.setattr(text, "shortened", str)
    assert str(before.restore()) == "pano_mvs.core.text.shortened"
    after = ProcessState.now()
    monkeypatch.setattr(text, "plural", str)
    assert str(after.restore()) == "pano_mvs.core.text.plural"


def test_only_what_decides_results_counts_against_built_in_stages() -> None:
    before = ProcessState.now()
    random.seed(1)
    os.environ["PANO_MVS_SOMETHING"] = "1"
    cv2.setUseOptimized(not cv2.useOptimized())
    assert str(before.restore().deciding) == "OpenCV's optimisation"


def test_loading_a_plugin_leaves_no_change(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(process_state, "_PLUGINS", process_state._Plugins())
    was = cv2.useOptimized()
    with loading_plugin():
        cv2.setUseOptimized(not was)
    assert cv2.useOptimized() == was
    assert process_state.has_plugins()


def test_workers_load_what_stages_import_later() -> None:
    """A plugin that imports a library first could change it before its state is recorded."""
    process_state.load_libraries()
    package = Path(process_state.__file__).parents[1]
    texts = [path.read_text(encoding="utf-8") for path in package.rglob("*.py")]
    imported = {name for text in texts for name in re.findall(r"(?:from|import) (scipy[\w.]*)", text)}
    assert len(imported) > 5
    assert imported <= sys.modules.keys()
