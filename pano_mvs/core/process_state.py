"""What a plugin can change in its process so that later units compute something else: recorded, compared, restored.

The state is that of OpenCV, numpy, numba, the random numbers of Python and numpy, the floating-point unit, the locale,
the working folder, the environment, signals, limits of the system and of the interpreter, the filters of warnings, and
the functions and classes of the libraries that stages use, with the methods of these classes.
"""

from __future__ import annotations

import builtins
import ctypes
import gc
import locale
import os
import random
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence, ValuesView
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from itertools import chain
from operator import is_
from types import CodeType, FunctionType, ModuleType
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
_LOADED_BY_STAGES = (
    "cv2",
    "scipy.cluster.hierarchy",
    "scipy.linalg",
    "scipy.ndimage",
    "scipy.optimize",
    "scipy.sparse.csgraph",
    "scipy.sparse.linalg",
    "scipy.spatial.transform",
    "scipy.special",
)
_FENV_BYTES = 512  # more than any system's fenv_t


@dataclass(frozen=True)
class ProcessState:
    """The state of this process at one moment."""

    settings: Mapping[str, Any]  # the value of each setting, by its name in words
    libraries: _Libraries  # what the loaded library modules hold

    @staticmethod
    def now(*, compared: bool = False) -> ProcessState:
        """Return the present state.

        Args:
            compared: whether the libraries were compared with their latest record a moment ago, and are not again.
        """
        settings = {name: setting.read() for name, setting in _SETTINGS.items()}
        return ProcessState(settings, _Libraries.now(compared=compared))

    def restore(self) -> Changes:
        """Make the state as it was, and return what was different."""
        replaced = tuple(self.libraries.put_back())  # first, since settings are read through these functions
        known = {name: value for name, value in self.settings.items() if value is not None}  # None: not loaded then
        settings = [name for name, value in known.items() if _SETTINGS[name].read() != value]
        for name in settings:
            _SETTINGS[name].write(self.settings[name])
        return Changes(tuple(settings), replaced)


@dataclass(frozen=True)
class Changes:
    """What was different from an earlier state."""

    settings: tuple[str, ...] = ()  # names of settings, in words
    functions: tuple[str, ...] = ()  # functions, classes and methods that were replaced, such as `cv2.remap`

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


def load_libraries() -> None:
    """Load what stages import when they need it, so that a plugin that changes it is noticed."""
    for name in _LOADED_BY_STAGES:
        import_module(name)


def has_plugins() -> bool:
    """Return whether this process has loaded code from outside the package, which may change its state."""
    return _PLUGINS.loaded


class _Plugins:
    loaded = False


_PLUGINS = _Plugins()


@dataclass(frozen=True)
class _Holder:
    """A module or a class of a library, and what it holds."""

    owner: ModuleType | type
    values: list[object]  # all its values, in their order
    guarded: Mapping[str, object]  # those of its values by name that may not be replaced
    codes: Mapping[FunctionType, CodeType]  # its functions that are written in Python, with their code
    classes: list[type]  # the classes of libraries among the values of a module

    @staticmethod
    def of(owner: ModuleType | type) -> _Holder:
        """Return what a module or a class holds now."""
        present, is_module = dict(vars(owner)), isinstance(owner, ModuleType)
        guarded = {name: value for name, value in present.items() if _is_guarded(owner, name, value)}
        codes = {value: value.__code__ for value in guarded.values() if type(value) is FunctionType}
        classes = [value for value in guarded.values() if is_module and isinstance(value, type)]
        return _Holder(owner, [*present.values()], guarded, codes, [*filter(_is_of_library, classes)])

    def is_unchanged(self) -> bool:
        """Return whether the owner holds the same objects, and functions have the same code."""
        present = [*vars(self.owner).values()]
        return (
            len(present) == len(self.values)
            and all(map(is_, present, self.values))
            and all(function.__code__ is code for function, code in self.codes.items())
        )

    def put_back(self) -> Iterator[str]:
        """Put back what was replaced, delete what overrides something, and yield the names of both."""
        present, owner = dict(vars(self.owner)), self.owner
        change, delete = (setattr, delattr) if isinstance(owner, ModuleType) else (type.__setattr__, type.__delattr__)
        name_of_owner = owner.__name__ if isinstance(owner, ModuleType) else f"{owner.__module__}.{owner.__qualname__}"
        for name, value in self.guarded.items():
            if present.get(name) is not value:
                change(owner, name, value)
                yield f"{name_of_owner}.{name}"
        for name in sorted(present.keys() - self.guarded.keys()):
            is_override = not isinstance(owner, ModuleType) or (name in vars(builtins) and not name.startswith("__"))
            if is_override and _is_guarded(owner, name, present[name]):
                delete(owner, name)
                yield f"{name_of_owner}.{name}"
        for function, code in self.codes.items():
            if function.__code__ is not code:
                function.__code__ = code
                yield f"{function.__module__}.{function.__qualname__}"


def _is_guarded(owner: ModuleType | type, name: str, value: object) -> bool:
    if isinstance(owner, type):
        return callable(value) or hasattr(type(value), "__get__")
    is_constant = name.isupper() and isinstance(value, int | float | str | tuple)
    return callable(value) or (is_constant and owner.__name__.startswith("pano_mvs."))


def _is_of_library(kind: type) -> bool:
    """Return whether a class belongs to a library whose classes stages use, and can be changed."""
    library = str(kind.__module__).partition(".")[0]
    immutable = 1 << 8  # Py_TPFLAGS_IMMUTABLETYPE
    return library in _LIBRARIES and library != "numba" and not kind.__flags__ & immutable


@dataclass(frozen=True)
class _Libraries:
    """What the loaded library modules and their classes hold: some 60,000 objects, compared in a few passes."""

    modules: Mapping[str, ModuleType]  # the modules by name
    holders: list[_Holder]
    views: Sequence[ValuesView[object]]  # the values of each, as they are at any time
    values: list[object]  # the values of all, in this order, when this was recorded
    functions: list[FunctionType]  # the functions that are written in Python
    codes: list[CodeType]  # the code of each of those

    @staticmethod
    def now(*, compared: bool) -> _Libraries:
        """Return what the modules hold now; unless something has changed, this is the latest record."""
        modules = _library_modules()
        if _LATEST and _LATEST[0].modules is modules and (compared or _LATEST[0].are_unchanged()):
            return _LATEST[0]
        known = {id(holder.owner): holder for holder in _LATEST[0].holders} if _LATEST else {}

        def held(owner: ModuleType | type) -> _Holder:
            holder = known.get(id(owner))
            return holder if holder is not None and holder.is_unchanged() else _Holder.of(owner)

        holders = [held(module) for module in modules.values()]
        classes = {id(kind): kind for holder in holders for kind in holder.classes}
        holders += [held(kind) for kind in classes.values()]
        codes = {function: code for holder in holders for function, code in holder.codes.items()}
        views = [vars(holder.owner).values() for holder in holders]
        values = [*chain.from_iterable(views)]
        _LATEST[:] = [_Libraries(modules, holders, views, values, [*codes], [*codes.values()])]
        return _LATEST[0]

    def are_unchanged(self) -> bool:
        """Return whether modules and classes hold the same objects, and functions have the same code."""
        try:
            present = [*chain.from_iterable(self.views)]
            return present == self.values and [function.__code__ for function in self.functions] == self.codes
        except Exception:  # another array, say, is neither equal nor different; or a thread has just changed a module
            return False

    def put_back(self) -> Iterator[str]:
        for name, module in self.modules.items():
            if sys.modules.get(name) is not module:
                sys.modules[name] = module
                yield name
        if not self.are_unchanged():
            for holder in self.holders:
                if not holder.is_unchanged():
                    yield from holder.put_back()


_LATEST: list[_Libraries] = []


@dataclass(frozen=True)
class _Setting:
    read: Callable[[], Any]
    write: Callable[[Any], object]
    decides: bool = False


def _library_modules() -> dict[str, ModuleType]:
    loaded = dict(sys.modules)
    if not (_CHOSEN and _same_modules(loaded, _CHOSEN[0])):
        chosen = {
            name: module
            for name, module in loaded.items()
            if name.partition(".")[0] in _LIBRARIES and type(module) is ModuleType and module.__name__ == name
        }
        if _CHOSEN and _same_modules(chosen, _CHOSEN[1]):
            chosen = _CHOSEN[1]  # others were loaded, such as a plugin
        _CHOSEN[:] = [loaded, chosen]
    return _CHOSEN[1]


def _same_modules(first: dict[str, ModuleType], second: dict[str, ModuleType]) -> bool:
    return [*first] == [*second] and all(map(is_, first.values(), second.values()))


_CHOSEN: list[dict[str, ModuleType]] = []


def _library(name: str) -> Any:
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


def _blocked_signals() -> set[int] | None:
    return {*signal.pthread_sigmask(signal.SIG_BLOCK, ())} if hasattr(signal, "pthread_sigmask") else None


def _timers() -> tuple[bool, ...] | None:
    return tuple(signal.getitimer(timer)[0] > 0 for timer in _TIMERS) if _TIMERS else None


def _stop_timers(running: tuple[bool, ...]) -> None:
    for timer, ran in zip(_TIMERS, running, strict=True):
        if not ran:
            signal.setitimer(timer, 0)


_TIMERS = [getattr(signal, name) for name in ("ITIMER_REAL", "ITIMER_VIRTUAL", "ITIMER_PROF") if hasattr(signal, name)]


def _limits() -> dict[int, tuple[int, int]] | None:
    resource = _resource()
    if resource is None:
        return None
    numbers = {value for name, value in vars(resource).items() if name.startswith("RLIMIT_")}
    return {number: resource.getrlimit(number) for number in sorted(numbers)}


def _set_limits(limits: dict[int, tuple[int, int]]) -> None:
    for number, both in limits.items():
        with suppress(ValueError, OSError):  # only root may raise what was lowered for good
            _resource().setrlimit(number, both)


@cache
def _resource() -> Any:
    try:
        return import_module("resource")
    except ImportError:  # Windows
        return None


def _temporary_folder() -> str | None:
    try:
        return _library("tempfile") and str(_library("tempfile").gettempdir())
    except OSError:  # there is none
        return None


def _mode_mask() -> int:
    mask = os.umask(0o077)  # for a moment, files that another thread makes can be read by their owner alone
    os.umask(mask)
    return mask


def _interpreter() -> tuple[Any, ...]:
    return sys.getrecursionlimit(), sys.getswitchinterval(), sys.get_int_max_str_digits(), gc.isenabled()


def _set_interpreter(state: tuple[Any, ...]) -> None:
    recursion, interval, digits, collects = state
    sys.setrecursionlimit(recursion)
    sys.setswitchinterval(interval)
    sys.set_int_max_str_digits(digits)
    (gc.enable if collects else gc.disable)()


def _set_warnings(filters: list[Any]) -> None:
    warnings.resetwarnings()  # what was decided by the other filters is forgotten
    warnings.filters[:] = filters  # type: ignore[index]


def _numba_options() -> dict[str, Any] | None:
    config = _library("numba.core.config")
    return config and {name: value for name, value in vars(config).items() if name.isupper()}


def _decimals() -> tuple[Any, ...] | None:
    context = _library("decimal") and _library("decimal").getcontext()
    return context and tuple(getattr(context, name) for name in _DECIMAL)


def _set_decimals(values: tuple[Any, ...]) -> None:
    for name, value in zip(_DECIMAL, values, strict=True):
        setattr(_library("decimal").getcontext(), name, value)


_DECIMAL = "prec", "rounding", "Emin", "Emax", "capitals", "clamp"


def _set_priority(priority: int) -> None:
    with suppress(OSError):  # only root may raise it
        os.setpriority(os.PRIO_PROCESS, 0, priority)


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
    "OpenCV's threads": _Setting(
        lambda: _library("cv2") and _library("cv2").getNumThreads(),
        lambda value: _library("cv2").setNumThreads(value),
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
    "the blocked signals": _Setting(
        _blocked_signals, lambda blocked: signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
    ),
    "the timers": _Setting(_timers, _stop_timers),
    "the limits of the system": _Setting(_limits, _set_limits),
    "the priority": _Setting(
        lambda: os.getpriority(os.PRIO_PROCESS, 0) if hasattr(os, "getpriority") else None, _set_priority
    ),
    "the mode of new files (umask)": _Setting(_mode_mask, os.umask),
    "the limits of the interpreter": _Setting(_interpreter, _set_interpreter),
    "the filters of warnings": _Setting(lambda: [*warnings.filters], _set_warnings),
    "numba's options": _Setting(_numba_options, lambda options: vars(_library("numba.core.config")).update(options)),
    "the folder for temporary files": _Setting(
        _temporary_folder, lambda folder: setattr(_library("tempfile"), "tempdir", folder)
    ),
    "the time limit of sockets": _Setting(
        lambda: _library("socket") and (_library("socket").getdefaulttimeout(),),
        lambda seconds: _library("socket").setdefaulttimeout(*seconds),
    ),
    "decimal numbers": _Setting(_decimals, _set_decimals),
    "the level of logging": _Setting(
        lambda: _library("logging") and _library("logging").root.manager.disable,
        lambda level: _library("logging").disable(level),
    ),
}
