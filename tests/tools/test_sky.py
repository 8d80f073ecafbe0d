"""The models of `filters.sky` are those that the stored areas give, and find the sky of kinds of places left out."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from pano_mvs.algorithms.logistic import Model
from pano_mvs.algorithms.masks.sky_coefficients import FIRST, LATER
from tools.benchmarks.sky.places import KINDS, place
from tools.benchmarks.sky.refit import LATER_SIGNS, SIGNS, fit, left_out, outcome, read_areas, with_odds


def test_the_models_in_use_are_those_of_the_stored_areas() -> None:
    areas = with_odds(read_areas(), FIRST)
    for model, again in zip((FIRST, LATER), fit(areas), strict=True):
        found, expected = (one.probabilities(areas.columns) for one in (model, again))
        np.testing.assert_allclose(found, expected, atol=0.01)


@pytest.mark.slow
def test_kinds_of_places_that_were_left_out_lose_little() -> None:
    areas = read_areas()
    found, lost = np.array(list(left_out(areas).values())).T
    assert np.nanmean(found) > 0.4
    assert np.nanmax(lost) < 0.05
    found_in_all, lost_in_all = outcome((FIRST, LATER), areas)
    assert found_in_all > 0.7
    assert lost_in_all < 0.005


@pytest.mark.parametrize("model", [FIRST, LATER], ids=["first", "later"])
def test_each_measurement_counts_in_one_direction(model: Model) -> None:
    for name, term in model.terms.items():
        assert min(*term.losses, term.missing) >= 0
        assert all((SIGNS | LATER_SIGNS)[name] * (better - worse) > 0 for worse, better in pairwise(term.knots))


@pytest.mark.parametrize("kind", KINDS)
def test_places_of_a_kind_differ(kind: str) -> None:
    first, same, other = (np.array([pose.center for pose in place(kind, seed).poses]) for seed in (0, 0, 1))
    np.testing.assert_array_equal(first, same)
    assert np.abs(first - other).max() > 0.01
