"""What a plugin can change in its process so that later units compute something else: recorded, compared, restored.

The state is that of OpenCV, numpy, the random numbers of Python and numpy, the floating-point unit, the locale, the
working folder, the environment, the signal handlers, and the functions of the libraries that stages use.
"""

from __future__ import annotations

import ctypes
import locale
import os
import random
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from operator import attrgetter, is_
from types import FunctionType, ModuleType
from typing import Any

_LIBRARIES = {
    "builtins",
    "cv2",
    "io",
    "json",
    "math",
    "numba",
    "numpy",
    "os",
    "pano_mvs",
    "pycolmap",
    "scipy",
    "struct",
}
_FENV_BYTES = 512  # more than any system's fenv_t


@dataclass(frozen=True)
class ProcessState:
    """The state of this process at one moment.

    Attributes:
        settings: the value of each setting, by its name in words.
        libraries: what the loaded library modules hold.
    """

    settings: Mapping[str, Any]
    libraries: _Libraries

    @staticmethod
    def now() -> ProcessState:
        """Return the present state."""
        settings = {name: setting.read() for name, setting in _SETTINGS.items()}
        return ProcessState(settings, _Libraries.now())

    def restore(self) -> Changes:
        """Make the state as it was, and return what was different."""
        known = {name: value for name, value in self.settings.items() if value is not None}  # None: not loaded then
        settings = [name for name, value in known.items() if _SETTINGS[name].read() != value]
        for name in settings:
            _SETTINGS[name].write(self.settings[name])
        modules = _library_modules()
        if self.libraries.are_unchanged(modules):
            return Changes(tuple(settings))
        replaced = [f"{name}.{function}" for name, module in modules.items() for function in self._put_back(module)]
        return Changes(tuple(settings), tuple(replaced))

    def _put_back(self, module: ModuleType) -> Iterator[str]:
        """Put the functions of a module back, and yield the names of those that were replaced."""
        present = vars(module)
        for name, known in self.libraries.functions.get(module.__name__, {}).items():
            if present.get(name) is not known.value:
                setattr(module, name, known.value)
                yield name
            if known.code is not None and known.value.__code__ is not known.code:
                known.value.__code__ = known.code
                yield name


@dataclass(frozen=True)
class Changes:
    """What was different from an earlier state.

    Attributes:
        settings: names of settings, in words.
        functions: functions and classes that were replaced, such as `cv2.remap`.
    """

    settings: tuple[str, ...] = ()
    functions: tuple[str, ...] = ()

    def __bool__(self) -> bool:
        """Return whether anything was different."""
        return bool(self.settings or self.functions)

    def __str__(self) -> str:
        return ", ".join((*self.settings, *self.functions[:5], *(("…",) if len(self.functions) > 5 else ())))

    @property
    def deciding(self) -> Changes:
        """Those that change what other stages compute; libraries change the others for good reasons of their own."""
        return Changes(tuple(name for name in self.settings if _SETTINGS[name].decides), self.functions)


@contextmanager
def loading_plugin() -> Iterator[None]:
    """Import code from outside the package in this context: the state is as before afterwards."""
    _PLUGINS.loaded = True
    state = ProcessState.now()
    try:
        yield
    finally:
        state.restore()


def has_plugins() -> bool:
    """Return whether this process has loaded code from outside the package, which may change its state."""
    return _PLUGINS.loaded


class _Plugins:
    loaded = False


_PLUGINS = _Plugins()


@dataclass(frozen=True)
class _Function:
    value: Any
    code: Any


@dataclass(frozen=True)
class _Libraries:
    """What the loaded library modules hold: some 50,000 objects, which are compared without a loop in Python.

    Attributes:
        modules: the modules.
        content: of each module, its objects by name.
        python: the functions that are written in Python.
        codes: the code of each of those.
        functions: of each module, its functions and classes by name.
    """

    modules: list[ModuleType]
    content: list[dict[str, Any]]
    python: list[FunctionType]
    codes: list[object]
    functions: Mapping[str, Mapping[str, _Function]]

    @staticmethod
    def now() -> _Libraries:
        """Return what the modules hold now; unless something has changed, this is the latest record."""
        found = _library_modules()
        if _LATEST and _LATEST[0].are_unchanged(found):
            return _LATEST[0]
        modules = [*found.values()]
        content = [dict(vars(module)) for module in modules]
        functions = {name: _functions_of(module) for name, module in found.items()}
        known = [known for module in functions.values() for known in module.values() if known.code is not None]
        python, codes = [each.value for each in known], [each.code for each in known]
        _LATEST[:] = [_Libraries(modules, content, python, codes, functions)]
        return _LATEST[0]

    def are_unchanged(self, modules: Mapping[str, ModuleType]) -> bool:
        """Return whether the same modules hold the same objects, and functions have the same code."""
        try:
            return (
                [*modules.values()] == self.modules
                and [*map(vars, self.modules)] == self.content
                and [*map(attrgetter("__code__"), self.python)] == self.codes
            )
        except Exception:  # another array, say, is neither equal nor different
            return False


_LATEST: list[_Libraries] = []


@dataclass(frozen=True)
class _Setting:
    read: Callable[[], Any]
    write: Callable[[Any], object]
    decides: bool = False


def _library_modules() -> dict[str, ModuleType]:
    loaded = dict(sys.modules)
    if not (_CHOSEN and [*loaded] == [*_CHOSEN[0]] and all(map(is_, loaded.values(), _CHOSEN[0].values()))):
        chosen = {
            name: module
            for name, module in loaded.items()
            if name.partition(".")[0] in _LIBRARIES and type(module) is ModuleType and module.__name__ == name
        }
        _CHOSEN[:] = [loaded, chosen]
    return _CHOSEN[1]


_CHOSEN: list[dict[str, ModuleType]] = []


def _functions_of(module: ModuleType) -> dict[str, _Function]:
    return {
        name: _Function(value, value.__code__ if type(value) is FunctionType else None)
        for name, value in list(vars(module).items())
        if callable(value)
    }


def _library(name: str) -> Any:
    """Return a library if it is loaded."""
    return sys.modules.get(name)


def _numpy_random() -> tuple[Any, ...] | None:
    if _library("numpy") is None:
        return None
    name, keys, *rest = _library("numpy").random.get_state()
    return name, keys.tobytes(), *rest


def _set_numpy_random(state: tuple[Any, ...]) -> None:
    name, keys, *rest = state
    _library("numpy").random.set_state((name, _library("numpy").frombuffer(keys, "uint32"), *rest))


_SIGNALS = [*map(int, signal.valid_signals())]


def _handlers() -> dict[int, Any]:
    return {number: signal.getsignal(number) for number in _SIGNALS}


def _set_handlers(handlers: dict[int, Any]) -> None:
    if threading.current_thread() is threading.main_thread():
        for number, handler in handlers.items():
            if handler is not None and signal.getsignal(number) != handler:
                signal.signal(number, handler)


def _folder() -> str:
    try:
        return os.getcwd()  # noqa: PTH109  # no path is made of it
    except OSError:
        return ""  # it was deleted


def _set_folder(folder: str) -> None:
    with suppress(OSError):
        os.chdir(folder)


def _set_environment(variables: dict[str, str]) -> None:
    for name in set(os.environ) - set(variables):
        del os.environ[name]
    os.environ.update(variables)


@cache
def _mathematics() -> ctypes.CDLL:
    return ctypes.CDLL(None)


def _float_environment() -> _FloatEnvironment:
    buffer = ctypes.create_string_buffer(_FENV_BYTES)
    rounding = -1
    with suppress(OSError, AttributeError):  # no such library here
        _mathematics().fegetenv(buffer)
        rounding = _mathematics().fegetround()
    smallest = sys.float_info.min
    return _FloatEnvironment(rounding, smallest * 0.5 > 0, buffer)


def _set_float_environment(state: _FloatEnvironment) -> None:
    with suppress(OSError, AttributeError):
        _mathematics().fesetenv(state.buffer)


@dataclass(frozen=True)
class _FloatEnvironment:
    """Rounding and subnormal numbers; the buffer also holds the flags of past operations, which always differ."""

    rounding: int
    subnormal: bool
    buffer: Any

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, _FloatEnvironment):
            return NotImplemented
        return (self.rounding, self.subnormal) == (other.rounding, other.subnormal)

    __hash__ = None  # type: ignore[assignment]


_SETTINGS: Mapping[str, _Setting] = {
    "OpenCV's optimisation": _Setting(
        lambda: _library("cv2") and _library("cv2").useOptimized(),
        lambda value: _library("cv2").setUseOptimized(value),
        decides=True,
    ),
    "numpy's handling of errors": _Setting(
        lambda: _library("numpy") and _library("numpy").geterr(),
        lambda value: _library("numpy").seterr(**value),
        decides=True,
    ),
    "the floating-point modes": _Setting(_float_environment, _set_float_environment, decides=True),
    "the locale": _Setting(
        lambda: locale.setlocale(locale.LC_ALL), lambda value: locale.setlocale(locale.LC_ALL, value), decides=True
    ),
    "the random numbers of Python": _Setting(random.getstate, random.setstate),
    "the random numbers of numpy": _Setting(_numpy_random, _set_numpy_random),
    "the working folder": _Setting(_folder, _set_folder),
    "the environment": _Setting(lambda: dict(os.environ), _set_environment),
    "the signal handlers": _Setting(_handlers, _set_handlers),
}
