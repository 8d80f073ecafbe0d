"""Which places of cameras are right is known, and weights are fitted that tell them from wrong ones."""

from __future__ import annotations

import numpy as np
import pytest

from pano_mvs.algorithms.poses.verification.appearance import Appearance
from pano_mvs.algorithms.poses.verification.confirmation import Evidence
from tools.benchmarks.belief.families import draw
from tools.benchmarks.poses.place_evidence import Place, fitted, places_of, rows


def drawn_places() -> list[Place]:
    """Places of which the right ones show what is expected, and are confirmed under a large parallax as well."""
    rng = np.random.default_rng(0)
    found = []
    for step in range(40):
        for right in (True, False):
            textured, confirmed = np.zeros(10), np.zeros(10)
            textured[[1, 6]] = 3.0
            confirmed[[1, 6]] = 3 * rng.uniform(0.3, 0.7), 3 * right * rng.uniform(0.2, 0.6)
            correlation = rng.uniform(0.5, 0.9) if right else rng.uniform(0.3, 0.8)
            appearance = Appearance(0.5, correlation, rng.uniform(0.4, 0.9))
            place = Place(("hall", "street")[step % 2], f"{step}", right, Evidence(textured, confirmed), appearance)
            found.append(place)
    return found


def test_what_is_confirmed_under_a_large_parallax_has_a_weight_of_its_own() -> None:
    (near, far, correlation, _), _ = fitted(drawn_places())
    assert far > 3 * abs(near)
    assert correlation > 0


def test_fitted_weights_choose_the_right_place_of_each_step() -> None:
    table = {str(label): (best, steps) for label, _, best, steps in rows(drawn_places(), fit=True)}
    assert table["fitted"] == ("1.000", 40)
    assert float(str(table["cover (less is better)"][0])) < 0.8


@pytest.mark.slow
def test_models_grow_at_right_places() -> None:
    places = list(places_of(draw("hall", 9602)))
    assert len({place.step for place in places}) > 2
    assert any(place.right for place in places)
