"""The largest channel, of any type, is what numpy's `max` gives."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.channels import largest_channel


@pytest.mark.parametrize("shape", [(5, 7, 3), (4, 1), (0, 3)])
@pytest.mark.parametrize("dtype", [np.uint8, np.int16, np.float32])
def test_the_largest_channel_is_the_maximum_of_the_last_axis(shape: tuple[int, ...], dtype: type) -> None:
    values: NDArray[Any] = (np.random.default_rng(0).random(shape) * 100 - 20).astype(dtype)
    found = largest_channel(values)
    assert found.dtype == values.dtype
    np.testing.assert_array_equal(found, values.max(axis=-1))


def test_a_channel_that_is_not_known_makes_the_pixel_unknown() -> None:
    values = np.array([[1, np.nan, 3], [4, 5, 6]], np.float32)
    np.testing.assert_array_equal(largest_channel(values), [np.nan, 6])
