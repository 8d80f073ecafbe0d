"""What moves through the scene contradicts the other views; everything else is left alone."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.masks.areas import dilated, share_of_sphere
from pano_mvs.algorithms.masks.expected_view import OtherView, expected_view
from pano_mvs.algorithms.masks.moving import Moving, moving_pixels
from pano_mvs.core.arrays import Mask
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3
from pano_mvs.scene import RangeMap
from pano_mvs.testing.room import Room, default_room, render
from pano_mvs.testing.surfaces import Cuboid
from tests.synthetic.persons import Drawn, draw_people, person

SIZE_HW = (128, 256)
CENTERS = ((0.0, 0.0, 0.0), (0.7, 0.05, 0.3), (-0.5, -0.05, 0.6), (0.1, 0.0, -0.7))
FLOOR_Y = 1.3
BOX = Cuboid((1.0, 0.3, -0.6), (1.6, 1.3, 0.6), ((0.9, 0.2, 0.1), (0.8, 0.3, 0.1)))

View = tuple[NDArray[np.uint8], NDArray[np.float32], Rigid3]


@cache
def empty_room() -> tuple[View, ...]:
    poses = [Rigid3.from_center(np.eye(3), np.array(center)) for center in CENTERS]
    return tuple((*render(default_room(0, "weak"), pose, SIZE_HW, supersample=1), pose) for pose in poses)


@cache
def with_operator(outfit: str = "shirt") -> Drawn:
    """The first view, with somebody who crouches below the camera and casts a shadow."""
    picture, ranges, pose = empty_room()[0]
    operator = person("crouching", outfit, at_xz=(0.1, 0.15), ground_y=FLOOR_Y, heading=0.7)
    return draw_people(picture, ranges, pose, people=[operator])


def range_map(ranges: NDArray[np.float32]) -> RangeMap:
    return RangeMap(ranges, np.where(np.isfinite(ranges), 200, 0).astype(np.uint8))


def others() -> list[OtherView]:
    reference = empty_room()[0][2]
    everything = np.ones(SIZE_HW, np.bool_)
    return [
        OtherView(picture, everything, range_map(ranges), pose @ reference.inverse())
        for picture, ranges, pose in empty_room()[1:]
    ]


def found_in(picture: NDArray[np.uint8], ranges: NDArray[np.float32], **settings: object) -> Moving:
    settings = {"valid": np.ones(SIZE_HW, np.bool_), "passers_by": False, "vehicles": False} | settings
    return moving_pixels(picture, range_map(ranges), others(), **settings)  # type: ignore[arg-type]  # of the tests


def share(pixels: Mask, of: Mask) -> float:
    return share_of_sphere(pixels & of) / share_of_sphere(of)


@pytest.mark.slow
@pytest.mark.parametrize("outfit", ["shirt", "black"])
@pytest.mark.parametrize("measured", [True, False], ids=["measured", "ground"])
def test_the_operator_is_found(outfit: str, measured: bool) -> None:
    """Whether the sweep has measured the operator, or continued the floor."""
    drawn = with_operator(outfit)
    found = found_in(drawn.picture, drawn.ranges if measured else empty_room()[0][1]).pixels
    assert share(found, drawn.people) > 0.9
    assert share_of_sphere(found & ~dilated(drawn.people | drawn.shadow, 2)) < 0.002


def test_nothing_is_found_in_an_empty_room() -> None:
    picture, ranges, _ = empty_room()[0]
    assert not found_in(picture, ranges, vehicles=True, passers_by=True).pixels.any()


def test_exposure_does_not_matter() -> None:
    picture, ranges, _ = empty_room()[0]
    darker = np.rint(picture * np.array([0.75, 0.7, 0.65])).astype(np.uint8)
    assert not found_in(darker, ranges).pixels.any()


def test_shadows_are_masked_on_demand() -> None:
    drawn = with_operator()
    without = found_in(drawn.picture, drawn.ranges, margin_deg=0)
    assert not without.shadow.any()
    assert share(without.pixels, drawn.shadow) < 0.3
    found = found_in(drawn.picture, drawn.ranges, margin_deg=0, shadows=True)
    assert share(found.shadow, drawn.shadow) > 0.6
    assert (found.pixels | ~found.shadow).all()


def test_shadows_beside_people_who_are_masked_already() -> None:
    """Nothing else has changed, and the shadow was left in."""
    drawn = with_operator()
    valid = ~dilated(drawn.people, 1)
    for shadows, least in ((True, 0.6), (False, 0.0)):
        found = found_in(drawn.picture, drawn.ranges, valid=valid, margin_deg=0, shadows=shadows)
        assert share(found.shadow, drawn.shadow & valid) >= least
        assert found.shadow.any() == shadows


def test_what_touches_a_mask_near_the_nadir_belongs_to_it() -> None:
    """The first pass has masked the operator except for a part beyond 30° from the nadir."""
    drawn = with_operator()
    picture, ranges, _ = empty_room()[0]
    upper = drawn.people.copy()
    upper[-24:] = False  # 34°
    part = np.where(upper[..., None], drawn.picture, picture)
    valid = ~(drawn.people & ~upper)
    assert share(found_in(part, ranges, valid=valid, min_area_deg2=3).pixels, upper & valid) > 0.6
    assert not (found_in(part, ranges, valid=valid, min_area_deg2=3).pixels & ~valid).any()


def test_vehicles_stand_on_the_ground_below_the_sky() -> None:
    pose = empty_room()[0][2]
    room = default_room(0, "weak")
    picture, ranges = render(Room((*room.surfaces, BOX), room.texture, room.seed), pose, SIZE_HW, supersample=1)
    shown = np.abs(ranges - empty_room()[0][1]) > 0.02
    assert not found_in(picture, ranges, vehicles=True).pixels.any()
    valid = np.ones(SIZE_HW, np.bool_)
    open_to_the_sky = [replace(other, range_map=without_ceiling(other.range_map)) for other in others()]
    for vehicles in (True, False):
        found = moving_pixels(
            picture,
            without_ceiling(range_map(ranges)),
            open_to_the_sky,
            valid=valid,
            passers_by=False,
            vehicles=vehicles,
        )
        assert share(found.pixels, shown) > 0.8 if vehicles else not found.pixels.any()


def without_ceiling(ranges: RangeMap) -> RangeMap:
    above = np.arange(SIZE_HW[0])[:, None] < SIZE_HW[0] * 0.3
    return range_map(np.where(above, np.float32(np.nan), ranges.range))


def test_the_ground_is_known_below_the_camera() -> None:
    picture, ranges, _ = empty_room()[0]
    unknown = range_map(np.where(np.arange(SIZE_HW[0])[:, None] > 100, np.float32(np.nan), ranges))
    expected = expected_view(picture, unknown, others())
    assert expected.height == pytest.approx(FLOOR_Y, rel=0.02)
    below = slice(-20, None)
    assert expected.ground[below].all()
    np.testing.assert_allclose(expected.ranges[below], ranges[below], rtol=0.05)
    assert np.nanmedian(expected.difference[below]) < 3


def test_two_other_views_are_needed() -> None:
    drawn = with_operator()
    valid = np.ones(SIZE_HW, np.bool_)
    found = moving_pixels(drawn.picture, range_map(drawn.ranges), others()[:1], valid=valid)
    assert not found.pixels.any()


def test_masked_parts_of_other_views_do_not_count() -> None:
    drawn = with_operator()
    blind = [replace(other, valid=np.zeros(SIZE_HW, np.bool_)) for other in others()]
    valid = np.ones(SIZE_HW, np.bool_)
    assert not moving_pixels(drawn.picture, range_map(drawn.ranges), blind, valid=valid).pixels.any()


def test_arrays_of_other_sizes_are_refused() -> None:
    drawn = with_operator()
    with pytest.raises(UsageError, match="needs ranges and a mask of its size"):
        moving_pixels(drawn.picture, range_map(drawn.ranges[::2, ::2]), others(), valid=np.ones(SIZE_HW, np.bool_))
