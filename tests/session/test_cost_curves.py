"""The picture of a cost curve."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.sweep.cost_curve import CostCurve
from pano_mvs.algorithms.sweep.settings import SweepSettings
from pano_mvs.scene.image_file import decode_image
from pano_mvs.session.cost_curves import curve_text, write_curve_picture
from pano_mvs.session.inspection import Inspection, SourceSight


def inspection(*, sources: int = 2, by_paths: bool = True, true_range: float = 4.0, image: str = "a.jpg") -> Inspection:
    found = curve(64, 48, by_paths=by_paths)
    by_source = np.repeat(found.raw[None], sources, axis=0)
    by_source[:, 10:20] = np.nan
    seen = [SourceSight(f"b/_{idx}.jpg", 1.0, 2.0, (3.0, 4.0), (0, 0, 0), False, 0.2) for idx in range(sources)]
    return Inspection(
        image=image,
        column=3,
        row=4,
        size_hw=(64, 128),
        color_rgb=(1, 2, 3),
        ray_in_cam=np.eye(3)[2],
        ray_in_world=np.eye(3)[2],
        center_in_world=np.zeros(3),
        stages=(),
        sweep="depth",
        settings=SweepSettings(),
        curve=dataclasses.replace(found, by_source=by_source),
        sources=tuple(seen),
        true_range=true_range,
        notes=(),
    )


def drawn(path: Path, found: Inspection) -> NDArray[np.uint8]:
    write_curve_picture(path, found)
    return decode_image(path)


def has_color(picture: NDArray[np.uint8], rgb: tuple[int, int, int]) -> bool:
    return bool((np.abs(picture.astype(int) - rgb).sum(axis=-1) < 20).any())


@pytest.mark.slow
@pytest.mark.parametrize("by_paths", [False, True])
def test_marks_are_drawn_as_far_as_they_are_known(tmp_path: Path, *, by_paths: bool) -> None:
    picture = drawn(tmp_path / "new" / "a.png", inspection(by_paths=by_paths))
    assert picture.shape == (838 if by_paths else 492, 1040, 3)
    winner, rival, truth = (200, 50, 50), (210, 130, 30), (20, 130, 80)
    assert all(has_color(picture, color) for color in (winner, rival, truth))
    assert not has_color(drawn(tmp_path / "b.png", inspection(true_range=np.nan)), truth)


@pytest.mark.slow
def test_any_name_can_be_drawn_and_nothing_is_lost_below(tmp_path: Path) -> None:
    """Names are not formulas, and characters that the font lacks raise no warning."""
    plain = drawn(tmp_path / "a.png", inspection(image="r\u00e4um/$x^2$_?.jpg", sources=11))
    assert (plain == drawn(tmp_path / "b.png", inspection(image="r\u00e4um/$x^2$_\u65e5.jpg", sources=11))).all()
    assert len(plain) == len(drawn(tmp_path / "c.png", inspection())) + 2 * 22  # rows of the legend


def test_the_users_own_style_changes_nothing(tmp_path: Path) -> None:
    write_curve_picture(tmp_path / "a.png", inspection())
    with mpl.rc_context({"axes.facecolor": "black", "font.size": 30, "lines.linewidth": 9}):
        write_curve_picture(tmp_path / "b.png", inspection())
        assert mpl.rcParams["font.size"] == 30
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


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
