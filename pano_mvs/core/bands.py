"""Process the rows of an image in bands, or a few things, in threads."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")

_BAND_ROWS = 32


def for_bands(work: Callable[[int, int], object], height: int, *, threads: int, band_rows: int = _BAND_ROWS) -> None:
    """Call `work(first_row, rows)` for bands that cover all rows.

    Bands are disjoint, so that results do not depend on the number of threads. Compiled work that releases the GIL runs
    in parallel; an exception in one band is raised here.

    Args:
        work: called once for each band, in any order.
        threads: number of bands to process at a time.
        band_rows: number of rows of a band; a call costs about 0.1 ms, which matters if rows are short.
    """
    firsts = range(0, height, band_rows)
    mapped(lambda first: work(first, min(band_rows, height - first)), firsts, threads=threads)


def mapped(work: Callable[[Item], Result], items: Iterable[Item], *, threads: int) -> list[Result]:
    """Return `work(item)` of each item, in their order, of as many at a time as there are threads."""
    if threads <= 1:
        return [work(item) for item in items]
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(work, items))
