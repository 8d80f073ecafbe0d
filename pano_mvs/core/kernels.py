"""The decorators of compiled kernels: with which options they are compiled, and by one process at a time."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any

from numba import config, njit
from numba.core.caching import IndexDataCacheFile
from numba.core.compiler_lock import global_compiler_lock
from numba.core.sigutils import normalize_signature
from numba.core.types.misc import unliteral

from pano_mvs.core.kernel_cache import PACKAGE, compilation_time, kernels_digest

if os.name == "posix":
    import fcntl

_locked: set[str] = set()
_own_digest = cache(kernels_digest)


def kernel(function: Callable[..., Any] | None = None, **options: Any) -> Any:
    """Compile a function at its first call and keep the code in the cache of `use_kernel_cache`.

    Workers often need the same kernel at the same time, because they start with units of the same stage. One of them
    compiles it, and the others wait and load the result.

    Args:
        options: further options of `numba.njit`, such as `parallel`.
    """
    if function is None:
        return lambda decorated: kernel(decorated, **options)
    compiled = njit(cache=True, error_model="numpy", nogil=True, no_cfunc_wrapper=True, **options)(function)
    if not config.DISABLE_JIT:
        compile_or_load, folder = compiled.compile, _cache_folder(compiled, function)

        def compile_once(signature: Any) -> Any:
            # For a call with a constant, such as `f(a, 0)`, numba would compile another copy for this constant.
            arguments = tuple(unliteral(argument) for argument in normalize_signature(signature)[0])
            with _alone(folder):
                return compile_or_load(arguments)

        compiled.compile = compile_once
    return compiled


def inlined(function: Callable[..., Any]) -> Any:
    """Insert a short function wherever a kernel calls it; no code of its own is compiled."""
    return njit(cache=True, error_model="numpy", nogil=True, inline="always")(function)


def _cache_folder(compiled: Any, function: Callable[..., Any]) -> str:
    """Return the folder of a kernel's code, which for our own kernels is named after the module instead of the file.

    Copies of the package in several environments share what one of them has compiled. Numba notices edits of the file
    that holds a kernel only; here, the digest of all kernel files decides whether code is still valid. Kernels
    elsewhere, of which the digest says nothing, are left to numba, and so are all if the cache cannot be written.
    """
    kept, root = compiled._cache, Path(config.CACHE_DIR)
    is_ours = Path(function.__code__.co_filename).is_relative_to(PACKAGE)
    if is_ours and Path(kept._cache_path).is_relative_to(root):
        digest = _own_digest()
        folder = str((root if root.name == digest else root / digest) / function.__module__)
        kept._impl.locator._cache_path = kept._cache_path = folder
        kept._cache_file = IndexDataCacheFile(folder, kept._impl.filename_base, digest)
    return str(kept._cache_path)


@contextmanager
def _alone(folder: str) -> Iterator[None]:
    """Lock the kernels of a module against other processes; they are locked once if they call each other.

    Kernels call those of other modules while they are compiled, but never in a circle, so that no two processes wait
    for each other. Without locks, as on some network file systems, every process compiles by itself.
    """
    with global_compiler_lock:  # of numba, for the threads of this process
        if folder in _locked:
            yield
            return
        started, is_outermost = time.perf_counter(), not _locked
        _locked.add(folder)
        try:
            with _file_lock(folder):
                yield
        finally:
            _locked.remove(folder)
            if is_outermost:
                compilation_time.seconds += time.perf_counter() - started


@contextmanager
def _file_lock(folder: str) -> Iterator[None]:
    handle = -1
    with suppress(OSError):
        Path(folder).mkdir(parents=True, exist_ok=True)
        handle = os.open(Path(folder) / "lock", os.O_RDWR | os.O_CREAT) if os.name == "posix" else -1
    if handle < 0:
        yield
        return
    try:
        with suppress(OSError):
            fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)
