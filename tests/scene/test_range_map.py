"""A range map promises units, NaN for invalid, and normals of unit length if it has any."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.core.errors import ContractError
from pano_mvs.scene import RangeMap

SIZE = (4, 8)
RANGES, CONFIDENCE = np.full(SIZE, 2, np.float32), np.full(SIZE, 100, np.uint8)


def normals(first: tuple[float, float, float] = (0, 0, -1)) -> NDArray[np.float16]:
    result = np.full((*SIZE, 3), np.nan, np.float16)
    result[1] = first
    return result


@pytest.mark.parametrize("with_normals", [False, True])
def test_parts_give_back_the_map(with_normals: bool) -> None:
    before = RangeMap(RANGES, CONFIDENCE, normals() if with_normals else None)
    before.check()
    after = RangeMap.from_parts(before.to_parts())
    np.testing.assert_array_equal(after.range, before.range)
    np.testing.assert_array_equal(after.confidence, before.confidence)
    if with_normals:
        np.testing.assert_array_equal(after.normals_in_cam, before.normals_in_cam)
    else:
        assert after.normals_in_cam is None


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (normals(first=(0, 0, -1.5)), "unit length"),
        (normals().astype(np.float32), "must be float16"),
        (normals()[..., :2], "must have shape"),
    ],
)
def test_wrong_normals_are_named(wrong: NDArray[Any], said: str) -> None:
    with pytest.raises(ContractError, match=said):
        RangeMap(RANGES, CONFIDENCE, wrong).check()
