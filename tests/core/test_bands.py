"""Processing the rows of an image in bands."""

from __future__ import annotations

import pytest

from pano_mvs.core.bands import for_bands


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("height", [0, 1, 32, 33, 200])
def test_bands_cover_every_row_once(height: int, threads: int) -> None:
    bands: list[tuple[int, int]] = []
    for_bands(lambda first, rows: bands.append((first, rows)), height, threads=threads)
    covered = [row for first, rows in bands for row in range(first, first + rows)]
    assert sorted(covered) == list(range(height))


@pytest.mark.parametrize("threads", [1, 3])
def test_an_error_in_a_band_is_raised(threads: int) -> None:
    def fail(first: int, rows: int) -> None:
        if first:
            raise ValueError(f"row {first}")

    with pytest.raises(ValueError, match="row 32"):
        for_bands(fail, 64, threads=threads)
