"""Divide the cores among workers and threads, and limit numba, OpenCV and BLAS to their share.

BLAS always gets one thread: how it splits sums depends on the number of threads, and the same input must give the same
bytes with any number of workers.
"""

from __future__ import annotations

import importlib
import importlib.util
import os
import sys
from collections.abc import MutableMapping
from functools import cache
from pathlib import Path

WORKER_BYTES = 3_000_000_000  # memory of a worker, by which their number is chosen by default
_BLAS = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS", "BLIS_NUM_THREADS")
_OTHERS = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS")


def available_threads() -> int:
    """Return the number of cores that this process may use."""
    found = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    quota = _container_quota()
    return max(1, min(found, quota)) if quota else found


def share_cores(cores: int, *, workers: int = 0, threads: int = 0) -> tuple[int, int]:
    """Return the number of workers and of threads for each; an argument of 0 is derived from the other one."""
    if not workers:
        workers = max(1, cores // threads) if threads else cores
    return workers, threads or max(1, cores // workers)


def bound_environment(environment: MutableMapping[str, str], threads: int) -> None:
    """Limit libraries that are loaded later through environment variables; lower limits of the user are kept."""
    for names, bound in ((_BLAS, 1), (_OTHERS, threads)):
        for name in names:
            value = environment.get(name, "")
            environment[name] = str(min(int(value), bound) if value.isdigit() and int(value) else bound)


def bound_threads(threads: int) -> None:
    """Limit loaded libraries for one unit, and numba even if the unit loads it."""
    if "cv2" in sys.modules:
        sys.modules["cv2"].setNumThreads(threads)
    if "numba" in sys.modules:
        numba = sys.modules["numba"]
        numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))
    else:
        os.environ["NUMBA_NUM_THREADS"] = str(min(threads, _max_numba_threads()))
    _bound_blas()


@cache
def _max_numba_threads() -> int:
    """Return the limit in the environment when the first unit starts."""
    bound = os.environ.get("NUMBA_NUM_THREADS", "")
    return int(bound) if bound.isdigit() and int(bound) else available_threads()


@cache
def _bound_blas() -> None:
    """Limit a loaded BLAS; without threadpoolctl only the environment limits it, from the start."""
    if importlib.util.find_spec("threadpoolctl") is not None:
        importlib.import_module("threadpoolctl").threadpool_limits(1, user_api="blas")


def _container_quota() -> int:
    """Return the number of processors that a container may use; 0 if unlimited."""
    try:
        quota, period = Path("/sys/fs/cgroup/cpu.max").read_text(encoding="ascii").split()
        return 0 if quota == "max" else -(-int(quota) // int(period))
    except (OSError, ValueError):
        return 0
