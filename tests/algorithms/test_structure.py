"""Planes of a place: walls whose ranges are biased stand where their edges are, and what is not a wall stays."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pano_mvs.algorithms.filters.supported import has_texture
from pano_mvs.algorithms.structure import creases, skyline
from pano_mvs.algorithms.structure import planes as planes_module
from pano_mvs.algorithms.structure.ceilings import moved_ceilings, supposed_ceiling
from pano_mvs.algorithms.structure.laid import OtherView, laid_evidence, seen_by
from pano_mvs.algorithms.structure.lay import lay_structure
from pano_mvs.algorithms.structure.outline import OUTLINE_UNCERTAINTY, room_of
from pano_mvs.algorithms.structure.planes import find_structure
from pano_mvs.algorithms.structure.skyline import Skyline
from pano_mvs.algorithms.structure.view import (
    HALF_DIFFERENCE,
    STEP_RAD,
    PlaneView,
    ScenePlane,
    grid_rows,
    on_grid,
    plane_view,
)
from pano_mvs.core.arrays import FloatArray, Picture
from pano_mvs.core.errors import ContractError
from pano_mvs.geometry import Rigid3, ray_grid
from pano_mvs.scene import Poses, RangeMap, WorldAxes
from pano_mvs.scene.range_map import FILLED_CONFIDENCE
from pano_mvs.scene.surfaces import Structure
from tests.algorithms.range_scenes import SEEN, TRUSTED, as_map, box_range

SIZE = (128, 256)
HALF = (3.0, 1.4, 2.5)
CENTERS = ((0.4, -0.3, 0.2), (-0.6, -0.1, 0.5), (0.1, -0.2, -0.8))
CREASE_CLARITY = Skyline.crease_clarity


class Box:
    """Views of a box: plain walls of different greys whose ranges are 3 % too large, and a textured exact floor."""

    def __init__(self, size_hw: tuple[int, int] = SIZE, turn_deg: float = 0.0) -> None:
        turned = Rigid3.from_center(Rotation.from_euler("y", -turn_deg, degrees=True).as_matrix(), np.zeros(3))
        self.truth: dict[str, NDArray[np.float32]] = {}
        self.walls: dict[str, NDArray[np.bool_]] = {}
        self.maps: dict[str, RangeMap] = {}
        self.pictures: dict[str, Picture] = {}
        self.cams: dict[str, Rigid3] = {}
        noise = np.random.default_rng(3)
        for number, center in enumerate(CENTERS):
            name = f"{number}.png"
            ranges, normals = box_range(size_hw, HALF, center)
            wall, floor = np.abs(normals[..., 1]) < 0.5, normals[..., 1] < -0.5
            greys = np.select([normals[..., 0] > 0.5, normals[..., 0] < -0.5, wall], [200.0, 170.0, 225.0], 120.0)
            greys = np.where(floor, noise.integers(20, 100, size_hw), greys)
            self.truth[name], self.walls[name] = ranges, wall
            self.pictures[name] = np.repeat(greys[..., None], 3, axis=-1).astype(np.uint8)
            edge = wall & has_texture(self.pictures[name])
            self.maps[name] = as_map(np.where(wall, 1.03 * ranges, ranges), np.where(edge, SEEN, TRUSTED))
            self.cams[name] = Rigid3.from_center(np.eye(3), center) @ turned

    def structure(self, axes: WorldAxes = WorldAxes.LEVEL) -> Structure:
        poses = Poses.without_points(self.cams, frame="", scale="", metric=True, axes=axes)
        return find_structure(poses, self.maps, self.pictures.__getitem__, rng=np.random.default_rng(0))

    def laid(self, structure: Structure, name: str = "0.png", **changes: Any) -> RangeMap:
        others = [other for other in self.maps if other != name]
        given: dict[str, Any] = {"range_map": self.maps[name], "sources": [self.maps[other] for other in others]}
        given |= changes
        return lay_structure(
            given["range_map"],
            self.pictures[name],
            structure,
            cam_from_world=self.cams[name],
            sources=[
                OtherView(ranges, self.cams[other], self.pictures[other])
                for ranges, other in zip(given["sources"], others, strict=True)
            ],
        )[0]


@pytest.fixture(scope="module")
def box() -> Box:
    return Box()


@pytest.fixture(scope="module")
def planes(box: Box) -> Structure:
    return box.structure()


@pytest.mark.slow
def test_edges_place_walls_whose_ranges_are_biased(planes: Structure) -> None:
    planes.check()
    expected = np.concatenate([sign * np.eye(3) for sign in (1.0, -1.0)])
    for normal in expected:
        cosine = planes.normals_in_world @ normal
        nearest = int(np.argmax(cosine))
        assert cosine[nearest] > np.cos(np.radians(0.5))
        assert planes.offsets[nearest] == pytest.approx(-np.abs(normal) @ HALF, rel=0.01)
    assert len(planes) == 6


def test_pixels_move_to_the_walls_that_they_show(box: Box, planes: Structure) -> None:
    result = box.laid(planes)
    result.check()
    error = np.abs(result.range / box.truth["0.png"] - 1)
    assert np.mean(error < 0.01) > 0.97
    assert (result.confidence[box.walls["0.png"]] >= 128).mean() > 0.8


@pytest.mark.slow
@pytest.mark.parametrize(("turn_deg", "ceiling_known"), [(0.0, True), (25.0, False)])
def test_walls_without_any_match_stand_where_their_creases_are(turn_deg: float, *, ceiling_known: bool) -> None:
    """No view has a match on a wall, or on the ceiling: their ranges are the floor's and the ceiling's, spread out."""
    box = Box((256, 512), turn_deg)
    for name, own in box.maps.items():
        if not ceiling_known:
            box.walls[name] |= np.arange(256)[:, None] < 128
        wall = box.walls[name]
        box.maps[name] = replace(
            own,
            range=np.where(wall, 2.2, own.range).astype(np.float32),
            confidence=np.where(wall, FILLED_CONFIDENCE[1], own.confidence).astype(np.uint8),
        )
    structure = box.structure()
    structure.check()
    walls = np.abs(structure.normals_in_world[:, 1]) < 0.5
    assert walls.sum() == 4
    assert (structure.uncertainties[walls] == OUTLINE_UNCERTAINTY).all()
    result, wall = box.laid(structure), box.walls["0.png"]
    error = np.abs(result.range[wall] / box.truth["0.png"][wall] - 1)
    assert np.median(error) < 0.01
    assert np.mean(error < 0.03) > 0.95
    assert (result.confidence[wall] < 128).all()
    confirmed = replace(box.maps["0.png"], confidence=np.full(wall.shape, TRUSTED, np.uint8))
    # A ceiling that creases of all views have placed may take wrong ranges near it along.
    alone = wall if ceiling_known else wall & (np.arange(256)[:, None] >= 128)
    np.testing.assert_array_equal(box.laid(structure, range_map=confirmed).range[alone], confirmed.range[alone])


def test_the_crease_is_below_the_upper_edge_of_a_skirting_board() -> None:
    """The edge of the board is ten times as clear as the crease; taken for it, the wall would be 7 % too far away."""
    down, board, distance = 1.6, 0.1, 2.5
    changes = np.zeros((1801, 90, 3), np.float32)
    for height, levels in ((down, 4.0), (down - board, 40.0)):
        row = round((np.pi / 2 - np.arctan2(height, distance)) / STEP_RAD)
        changes[row - HALF_DIFFERENCE : row + HALF_DIFFERENCE + 1] += levels / np.sqrt(3)
    right, wrong = np.full((1, 90), distance), np.full((1, 90), distance * down / (down - board))
    clarity = Skyline(changes).crease_clarity(np.concatenate([right, wrong]), -down)
    assert (clarity[0] > clarity[1]).all()


@pytest.mark.parametrize("half_window", [1, 4])
def test_clarity_is_that_of_all_azimuths(half_window: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those at which a wall is not seen are left out: an arc of each of the four, over the seam for one of them."""
    changes = np.random.default_rng(0).normal(0, 5, (1801, 90, 3)).astype(np.float32)
    sky = Skyline(changes, half_window)
    distance = skyline.wall_distances(sky, 0.3, np.array([1.0, 2.0, 4.0]))
    found = sky.crease_clarity(distance, -1.6)
    assert 0 < np.isfinite(found).mean() < 0.5
    assert skyline._arcs(np.isfinite(distance), half_window).shape[1] < 50
    monkeypatch.setattr(skyline, "_arcs", lambda seen, _: np.broadcast_to(np.arange(seen.shape[1]), seen.shape))
    np.testing.assert_allclose(found, sky.crease_clarity(distance, -1.6), rtol=1e-6)


@pytest.mark.slow
def test_a_plain_ceiling_is_moved_to_its_creases() -> None:
    """Its ranges are 6 % too large in all views."""
    views, (floor, ceiling) = _plain_ceiling(Box((256, 512)), 1.06)
    moved = moved_ceilings(views, [floor, ceiling])
    assert [plane.y for plane in moved] == pytest.approx([HALF[1], -HALF[1]], abs=0.02)
    assert moved[1].uncertainty == 0.05
    assert moved_ceilings(views, [floor, replace(ceiling, uncertainty=0.01)])[1].y == ceiling.y


@pytest.mark.parametrize(
    ("darker", "noise", "most"),
    [
        pytest.param(0.0, 3.0, 0.003, marks=pytest.mark.slow),
        pytest.param(10.0, 0.0, 0.012, marks=pytest.mark.slow),
        pytest.param(None, 3.0, 0.005, marks=pytest.mark.slow),
    ],
    ids=["no creases, noise", "faint creases", "clear creases, noise"],
)
def test_a_plain_ceiling_stays_where_creases_do_not_contradict(darker: float | None, noise: float, most: float) -> None:
    """One faint edge counted as the crease with the floor and as a skirting board.

    Its ranges are exact and weak; a tenth of a degree, a seventh of a pixel, is 0.4 % of its height.
    """
    views, planes = _plain_ceiling(_noisy_box(noise, darker), 1.0)
    assert moved_ceilings(views, planes)[1].y == pytest.approx(-HALF[1], rel=most)


def _noisy_box(noise: float, darker: float | None) -> Box:
    """Return views with a weak ceiling; if `darker` is given, all that is plain is grey, and the ceiling darker."""
    box, random = Box((256, 512)), np.random.default_rng(1)
    for number, name in enumerate(box.maps):
        above = box_range((256, 512), HALF, CENTERS[number])[1][..., 1] > 0.5
        colors = box.pictures[name].astype(np.float64)
        if darker is not None:
            colors[above | box.walls[name]] = 200.0
            colors[above] -= darker
        colors += random.normal(0.0, noise, colors.shape)
        box.pictures[name] = np.clip(np.rint(colors), 0, 255).astype(np.uint8)
        own = box.maps[name]
        box.maps[name] = replace(own, confidence=np.where(above, SEEN, own.confidence).astype(np.uint8))
    return box


@pytest.mark.slow
@pytest.mark.parametrize(
    ("grey", "count"), [pytest.param(True, 0, marks=pytest.mark.slow), (False, 1)], ids=["one grey", "clear creases"]
)
def test_a_ceiling_is_supposed_only_where_creases_show_its_height(grey: bool, count: int) -> None:
    box = Box()
    for name, center in zip(box.maps, CENTERS, strict=True):
        floor = box_range(SIZE, HALF, center)[1][..., 1] < -0.5
        box.pictures[name][~floor] = 200 if grey else box.pictures[name][~floor]
    views, planes = _plain_ceiling(box, 1.0)
    assert len(supposed_ceiling(views, planes[:1])) == count


@pytest.mark.slow
def test_a_ceiling_beyond_the_searched_heights_stays() -> None:
    """Its ranges are 20 % too large, so that creases are clearest at the lowest height that is searched."""
    box = Box()
    for number, name in enumerate(box.maps):
        above = box_range(SIZE, HALF, CENTERS[number])[1][..., 1] > 0.5
        box.maps[name] = replace(box.maps[name], range=box.maps[name].range * np.where(above, 1.2, 1.0).astype("f4"))
    views, (floor, ceiling) = _plain_ceiling(box, 1.2)
    assert moved_ceilings(views, [floor, ceiling])[1] == ceiling


@pytest.mark.slow
def test_a_camera_above_a_tried_ceiling_has_no_creases_with_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """A crease below the camera would be taken for one with the floor."""
    box, downs = Box(), []

    def crease_clarity(sky: Skyline, distance: FloatArray, height: float) -> FloatArray:
        downs.extend([height] if height < 0 else [])
        return CREASE_CLARITY(sky, distance, height)

    monkeypatch.setattr(Skyline, "crease_clarity", crease_clarity)
    box.cams["0.png"] = Rigid3.from_center(np.eye(3), (0.4, -1.2, 0.2))
    views, planes = _plain_ceiling(box, 1.0)
    floors = {round(view.cam_from_world.center[1] - HALF[1], 6) for view in views}
    supposed_ceiling(views, planes[:1])
    assert {round(down, 6) for down in downs} == floors


def _plain_ceiling(box: Box, share: float) -> tuple[list[PlaneView], list[ScenePlane]]:
    """Return the views of a box, its floor, and an uncertain ceiling at a share of its height."""
    views = [
        plane_view(item, lambda name=name: box.pictures[name], box.cams[name])  # type: ignore[misc]
        for name, item in box.maps.items()
    ]
    up = -0.2 - share * (-0.2 + HALF[1])
    return views, [
        ScenePlane(np.array([0.0, sign, 0.0]), sign * y, 5.0, uncertainty=uncertainty, is_level=True)
        for sign, y, uncertainty in ((-1.0, HALF[1], 0.003), (1.0, up, 0.05))
    ]


@pytest.mark.parametrize("first", [True, False])
def test_of_two_rooms_of_one_shape_the_supported_one_is_taken(box: Box, first: bool) -> None:
    """Seen from the camera, both have their creases at the same pixels."""
    center = np.array(CENTERS[0])
    right, smaller = [], []
    for normal in np.concatenate([np.eye(3), -np.eye(3)]):
        offset, at = float(-np.abs(normal) @ HALF), float(normal @ center)
        is_level = normal[1] != 0
        right.append(ScenePlane(normal, offset, 2.0, uncertainty=0.01, is_level=is_level))
        smaller.append(ScenePlane(normal, at + 0.9 * (offset - at), 1.0, uncertainty=0.01, is_level=is_level))
    planes = right + smaller if first else smaller + right
    own = box.maps["0.png"]
    unsure = replace(own, confidence=np.full(SIZE, FILLED_CONFIDENCE[1], np.uint8))
    room = room_of(plane_view(unsure, lambda: box.pictures["0.png"], box.cams["0.png"]), planes)
    assert room is not None
    assert planes[room.floor].support == planes[room.ceiling].support == 2


def test_what_stands_before_a_wall_stays(box: Box, planes: Structure) -> None:
    own = box.maps["0.png"]
    area = np.zeros(SIZE, np.bool_)
    area[60:70, 100:120] = True
    before = replace(own, range=np.where(area, 0.7 * own.range, own.range).astype(np.float32))
    np.testing.assert_array_equal(box.laid(planes, range_map=before).range[area], before.range[area])


@pytest.mark.parametrize("height", [64, 256, 500, 512, 960, 1000, 1920])
def test_the_grid_has_the_form_of_a_panorama(height: int) -> None:
    """Every third column of 2,000 would be an odd number of columns, which no panorama has."""
    pixels = np.arange(2 * height * height).reshape(height, 2 * height)
    rows = grid_rows(height)
    grid = on_grid(pixels, rows)
    assert grid.shape == (rows, 2 * rows)
    assert min(height, 256) <= rows < 512
    assert rows == height or height // rows > 1
    step = height // rows
    if height % rows == 0:
        np.testing.assert_array_equal(grid, pixels[step // 2 :: step, step // 2 :: step])


@pytest.mark.parametrize("masked", [True, False])
def test_colours_of_masked_pixels_are_no_evidence(box: Box, masked: bool) -> None:
    valid = np.full(SIZE, not masked)
    view = OtherView(box.maps["1.png"], box.cams["1.png"], box.pictures["1.png"], valid)
    laid = box.truth["0.png"].astype(np.float64)
    seen = seen_by(view, box.cams["0.png"].center + ray_grid(SIZE) * laid[..., None])
    found = laid_evidence(0.5 * laid, laid, picture=box.pictures["0.png"], views=[seen], at_own=[], error=0.08)[
        "unlike"
    ]
    assert np.isnan(found).all() == masked


def test_views_share_a_place_where_their_ranges_agree(box: Box) -> None:
    truth = {name: ranges.astype(np.float64) for name, ranges in box.truth.items()}
    views = [
        OtherView(as_map(share * truth[name]), box.cams[name], box.pictures[name])
        for name, share in (("1.png", 1.0), ("2.png", 1.05))
    ]
    center, rays = box.cams["0.png"].center, ray_grid(SIZE)
    at_own = [seen_by(view, center + rays * truth["0.png"][..., None]) for view in views]
    laid = 1.2 * truth["0.png"]
    found = laid_evidence(truth["0.png"], laid, picture=box.pictures["0.png"], views=[], at_own=at_own, error=0.08)
    # One view agrees, the other one is off by 5 %; at edges, pixels of both may show another wall.
    assert np.mean(found["shared"] == 1) > 0.9


@pytest.mark.slow
@pytest.mark.parametrize("red", [True, False])
def test_what_is_not_confirmed_before_the_floor_stays_if_other_views_show_another_colour(
    planes: Structure, red: bool
) -> None:
    """A plain table, or a part of the floor whose range is too small: no view confirms it."""
    box = Box()
    for name, picture in box.pictures.items():
        picture[~box.walls[name] & (ray_grid(SIZE)[..., 1] > 0)] = 120
    own, area = box.maps["0.png"], np.zeros(SIZE, np.bool_)
    area[100:112, 60:90] = True
    box.pictures["0.png"][area] = (160, 60, 40) if red else 120
    near = np.where(area, 0.7 * own.range, own.range).astype(np.float32)
    table = replace(own, range=near, confidence=np.where(area, SEEN, own.confidence).astype(np.uint8))
    laid = box.laid(planes, range_map=table).range[area]
    expected = near[area] if red else box.truth["0.png"][area]
    assert np.mean(np.abs(laid / expected - 1) < 0.01) > 0.9


@pytest.mark.slow
@pytest.mark.parametrize("red", [True, False])
def test_a_plane_is_not_laid_where_the_others_see_something_else_behind_it(
    box: Box, planes: Structure, *, red: bool
) -> None:
    """The others see 2.5 times as far through the wall ahead, as through a door, or one is wrong about a plain wall."""
    ahead, middle = ray_grid(SIZE)[..., 2] > 0.5, ray_grid(SIZE)[..., 2] > 0.98
    for picture in box.pictures.values():
        picture[ahead] = 120
    own = box.maps["0.png"]
    far = np.where(ahead, 2.4 * own.range, own.range).astype(np.float32)
    unsure = replace(own, range=far, confidence=np.where(ahead, SEEN, own.confidence).astype(np.uint8))
    others = []
    for name in ("1.png", "2.png"):
        behind = np.where(ahead, 2.5 * box.truth[name], box.maps[name].range).astype(np.float32)
        others.append(replace(box.maps[name], range=behind) if red or name == "1.png" else box.maps[name])
        box.pictures[name][ahead] = (160, 60, 40) if red else 120
    laid = box.laid(planes, range_map=unsure, sources=others).range[middle]
    expected = far[middle] if red else box.truth["0.png"][middle]
    assert np.mean(np.abs(laid / expected - 1) < 0.01) > 0.9


@pytest.mark.slow
@pytest.mark.parametrize("deep", [1.4, np.nan])
def test_nothing_lies_below_the_floor(box: Box, planes: Structure, deep: float) -> None:
    """A view that confirms nothing sees its floor too deep, or not at all; the other views see it."""
    own, down = box.maps["0.png"], ray_grid(SIZE)[..., 1] > 0.6
    floor = down & ~box.walls["0.png"]
    confidence = np.where(floor, np.where(np.isnan(deep), 0, SEEN), own.confidence).astype(np.uint8)
    sunk = replace(own, range=np.where(floor, deep * own.range, own.range).astype(np.float32), confidence=confidence)
    result = box.laid(planes, range_map=sunk)
    assert np.mean(np.abs(result.range[floor] / box.truth["0.png"][floor] - 1) < 0.01) > 0.97
    assert (result.confidence[floor] < 128).mean() > 0.97


def test_what_a_view_confirms_below_the_floor_stays(box: Box, planes: Structure) -> None:
    own, down = box.maps["0.png"], ray_grid(SIZE)[..., 1] > 0.6
    floor = down & ~box.walls["0.png"]
    lower = replace(own, range=np.where(floor, 1.4 * own.range, own.range).astype(np.float32))
    unseen = floor & (np.arange(SIZE[1]) % 3 == 0)
    lower = replace(lower, confidence=np.where(unseen, SEEN, own.confidence).astype(np.uint8))
    places = ray_grid(SIZE)[floor] * lower.range[floor][:, None] + CENTERS[0]
    inside = (np.abs(places) < np.array(HALF) - 0.05)[:, [0, 2]].all(axis=1)
    same = box.laid(planes, range_map=lower).range[floor] == lower.range[floor]
    assert inside.mean() > 0.5
    assert same[inside].mean() > 0.98


def test_without_gravity_there_are_no_planes(box: Box) -> None:
    structure = box.structure(WorldAxes.UNKNOWN)
    assert len(structure) == 0
    np.testing.assert_array_equal(box.laid(structure).range, box.maps["0.png"].range)


def test_no_more_than_four_views_are_in_memory_at_a_time(box: Box, monkeypatch: pytest.MonkeyPatch) -> None:
    used: list[int] = []

    def recorded(*_: object, threads: int, **_named: object) -> list[object]:
        used.append(threads)
        return []

    monkeypatch.setattr(planes_module, "find_planes", recorded)
    monkeypatch.setattr(planes_module, "find_mirrors", recorded)
    poses = Poses.without_points(box.cams, frame="", scale="", metric=True, axes=WorldAxes.LEVEL)
    find_structure(poses, box.maps, box.pictures.__getitem__, rng=np.random.default_rng(0), threads=64)
    assert used == [4, 4]


def test_a_structure_is_checked() -> None:
    wrong = Structure(np.array([[0.0, 2.0, 0.0]]), np.ones(1), np.ones(1), np.zeros(1, np.int32))
    with pytest.raises(ContractError, match="unit length"):
        wrong.check()
    with pytest.raises(ContractError, match="not positive"):
        Structure(np.array([[0.0, 1.0, 0.0]]), np.ones(1), np.zeros(1), np.zeros(1, np.int32)).check()


def test_views_at_several_distances_locate_a_wall_by_an_edge_off_the_planes() -> None:
    """A skirting board is seen instead of the crease; the height of the floor is known."""
    distance, down, board = np.repeat([1.0, 2.0, 3.0, 4.0], 12), 1.6, 0.02
    by_distance, by_height = -down / (distance**2 + down**2), distance / (distance**2 + down**2)
    residual = np.arctan2(down - board, distance) - np.arctan2(down, distance)
    edge = 0.005 * down * np.column_stack([by_height, by_distance])
    weight, crease = np.full(len(distance), np.radians(0.05) ** -2), np.repeat(np.arange(4), 12)
    square, product = creases._information(
        by_distance[:, None], edge, residual, weight=weight, crease=crease, scale=np.radians(0.06)
    )
    common = float(by_distance @ residual / (by_distance @ by_distance))
    assert abs(product[0] / square[0, 0]) < 0.5 * abs(common)
