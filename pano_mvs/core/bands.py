"""Process the rows of an image in bands, in threads."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

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
    if threads <= 1:
        for first in firsts:
            work(first, min(band_rows, height - first))
        return
    with ThreadPoolExecutor(threads) as pool:
        for _ in pool.map(lambda first: work(first, min(band_rows, height - first)), firsts):
            pass
