"""What is known to be sky gets no range from any filter."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.filters.bilateral_solver import fast_bilateral_solver
from pano_mvs.algorithms.filters.consistency import checked_with_agreement
from pano_mvs.algorithms.filters.fill import fill_from_neighbours
from pano_mvs.algorithms.filters.guided import guided_range
from pano_mvs.algorithms.filters.planes import lay_planes
from pano_mvs.algorithms.filters.smoothing import gaussian_range, median_range
from pano_mvs.algorithms.filters.speckle import remove_speckles
from pano_mvs.algorithms.patchmatch.refine import refine_range
from pano_mvs.core.errors import ContractError
from pano_mvs.geometry import Rigid3
from pano_mvs.scene import RangeMap
from pano_mvs.testing.room import default_room, render

SIZE_HW = (32, 64)
SKY = np.zeros(SIZE_HW, np.bool_)
SKY[4:14, 20:40] = True
ASIDE = Rigid3(np.eye(3), np.array([0.3, 0.0, 0.0]))
PICTURE, RANGES = render(default_room(), Rigid3.identity(), SIZE_HW, supersample=1)
OTHER, _ = render(default_room(), ASIDE, SIZE_HW, supersample=1)


def known(sky: NDArray[np.bool_] | None) -> RangeMap:
    return RangeMap(np.where(SKY, np.nan, RANGES).astype(np.float32), np.where(SKY, 0, 200).astype(np.uint8), sky=sky)


FILTERS: dict[str, Callable[[RangeMap], RangeMap]] = {
    "solver": lambda found: fast_bilateral_solver(found, PICTURE, max_hole_deg=0),
    "fill": lambda found: fill_from_neighbours(found, max_hole_deg=0),
    "planes": lambda found: lay_planes(found, PICTURE, rng=np.random.default_rng(0)),
    "median": median_range,
    "gaussian": gaussian_range,
    "guided": lambda found: guided_range(found, PICTURE),
    "speckle": lambda found: remove_speckles(found, max_size_px=3, max_relative_step=0.3),
    "consistency": lambda found: checked_with_agreement(found, Rigid3.identity(), [known(None)], source_poses=[ASIDE])[
        0
    ],
    "patchmatch": lambda found: refine_range(found, PICTURE, [OTHER], source_from_reference=[ASIDE]),
}


@pytest.mark.parametrize("name", FILTERS)
def test_no_filter_gives_the_sky_a_range(name: str) -> None:
    result = FILTERS[name](known(SKY))
    result.check()
    assert result.sky is not None
    assert np.array_equal(result.sky, SKY)
    assert not result.valid[SKY].any()
    assert result.valid[~SKY].mean() > 0.5


@pytest.mark.parametrize("name", ["solver", "fill"])
def test_without_it_the_same_pixels_are_filled(name: str) -> None:
    assert FILTERS[name](known(None)).valid[SKY].mean() > 0.9


def test_a_range_map_without_a_sky_is_stored_as_before() -> None:
    assert known(None).to_parts()["meta"] == {"normals_in_cam": None, "uncertainty": None}
    again = RangeMap.from_parts(known(SKY).to_parts())
    assert again.sky is not None
    assert np.array_equal(again.sky, SKY)
    assert RangeMap.from_parts(known(None).to_parts()).sky is None


def test_a_sky_with_a_range_is_refused() -> None:
    with pytest.raises(ContractError, match="sky has a range"):
        RangeMap(RANGES, np.full(SIZE_HW, 200, np.uint8), sky=SKY).check()
