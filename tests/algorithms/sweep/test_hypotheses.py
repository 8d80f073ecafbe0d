"""Virtual ranges and their limits."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pano_mvs.algorithms.sweep.hypotheses import Spacing, range_at, range_limits, virtual_ranges
from pano_mvs.core.errors import UsageError

SPACINGS = ("parallax", "inverse", "log", "uniform")


@given(
    near=st.floats(1e-3, 1e3), ratio=st.floats(1.01, 1e4), planes=st.integers(3, 300), spacing=st.sampled_from(SPACINGS)
)
def test_virtual_ranges_ascend_from_near_to_far(near: float, ratio: float, planes: int, spacing: Spacing) -> None:
    ranges = virtual_ranges(near, near * ratio, planes=planes, spacing=spacing, baseline=2.0)
    assert ranges.shape == (planes,)
    assert ranges[0] == pytest.approx(near)
    assert ranges[-1] == pytest.approx(near * ratio)
    assert (np.diff(ranges) > 0).all()


@pytest.mark.parametrize(("spacing", "even"), [("inverse", np.reciprocal), ("log", np.log), ("uniform", np.array)])
def test_virtual_ranges_are_even_in_what_the_spacing_names(spacing: Spacing, even: Callable[..., Any]) -> None:
    steps = np.diff(even(virtual_ranges(0.3, 9.0, planes=50, spacing=spacing)))
    np.testing.assert_allclose(steps, steps[0])


def test_parallax_is_even_in_inverse_range_far_away_and_in_log_range_nearby() -> None:
    near, far, baseline = 0.05, 50.0, 1.0
    ranges = virtual_ranges(near, far, planes=200, spacing="parallax", baseline=baseline)
    distant, close = ranges > 10 * baseline, ranges < baseline / 10
    assert distant.sum() > 3
    assert close.sum() > 10
    np.testing.assert_allclose(np.diff(1 / ranges[distant]), np.diff(1 / ranges)[-1], rtol=0.01)
    np.testing.assert_allclose(np.diff(np.log(ranges[close])), np.diff(np.log(ranges))[0], rtol=0.01)


def test_without_a_baseline_parallax_is_even_in_inverse_range() -> None:
    expected = virtual_ranges(0.3, 9.0, planes=50, spacing="inverse")
    np.testing.assert_array_equal(virtual_ranges(0.3, 9.0, planes=50, spacing="parallax"), expected)
    small = virtual_ranges(0.3, 9.0, planes=50, spacing="parallax", baseline=1e-4)
    np.testing.assert_allclose(small, expected, rtol=1e-6)


@pytest.mark.parametrize("limits", [(0.0, 1.0), (2.0, 1.0), (1.0, np.inf), (np.nan, 1.0)])
def test_limits_that_are_none_are_refused(limits: tuple[float, float]) -> None:
    with pytest.raises(UsageError, match="0 < near < far"):
        range_at([0.0], *limits, planes=8, spacing="inverse")


def test_the_baselines_and_the_resolution_decide() -> None:
    near, far = range_limits([0.0, 0.2, 1.0], width=1024)
    assert near == pytest.approx(0.3)
    parallax_px = np.arctan(1.0 / far) / (2 * np.pi / 1024)
    assert parallax_px == pytest.approx(0.5, rel=1e-3)
    assert range_limits([0.4, 2.0], width=1024) == pytest.approx((2 * near, 2 * far))


@pytest.mark.parametrize("baselines", [[], [0.0], [np.nan]])
def test_a_capture_from_one_place_is_refused(baselines: Sequence[float]) -> None:
    with pytest.raises(UsageError, match="all baselines are zero"):
        range_limits(baselines, width=1024)
