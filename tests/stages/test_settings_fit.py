"""Settings that no stage can use are refused before anything runs, as `pano-mvs check` promises."""

from __future__ import annotations

import pytest
from pydantic import ValidationError

from pano_mvs.stages.depth import PatchMatchParams, SweepParams
from pano_mvs.stages.filters import GaussianParams, MedianParams


@pytest.mark.parametrize("params", [SweepParams, MedianParams, GaussianParams, PatchMatchParams])
def test_windows_are_odd(params: type) -> None:
    with pytest.raises(ValidationError, match="must be odd"):
        params(window=4)
    assert params(window=3).window == 3


@pytest.mark.parametrize(
    ("settings", "why"),
    [
        ({"support": 4}, r"support\s+.*must be odd"),
        ({"p2": 5000}, r"p2\s+.*less than or equal to 4000"),
        ({"p1": 1000, "p2": 500}, "0 ≤ p1 ≤ p2 ≤ 4000 must hold, got 1000 and 500"),
        ({"cost": "zncc", "window": 1}, "zncc needs a window of at least 3"),
        ({"near": 5.0, "far": 1.0}, "near must be less than far, got 5.0 and 1.0"),
        ({"near": 2.0, "far": 2.0}, "near must be less than far, got 2.0 and 2.0"),
    ],
)
def test_a_sweep_that_cannot_run_is_refused(settings: dict[str, object], why: str) -> None:
    with pytest.raises(ValidationError, match=why):
        SweepParams.model_validate(settings)


@pytest.mark.parametrize(
    "settings",
    [{"p1": 4000, "p2": 4000}, {"cost": "sad", "window": 1, "support": 1}, {"near": 1.0, "far": 1.1}],
)
def test_the_largest_penalties_and_smallest_windows_are_taken(settings: dict[str, object]) -> None:
    params = SweepParams.model_validate(settings)
    assert params.model_dump(include=set(settings)) == settings
