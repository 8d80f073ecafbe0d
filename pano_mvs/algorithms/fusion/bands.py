"""Process bands of a panorama's rows in threads."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

_BAND_ROWS = 64


def for_bands(work: Callable[[tuple[int, int]], object], height: int, *, threads: int) -> None:
    """Call `work` with (first, end) of bands that together cover all rows.

    Bands write disjoint rows, so the result does not depend on the number of threads.

    Args:
        work: called once for each band; compiled functions release the GIL.
        height: number of rows.
        threads: number of bands to process at a time.
    """
    bands = [(first, min(first + _BAND_ROWS, height)) for first in range(0, height, _BAND_ROWS)]
    if threads <= 1:
        for band in bands:
            work(band)
        return
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(work, bands))
