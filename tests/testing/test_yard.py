"""The yard: an outdoor place whose sky is seen behind branches, between slats and through windows."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.testing.scenes import SKIES, courtyard
from tests.synthetic.places import yard

SIZE_HW = (32, 64)


def sky_of(name: str) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    picture, ranges = yard(seed=1, views=1, turned=False, sky=name).view(0, SIZE_HW, supersample=1)
    return picture, np.isnan(ranges)


def test_the_sky_has_no_range_and_lies_in_parts() -> None:
    _, sky = sky_of("blue")
    assert 0.35 < sky.mean() < 0.5
    window = sky[9:14, 24:40]  # the wall in front of the camera
    assert 0.1 < window.mean() < 0.9
    assert not sky[20:].any()


@pytest.mark.parametrize("name", SKIES)
def test_skies_differ_only_in_the_sky(name: str) -> None:
    (blue, sky), (other, also_sky) = sky_of("blue"), sky_of(name)
    assert np.array_equal(sky, also_sky)
    assert np.array_equal(blue[~sky], other[~sky])
    assert np.array_equal(blue, other) == (name == "blue")


def test_the_overcast_sky_is_plain_and_overexposed() -> None:
    picture, sky = sky_of("overcast")
    assert picture[sky].min() > 235


def test_the_courtyard_takes_a_sky() -> None:
    blue, _ = courtyard(seed=1, views=1, turned=False, sky="blue").view(0, SIZE_HW, supersample=1)
    usual, ranges = courtyard(seed=1, views=1, turned=False).view(0, SIZE_HW, supersample=1)
    assert (blue != usual)[np.isnan(ranges)].any()
    assert np.array_equal(blue[~np.isnan(ranges)], usual[~np.isnan(ranges)])
