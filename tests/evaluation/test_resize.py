"""Range maps at another size: exact on planes, nothing between two surfaces."""

from __future__ import annotations

import numpy as np
import pytest

from pano_mvs.core.errors import UsageError
from pano_mvs.evaluation.ranges.pairs import resized_labels, resized_range
from tests.algorithms.range_scenes import box_range


@pytest.mark.parametrize(("old", "new"), [((64, 128), (128, 256)), ((128, 256), (64, 128)), ((48, 96), (64, 128))])
def test_walls_keep_their_distance(old: tuple[int, int], new: tuple[int, int]) -> None:
    """A walk over the seam and over both poles: the box is closed, its truth known in closed form at any size."""
    found, true = resized_range(box_range(old)[0], new), box_range(new)[0]
    error = np.abs(found / true - 1)
    nearest = np.abs(resized_labels(box_range(old)[0], new) / true - 1)
    for part in (np.s_[:], np.s_[:2], np.s_[-2:], np.s_[:, [0, -1]]):
        assert np.median(error[part]) < 6e-4
    assert np.median(error) < 0.1 * np.median(nearest)
    assert error.max() <= nearest.max()  # the edges, where two walls meet


def test_nothing_lies_between_two_surfaces_and_no_hole_shrinks() -> None:
    ranges = np.where(np.arange(32) < 16, 1.0, 3.0).astype(np.float32) * np.ones((16, 1), np.float32)
    ranges[4:6, 4:6] = np.nan
    found = resized_range(ranges, (64, 128))
    assert set(np.unique(found[np.isfinite(found)])) == {1, 3}
    np.testing.assert_array_equal(np.isnan(found), np.isnan(np.repeat(np.repeat(ranges, 4, 0), 4, 1)))
    np.testing.assert_array_equal(np.nan_to_num(found), np.nan_to_num(resized_labels(ranges, (64, 128))))


def test_rolling_before_and_after_is_the_same() -> None:
    ranges = np.random.default_rng(0).uniform(1, 1.09, (8, 16)).astype(np.float32)
    for columns in (1, 5, 8):
        np.testing.assert_allclose(
            resized_range(np.roll(ranges, columns, 1), (16, 32)),
            np.roll(resized_range(ranges, (16, 32)), 2 * columns, 1),
            rtol=1e-6,
        )


def test_labels_are_those_of_the_pixel_that_holds_the_place() -> None:
    labels = np.arange(8).reshape(2, 4)
    np.testing.assert_array_equal(resized_labels(labels, (4, 8)), np.repeat(np.repeat(labels, 2, 0), 2, 1))
    np.testing.assert_array_equal(resized_labels(np.arange(32).reshape(4, 8), (2, 4))[0], [9, 11, 13, 15])


def test_other_shapes_are_told() -> None:
    with pytest.raises(UsageError, match="16×8 px cannot be compared with one of 16×9"):
        resized_range(np.ones((8, 16), np.float32), (9, 16))
