"""Run the jobs of a compiled sweep in threads.

The kernels release the GIL and write disjoint parts in a fixed arithmetic order, so the number of threads changes no
bit. numba's own parallel regions would take several times longer to compile, and their portable threading layer aborts
when two Python threads enter it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeAlias, TypeVar

import numba

Job = TypeVar("Job")
Pool: TypeAlias = ThreadPoolExecutor | None


@contextmanager
def workers() -> Iterator[Pool]:
    """Give as many threads as numba may use; None for a single one, which needs no pool."""
    if numba.get_num_threads() == 1:
        yield None
        return
    with ThreadPoolExecutor(numba.get_num_threads()) as pool:
        yield pool


def run_jobs(pool: Pool, work: Callable[[Job], object], jobs: Iterable[Job]) -> None:
    """Do all jobs and raise what the first of them raised."""
    for _ in map(work, jobs) if pool is None else pool.map(work, jobs):
        pass
