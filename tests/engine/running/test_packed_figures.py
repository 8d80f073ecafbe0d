"""Packed figures are those that were packed."""

from __future__ import annotations

import pytest

from pano_mvs.engine.running.statistics import PackedFigures

FIGURES = {"inliers": 213.0, "residual_deg": 0.1 + 0.2, "least": -0.0, "large": 1e300}


@pytest.mark.parametrize("names", [[], ["large"], list(FIGURES), list(reversed(FIGURES))])
def test_packed_figures_equal_a_dict_of_the_same(names: list[str]) -> None:
    figures = {name: FIGURES[name] for name in names}
    packed = PackedFigures(figures)
    assert list(packed.items()) == list(figures.items())
    assert packed == figures
    assert packed == PackedFigures(figures)
    assert len(packed) == len(figures)
    assert repr(packed) == repr(figures)


def test_packed_figures_differ_in_any_name_and_figure() -> None:
    packed = PackedFigures(FIGURES)
    assert packed != PackedFigures(FIGURES | {"inliers": 214.0})
    assert packed != PackedFigures({name: FIGURES[name] for name in ("inliers", "large")})
    assert "outliers" not in packed
    with pytest.raises(KeyError, match="outliers"):
        packed["outliers"]
