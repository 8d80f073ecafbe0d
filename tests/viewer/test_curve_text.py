from __future__ import annotations

import numpy as np
import pytest

from pano_mvs.algorithms.sweep.cost_curve import CostCurve
from pano_mvs.viewer.curves import curve_text


def curve(planes: int, winner: int, *, by_paths: bool = False) -> CostCurve:
    costs = 0.2 + 0.6 * np.minimum(np.abs(np.arange(planes) - winner) / 6, 1)
    costs[planes // 6] = 0.5
    ranges = 1 / np.linspace(1, 0.1, planes)
    sums = 3 * costs if by_paths else None
    return CostCurve(ranges, costs[None], costs, sums, winner, planes // 6, 0.5, ranges[winner], 99)


@pytest.mark.parametrize("planes", [24, 64, 128, 500])
@pytest.mark.parametrize("plain", [False, True])
def test_the_valley_stands_over_the_winners_mark(planes: int, plain: bool) -> None:
    lines = curve_text(curve(planes, 3 * planes // 4), true_range=4.0, width=90, plain=plain)
    assert max(map(len, lines)) <= 90
    bars, marks = lines[1:9], lines[9]
    column = marks.index("^" if plain else "▲")
    heights = ["".join(row.ljust(90)[idx] for row in bars).count(" ") for idx in range(6, max(map(len, bars)))]
    assert heights[column - 6] == max(heights)
    assert ("o" if plain else "△") in marks
    assert ("T" if plain else "◆") in marks
    assert lines[10].split()[0] == "1"
    assert lines[10].split()[-1] == "10"
    if plain:
        "\n".join(lines).encode("ascii")


def test_costs_after_paths_have_a_plot_of_their_own() -> None:
    lines = curve_text(curve(30, 20, by_paths=True))
    assert "after semi-global matching:" in lines
    assert lines[1].startswith(" 0.80")
    assert lines[10].startswith(" 2.40")
    assert "◆" not in lines[-1]
