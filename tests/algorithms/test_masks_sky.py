"""The sky is found in a small place under several skies, and never indoors."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.masks import sky
from pano_mvs.algorithms.masks.areas import area_labels, border_shares, share_of_sphere
from pano_mvs.algorithms.masks.sky import sharpened_sky, sky_colors, sky_pixels, view_of
from pano_mvs.algorithms.masks.sky_features import View, area_features
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3, pixel_solid_angle, ray_grid, roll_panorama, rotation_from_rotvec
from pano_mvs.scene import RangeMap
from pano_mvs.scene.range_map import CONSISTENT_CONFIDENCE
from pano_mvs.testing.room import Room, default_room, render
from pano_mvs.testing.surfaces import Ball, Cuboid, Quad
from tests.synthetic.paints import BRICK, LEAVES, OAK, STONE
from tests.synthetic.places import window_room
from tests.synthetic.rod import Rod
from tests.synthetic.scenes import SKIES

SIZE_HW = (128, 256)
CENTERS = [(0.0, 0.0, 0.0), (0.7, 0.1, 0.3), (-0.5, -0.1, 0.6), (0.2, 0.0, -0.7)]
AREA = np.broadcast_to(pixel_solid_angle(SIZE_HW)[:, None], SIZE_HW)

# Houses, a tree with branches, and a wall with a window, all of different ranges.
_SURFACES = (
    Quad((-20, 1.6, -20), (40, 0, 0), (0, 0, 40), LEAVES),
    Cuboid((5, -3, -4), (9, 1.6, 9), BRICK),
    Cuboid((-14, -5, 4), (-8, 1.6, 16), STONE),
    Cuboid((-3, -1.5, 3), (-1.0, 1.6, 3.3), BRICK),
    Cuboid((0.5, -1.5, 3), (2.4, 1.6, 3.3), BRICK),
    Cuboid((-1.0, 0.2, 3), (0.5, 1.6, 3.3), BRICK),
    Cuboid((-1.0, -1.5, 3), (0.5, -0.9, 3.3), BRICK),
    Rod((-3, 1.6, -3), (-3, -1.2, -3), 0.1, OAK),
    Rod((-3, -0.6, -3), (-1.6, -1.9, -2.6), 0.06, OAK),
    Rod((-3, -0.9, -3), (-4.2, -2.2, -3.3), 0.06, OAK),
    Ball((3, 0.6, -4), 1.2, LEAVES),
)

Views = tuple[list[NDArray[np.uint8]], list[NDArray[np.float32]], list[Rigid3]]


def views_of(room: Room, *, gain: float = 1.0, turned: bool = True) -> Views:
    """Return noisy pictures, true ranges and poses of four views, with gains of their own."""
    rng = np.random.default_rng(4)
    pictures, ranges, poses = [], [], []
    for center in CENTERS:
        turn = rotation_from_rotvec(rng.normal(size=3)) if turned else np.eye(3)
        pose = Rigid3.from_center(turn, np.array(center))
        picture, true_range = render(room, pose, SIZE_HW, supersample=1)
        levels = picture * rng.uniform(0.95, 1.05, 3) * gain + rng.normal(0, 1, picture.shape)
        pictures.append(np.clip(np.rint(levels), 0, 255).astype(np.uint8))
        ranges.append(true_range)
        poses.append(pose)
    return pictures, ranges, poses


def measured(true_range: NDArray[np.float32], *, confirmed: float = 0.9) -> RangeMap:
    """Return ranges as a sweep gives them: the sky has some as well, which other views hardly confirm."""
    rng = np.random.default_rng(5)
    smooth = 4 + np.sin(np.arange(true_range.shape[1]) / 9).astype(np.float32)
    sky = np.isnan(true_range)
    share = np.where(sky, 0.08, confirmed)
    confidence = np.where(rng.random(true_range.shape) < share, 200, 90).astype(np.uint8)
    return RangeMap(np.where(sky, smooth, true_range).astype(np.float32), confidence)


def found_in(
    views: Views,
    *,
    range_map: RangeMap | None = None,
    valid: NDArray[np.bool_] | None = None,
    up: NDArray[np.float64] | None = None,
) -> NDArray[np.bool_]:
    pictures, ranges, poses = views
    everything = np.ones(SIZE_HW, np.bool_)
    return sky_pixels(
        measured(ranges[0]) if range_map is None else range_map,
        pictures[0],
        pictures[1:],
        source_from_reference=[pose @ poses[0].inverse() for pose in poses[1:]],
        valid=everything if valid is None else valid,
        source_valid=[everything] * 3,
        up=up,
    )


@cache
def outdoors(sky: str, *, turned: bool) -> Views:
    zenith, horizon, clouds = SKIES[sky]
    return views_of(
        Room(_SURFACES, "outdoor", 3, lamp=(9.0, -40.0, -20.0), sky=(zenith, horizon), clouds=clouds), turned=turned
    )


@pytest.fixture(scope="module")
def blue() -> Views:
    return outdoors("blue", turned=True)


@pytest.mark.slow
@pytest.mark.parametrize(("sky", "turned"), [*((sky, True) for sky in SKIES), ("blue", False)])
def test_skies_are_found(sky: str, turned: bool) -> None:
    views = outdoors(sky, turned=turned)
    truth = np.isnan(views[1][0])
    found = found_in(views)
    assert AREA[found & truth].sum() > 0.94 * AREA[truth].sum()  # edges weigh more at this size
    assert AREA[found & ~truth].sum() < 0.005 * AREA[~truth].sum()


def test_a_sky_without_ranges_is_found(blue: Views) -> None:
    truth = np.isnan(blue[1][0])
    known = measured(blue[1][0])
    bare = RangeMap(np.where(truth, np.nan, known.range).astype(np.float32), np.where(truth, 0, known.confidence))
    assert AREA[found_in(blue, range_map=bare) & truth].sum() > 0.97 * AREA[truth].sum()


@pytest.mark.parametrize("gain", [1.0, 1.6])
def test_rooms_have_no_sky(gain: float) -> None:
    """Not even plain rooms, nor overexposed ones, of whose walls other views confirm a third."""
    room = replace(default_room(), texture="none")
    views = views_of(room, gain=gain)
    assert not found_in(views, range_map=measured(views[1][0], confirmed=0.33)).any()


def test_ranges_that_others_confirm_stay_whatever_the_model_says(blue: Views, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those that the colours show under a parallax, and all of them below the horizon, if it is known."""
    monkeypatch.setattr(sky, "judged_areas", lambda view, models: (view.valid, []))
    monkeypatch.setattr(sky, "sharpened_sky", lambda found, colors, picture: found)
    range_map, ground = measured(blue[1][0]), blue[1][0] < 60
    confirmed = range_map.confidence >= CONSISTENT_CONFIDENCE[0]
    up = blue[2][0].rotation @ (0.0, -1.0, 0.0)
    anywhere, level = found_in(blue, range_map=range_map), found_in(blue, range_map=range_map, up=up)
    below = ray_grid(SIZE_HW) @ up < 0
    assert AREA[anywhere & ground & confirmed].sum() < 0.5 * AREA[ground & confirmed].sum()
    assert not level[below & confirmed].any()
    np.testing.assert_array_equal(level[~below], anywhere[~below])


@pytest.mark.slow
@pytest.mark.parametrize("shade", [(1.0, 1.0, 1.0), (0.5, 0.3, 0.2)], ids=["sky", "dark"])
def test_the_sky_is_found_through_windows_and_walls_stay(shade: tuple[float, float, float]) -> None:
    """Panes look like plain panels in the frames of the windows, and get their ranges; those with a dark hall stay."""
    scene, size = window_room(seed=0, sky="blue"), (256, 512)
    views = [scene.view(idx, size, supersample=1) for idx in range(3)]
    pictures = [
        np.where(np.isnan(true)[..., None], picture * shade, picture).astype(np.uint8) for picture, true in views
    ]
    true = views[1][1]
    sky = np.isnan(true)
    ranges = np.where(sky, np.float32(2.7), true)
    confidence = np.where(sky, 90, 200).astype(np.uint8)
    everything = np.ones(size, np.bool_)
    found = sky_pixels(
        RangeMap(ranges, confidence),
        pictures[1],
        [pictures[0], pictures[2]],
        source_from_reference=[scene.poses[idx] @ scene.poses[1].inverse() for idx in (0, 2)],
        valid=everything,
        source_valid=[everything] * 2,
    )
    area = np.broadcast_to(pixel_solid_angle(size)[:, None], size)
    if shade[0] < 1:
        assert not found.any()
        return
    assert area[found & sky].sum() > 0.4 * area[sky].sum()
    assert area[found & ~sky].sum() < 0.005 * area[~sky].sum()


def test_masked_pixels_are_not_sky(blue: Views) -> None:
    valid = np.ones(SIZE_HW, np.bool_)
    valid[:, 60:90] = False
    found = found_in(blue, valid=valid)
    assert found.any()
    assert not found[~valid].any()


def test_the_sky_rolls_with_the_picture(blue: Views) -> None:
    pictures, ranges, poses = blue
    picture, turn = roll_panorama(pictures[0], 37)
    rolled = ([picture, *pictures[1:]], ranges, [Rigid3(turn, np.zeros(3)) @ poses[0], *poses[1:]])
    known = measured(ranges[0])
    moved = RangeMap(np.roll(known.range, 37, axis=1), np.roll(known.confidence, 37, axis=1))
    straight, back = found_in(blue), np.roll(found_in(rolled, range_map=moved), -37, axis=1)
    assert (straight != back).mean() < 0.01


def test_sizes_must_agree(blue: Views) -> None:
    pictures, ranges, poses = blue
    valid = np.ones(SIZE_HW, np.bool_)
    for range_map, source, what in (
        (measured(ranges[0][:64]), pictures[1:2], "its ranges are"),
        (measured(ranges[0]), [], "one or more sources"),
    ):
        with pytest.raises(UsageError, match=what):
            sky_pixels(
                range_map,
                pictures[0],
                source,
                source_from_reference=poses[1:2],
                valid=valid,
                source_valid=[valid],
            )


UPPER_HALF = np.where(ray_grid(SIZE_HW)[..., 1] < 0, 0, -1)


def seen(views: Views, *, source_valid: NDArray[np.bool_]) -> View:
    """Return the first view with the second one as its source."""
    pictures, ranges, poses = views
    known = RangeMap(ranges[0], np.full(SIZE_HW, 200, np.uint8))
    source = (pictures[1], source_valid, poses[1] @ poses[0].inverse())
    return view_of(known, pictures[0], np.ones(SIZE_HW, np.bool_), sources=[source])


def test_walls_disagree_at_infinity_and_agree_at_their_range() -> None:
    view = seen(views_of(default_room(0, "weak")), source_valid=np.ones(SIZE_HW, np.bool_))
    far, near = (np.nanmedian(each) for each in view.errors)
    assert near < 2
    assert far > 3 * near
    measures = area_features(view, UPPER_HALF)
    assert measures["edge_prefers"] < -0.5
    assert measures["confirmed"] > 0.9


def test_masked_sources_say_nothing(blue: Views) -> None:
    view = seen(blue, source_valid=np.zeros(SIZE_HW, np.bool_))
    assert np.isnan(view.errors).all()
    unmasked = area_features(seen(blue, source_valid=np.ones(SIZE_HW, np.bool_)), UPPER_HALF)
    measures = area_features(view, UPPER_HALF)
    for name in ("edge_prefers", "behind"):
        assert np.isfinite(unmasked[name]).all()
        assert np.isnan(measures[name]).all()


def test_measures_of_an_area_do_not_depend_on_the_others(blue: Views) -> None:
    view = seen(blue, source_valid=np.ones(SIZE_HW, np.bool_))
    first, second = np.full(SIZE_HW, -1), np.full(SIZE_HW, -1)
    first[20:40, 30:90] = first[90:110, 100:200] = second[90:110, 100:200] = 0
    first[90:110, 100:200] = 1
    both, alone = area_features(view, first), area_features(view, second)
    for name, values in alone.items():
        np.testing.assert_allclose(both[name][1], values[0], err_msg=name)


def test_colors_of_the_sky_are_known_beyond_the_seeds() -> None:
    up = -ray_grid(SIZE_HW)[..., 1]
    picture = np.rint(np.stack([60 + 50 * up, 100 + 40 * up, 170 + 30 * up], axis=-1)).astype(np.uint8)
    seeds = up > 0.4
    colors = sky_colors(picture, seeds)
    near = up > 0.3
    assert colors.match(picture)[near].all()
    assert not colors.match(np.full_like(picture, 90))[near].any()


def test_edges_follow_a_larger_picture() -> None:
    """The sky of a coarse mask ends at an edge of the picture that lies between its pixels."""
    picture = np.full((64, 128, 3), (90, 140, 220), np.uint8)
    picture[27:] = (80, 70, 40)
    picture[:27, 40] = (80, 70, 40)
    coarse = np.zeros((32, 64), np.bool_)
    coarse[:14] = True
    small = picture[::2, ::2]
    found = sharpened_sky(coarse, sky_colors(small, coarse & (small[..., 2] == 220)), picture)
    assert found[:27, :38].all()
    assert not found[27:].any()


def test_border_shares_count_the_border_by_its_length() -> None:
    pixels = np.zeros((16, 32), np.bool_)
    pixels[7:9, 30:] = pixels[7:9, :2] = True
    labels = area_labels(pixels)
    (label,) = np.unique(labels[labels >= 0])
    above = np.zeros_like(pixels)
    above[:7] = True
    assert border_shares(labels, above)[label] == pytest.approx(1 / 3)
    assert border_shares(labels, ~pixels)[label] == pytest.approx(1)
    assert share_of_sphere(np.ones((16, 32), np.bool_)) == pytest.approx(1)
