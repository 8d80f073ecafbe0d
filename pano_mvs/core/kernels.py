"""The decorators of compiled kernels: with which options they are compiled, and by one process at a time."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

from numba import config, njit
from numba.core.compiler_lock import global_compiler_lock

from pano_mvs.core.kernel_cache import compilation_time

if os.name == "posix":
    import fcntl

_locked: set[str] = set()


def kernel(function: Callable[..., Any] | None = None, **options: Any) -> Any:
    """Compile a function at its first call and keep the code in the cache of `use_kernel_cache`.

    Workers often need the same kernel at the same time, because they start with units of the same stage. One of them
    compiles it, and the others wait and load the result.

    Args:
        function: a function with a body that numba supports.
        options: further options of `numba.njit`, such as `parallel`.
    """
    if function is None:
        return lambda decorated: kernel(decorated, **options)
    compiled = njit(cache=True, error_model="numpy", nogil=True, no_cfunc_wrapper=True, **options)(function)
    if not config.DISABLE_JIT:
        compile_or_load = compiled.compile

        def compile_once(signature: Any) -> Any:
            with _alone(function.__code__.co_filename):
                return compile_or_load(signature)

        compiled.compile = compile_once
    return compiled


def inlined(function: Callable[..., Any]) -> Any:
    """Insert a short function wherever a kernel calls it; no code of its own is compiled."""
    return njit(cache=True, error_model="numpy", nogil=True, inline="always")(function)


@contextmanager
def _alone(path: str) -> Iterator[None]:
    """Lock a file of kernels against other processes; it is locked once if its kernels call each other.

    Kernels call those of other files while they are compiled, but never in a circle, so that no two processes wait for
    each other. Without locks, as on some network file systems, every process compiles by itself.
    """
    with global_compiler_lock:  # of numba, for the threads of this process
        if path in _locked:
            yield
            return
        started, is_outermost = time.perf_counter(), not _locked
        _locked.add(path)
        try:
            with _file_lock(path):
                yield
        finally:
            _locked.remove(path)
            if is_outermost:
                compilation_time.seconds += time.perf_counter() - started


@contextmanager
def _file_lock(path: str) -> Iterator[None]:
    try:
        handle = os.open(path, os.O_RDONLY) if os.name == "posix" else -1
    except OSError:
        handle = -1
    if handle < 0:
        yield
        return
    try:
        with suppress(OSError):
            fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)
