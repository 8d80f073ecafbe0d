"""A capture is divided into overlapping blocks, also where its path returns."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pano_mvs.algorithms.blocks import divide_capture
from pano_mvs.core.errors import UsageError

NAMES = [f"{idx:03d}.png" for idx in range(200)]


@given(count=st.integers(1, 200), size=st.integers(7, 80), overlap=st.integers(3, 30))
def test_blocks_cover_all_images_and_overlap(count: int, size: int, overlap: int) -> None:
    if 2 * overlap >= size:
        return
    blocks = divide_capture(NAMES[:count], size=size, overlap=overlap)
    assert sorted({name for block in blocks for name in block}) == NAMES[:count]
    assert max(map(len, blocks)) <= size
    for block, following in pairwise(blocks):
        assert len(set(block) & set(following)) == overlap
        assert block == sorted(block)


def test_a_loop_overlaps_at_its_ends() -> None:
    blocks = divide_capture(NAMES[:60], size=25, overlap=5, loop=True)
    assert len(set(blocks[-1]) & set(blocks[0])) == 5
    assert max(map(len, blocks)) <= 25


def test_blocks_share_images_where_the_path_returns() -> None:
    """The path goes to and fro: its end is beside its beginning."""
    along = np.concatenate([np.arange(50), np.arange(50)[::-1]])
    places = {
        name: np.array((x, 0.0, 0.3 * (idx >= 50))) for idx, (name, x) in enumerate(zip(NAMES, along, strict=False))
    }
    plain = divide_capture(NAMES[:100], size=40, overlap=6)
    closed = divide_capture(NAMES[:100], size=40, overlap=6, positions=places)
    assert len(plain) == len(closed) == 3
    assert not set(plain[0]) & set(plain[2])
    assert 3 <= len(set(closed[0]) & set(closed[2])) <= 6
    assert all(set(before) <= set(after) for before, after in zip(plain, closed, strict=True))


def test_settings_that_cannot_work() -> None:
    with pytest.raises(UsageError, match="an overlap of 2 is too small"):
        divide_capture(NAMES, size=20, overlap=2)
    with pytest.raises(UsageError, match="less than half of the size of a block, 20"):
        divide_capture(NAMES, size=20, overlap=10)
