"""Rows of a panorama, handed to plain threads."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

_BAND_ROWS = 64


def for_bands(work: Callable[[tuple[int, int]], object], height: int, *, threads: int) -> None:
    """Call `work` with (first, end) of bands that make up all rows.

    Bands write disjoint rows, so the number of threads changes no bit.

    Args:
        work: called once for each band; compiled, it releases the GIL.
        height: number of rows.
        threads: how many bands to work on at a time.
    """
    bands = [(first, min(first + _BAND_ROWS, height)) for first in range(0, height, _BAND_ROWS)]
    if threads <= 1:
        for band in bands:
            work(band)
        return
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(work, bands))
