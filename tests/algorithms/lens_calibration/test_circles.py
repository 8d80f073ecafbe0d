"""The image circle of a lens: found to a fraction of a pixel, also if the border cuts it, or not at all."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.lens_calibration.circles import brightest, find_circle


def disc(center_xy: tuple[float, float], radius: float, *, dark: float = 3.0) -> NDArray[np.uint8]:
    rng = np.random.default_rng(0)
    rows, columns = np.mgrid[:400, :420] + 0.5
    away = np.hypot(columns - center_xy[0], rows - center_xy[1])
    light = np.clip(radius - away + 0.5, 0, 1) * (1 - 0.6 * np.clip(away / radius, 0, 1) ** 4)
    texture = rng.uniform(60, 250, (400, 420))
    picture: NDArray[np.uint8] = np.clip(np.rint(dark + light * texture), 0, 255).astype(np.uint8)
    return picture


@pytest.mark.parametrize(
    ("center_xy", "radius", "seen"),
    [((205.0, 192.0), 170.0, 1.0), ((214.3, 208.8), 183.0, 0.99), ((210.0, 200.0), 215.0, 0.35)],
)
def test_a_circle_is_found_although_the_border_may_cut_it(
    center_xy: tuple[float, float], radius: float, seen: float
) -> None:
    pictures = [np.stack([np.roll(disc(center_xy, radius), 0)] * 3, axis=-1) for _ in range(2)]
    circle = find_circle(brightest(pictures))
    assert circle is not None
    assert circle.center_xy == pytest.approx(center_xy, abs=1.5)
    assert circle.radius_px == pytest.approx(radius, rel=0.015)
    assert circle.seen > seen - 0.05


def test_reflections_outside_of_the_circle_do_not_move_it() -> None:
    picture = disc((205.0, 192.0), 150.0)
    picture[5:60, 5:110] = 120
    circle = find_circle(picture)
    assert circle is not None
    assert circle.center_xy == pytest.approx((205.0, 192.0), abs=1.5)


@pytest.mark.parametrize("value", [0, 90, 255])
def test_a_picture_without_dark_surround_has_no_circle(value: int) -> None:
    assert find_circle(np.full((200, 200), value, np.uint8)) is None
