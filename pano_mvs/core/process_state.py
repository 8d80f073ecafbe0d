"""What a plugin may change in its process so that later units compute something else: recorded and restored."""

from __future__ import annotations

import ctypes
import locale
import os
import random
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np


@dataclass(frozen=True)
class ProcessState:
    """The state of this process at one moment."""

    values: dict[str, Any]  # the value of each setting, by its name in words

    @staticmethod
    def now() -> ProcessState:
        """Return the present state."""
        return ProcessState({name: read() for name, (read, _) in _SETTINGS.items()})

    def restore(self) -> tuple[str, ...]:
        """Make the state as it was, and return the names of what was different, in words."""
        known = {name: value for name, value in self.values.items() if value is not None}  # None: not loaded then
        changed = []
        for name, value in known.items():
            read, write = _SETTINGS[name]
            if read() != value:
                write(value)
                changed.append(name)
        return tuple(changed)


@contextmanager
def restored_state() -> Iterator[list[str]]:
    """Run code from outside the package in this context: the state is as before afterwards.

    Yields:
        A list that holds the names of what was different at the end.
    """
    changes: list[str] = []
    state = ProcessState.now()
    try:
        yield changes
    finally:
        changes += state.restore()


def _cv2() -> Any:
    return sys.modules.get("cv2")


def _numpy_random() -> tuple[Any, ...]:
    name, keys, *rest = np.random.get_state(legacy=True)  # noqa: NPY002  # plugins may use it
    return name, np.asarray(keys).tobytes(), *rest


def _set_numpy_random(state: tuple[Any, ...]) -> None:
    name, keys, *rest = state
    np.random.set_state((name, np.frombuffer(keys, np.uint32), *rest))  # noqa: NPY002


def _folder() -> str:
    try:
        return os.getcwd()  # noqa: PTH109  # no path is made of it
    except OSError:
        return ""  # it was deleted


def _set_folder(folder: str) -> None:
    with suppress(OSError):
        os.chdir(folder)


_LIMITED = ("RLIMIT_NOFILE", "RLIMIT_AS", "RLIMIT_DATA", "RLIMIT_FSIZE")


def _limits() -> dict[str, tuple[int, int]]:
    """Return what the process may use, soft and hard; empty on Windows."""
    if sys.platform == "win32":
        return {}
    import resource

    return {name: resource.getrlimit(getattr(resource, name)) for name in _LIMITED if hasattr(resource, name)}


def _set_limits(limits: dict[str, tuple[int, int]]) -> None:
    if sys.platform == "win32":
        return
    import resource

    for name, (soft, hard) in limits.items():
        limited = getattr(resource, name)
        try:
            resource.setrlimit(limited, (soft, hard))
        except (ValueError, OSError):  # only root can raise the hard limit
            most = resource.getrlimit(limited)[1]
            is_possible = soft != resource.RLIM_INFINITY and soft <= most
            with suppress(ValueError, OSError):
                resource.setrlimit(limited, (soft if is_possible else most, most))


def _set_environment(variables: dict[str, str]) -> None:
    for name in set(os.environ) - set(variables):
        del os.environ[name]
    os.environ.update(variables)


def _set_warnings(filters: list[Any]) -> None:
    warnings.resetwarnings()  # what was decided by the other filters is forgotten
    warnings.filters[:] = filters  # type: ignore[index]


@cache
def _mathematics() -> ctypes.CDLL:
    return ctypes.CDLL("ucrtbase" if os.name == "nt" else None)


@dataclass(frozen=True)
class _FloatEnvironment:
    """Rounding and subnormal numbers; the buffer also holds the flags of past operations, which always differ."""

    rounding: int
    subnormal: bool
    buffer: Any

    @staticmethod
    def now() -> _FloatEnvironment:
        buffer, rounding = ctypes.create_string_buffer(512), -1  # more than any system's fenv_t
        with suppress(OSError, AttributeError):  # no such library here
            _mathematics().fegetenv(buffer)
            rounding = _mathematics().fegetround()
        smallest = sys.float_info.min
        return _FloatEnvironment(rounding, smallest * 0.5 > 0, buffer)

    def set(self) -> None:
        with suppress(OSError, AttributeError):
            _mathematics().fesetenv(self.buffer)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, _FloatEnvironment):
            return NotImplemented
        return (self.rounding, self.subnormal) == (other.rounding, other.subnormal)

    __hash__ = None  # type: ignore[assignment]


_SETTINGS: dict[str, tuple[Callable[[], Any], Callable[[Any], object]]] = {
    # The first two come first because restoring the others may take calls and files.
    "the recursion limit": (sys.getrecursionlimit, sys.setrecursionlimit),
    "the limits of memory and files": (_limits, _set_limits),
    "OpenCV's optimisation": (lambda: _cv2() and _cv2().useOptimized(), lambda value: _cv2().setUseOptimized(value)),
    "OpenCV's threads": (lambda: _cv2() and _cv2().getNumThreads(), lambda value: _cv2().setNumThreads(value)),
    "numpy's handling of errors": (np.geterr, lambda value: np.seterr(**value)),
    "the floating-point modes": (_FloatEnvironment.now, _FloatEnvironment.set),
    "the locale": (lambda: locale.setlocale(locale.LC_ALL), lambda value: locale.setlocale(locale.LC_ALL, value)),
    "the random numbers of Python": (random.getstate, random.setstate),
    "the random numbers of numpy": (_numpy_random, _set_numpy_random),
    "the working folder": (_folder, _set_folder),
    "the environment": (lambda: dict(os.environ), _set_environment),
    "the filters of warnings": (lambda: [*warnings.filters], _set_warnings),
}
