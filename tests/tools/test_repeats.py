"""The repeating places: what repeats does so exactly, what is unique is, and the cameras stand where one can stand."""

from __future__ import annotations

from typing import Literal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from pano_mvs.geometry import Rigid3, ray_grid, spiral_rays
from pano_mvs.testing.room import Room, range_along, render
from pano_mvs.testing.surfaces import Cuboid
from tests.synthetic.bounded import Bounded
from tests.synthetic.paints import OAK
from tests.synthetic.scenes import Scene
from tools.benchmarks.repeating.drawings import Drawing
from tools.benchmarks.repeating.places import REPEATS, doors, draw_capture, tiled_hall, twin_rooms
from tools.benchmarks.repeating.prints import Print
from tools.benchmarks.repeating.walks import LAYOUTS, Ground, stands

SIZE = (32, 64)


def seen(scene: Scene, places: NDArray[np.float64], *, down: float = 0.2) -> NDArray[np.float64]:
    """Return the colours of floor points below places (N, 2), seen from straight above at a height."""
    colors = []
    for x, z in places:
        pose = Rigid3.from_center(np.eye(3), (x, -down, z))
        colors.append(render(scene.room, pose, SIZE, supersample=1)[0][SIZE[0] - 6 :].astype(float))
    return np.array(colors)


@pytest.mark.parametrize("tiles", ["marble", "checker", "motif"])
def test_the_floor_repeats_after_a_tile_and_not_if_it_is_worn(tiles: Literal["marble", "checker", "motif"]) -> None:
    tile = 0.45
    period = tile * (2 if tiles == "checker" else 1)
    steps = np.array([[0.13, -0.21]]) + period * np.array([[0, 0], [1, 0], [0, -2], [3, 1]])
    exact = seen(tiled_hall(tile=tile, tiles=tiles, unique=0.0), steps)
    assert np.abs(exact - exact[0]).max() <= 2
    assert exact[0].std() > 2, "the floor is not plain"
    between = seen(tiled_hall(tile=tile, tiles=tiles, unique=0.0), steps[:2] + np.array([[0, 0], [0.3 * tile, 0.2]]))
    assert np.abs(between[1] - between[0]).mean() > 2
    worn = seen(tiled_hall(tile=tile, tiles=tiles, unique=0.0, wear=0.5), steps)
    assert min(np.abs(worn[k] - worn[0]).mean() for k in (1, 2, 3)) > 2


def test_a_corridor_looks_the_same_from_door_to_door() -> None:
    """Far from its ends only they tell one bay of the corridor from the next; its tiles fit into a bay here."""
    scene = doors(bays=12, bay=2.4, tile=0.4, unique=0.0)
    poses = [Rigid3.from_center(np.eye(3), (0.2, -1.5, z)) for z in (0.3, 2.7, 1.5)]
    one, next_, half = (render(scene.room, pose, SIZE)[0].astype(float) for pose in poses)
    near = range_along(scene.room, poses[0].center, ray_grid(SIZE).reshape(-1, 3)).reshape(SIZE) < 4
    assert np.abs(one - next_)[near].max() <= 3
    assert np.abs(one - half)[near].mean() > 5


@pytest.mark.slow
@pytest.mark.parametrize("congruence", ["shift", "half_turn"])
def test_twin_rooms_are_congruent_but_for_unique_things(congruence: Literal["shift", "half_turn"]) -> None:
    def from_both(unique: float) -> tuple[NDArray[np.float64], float]:
        scene = twin_rooms(congruence=congruence, unique=unique, seed=2)
        home, turn = np.array([-2.3, -1.4, 0.3]), np.diag([-1.0, 1.0, -1.0])
        twin = (home + np.array([5.2, 0, 0]), np.eye(3)) if congruence == "shift" else (turn @ home, turn)
        poses = [Rigid3.from_center(np.eye(3), home), Rigid3.from_center(twin[1], twin[0])]
        (one, ranges), (other, other_ranges) = (render(scene.room, pose, SIZE) for pose in poses)
        same = np.isclose(ranges, other_ranges, rtol=1e-5)  # not through the doorway, and where the closed doors are
        return np.abs(one.astype(float) - other)[same], same.mean()

    difference, share = from_both(0.0)
    assert share > 0.9
    assert np.quantile(difference, 0.98) <= 2
    difference, share = from_both(1.0)
    assert (difference > 10).any(axis=1).sum() + (1 - share) * SIZE[0] * SIZE[1] > 80


@pytest.mark.slow
@pytest.mark.parametrize("name", REPEATS)
def test_ranges_are_exact_and_a_seed_is_a_capture(name: str) -> None:
    scene, again, other = (REPEATS[name](seed=seed, views=4, exposure=0.1) for seed in (5, 5, 6))
    image, ranges = scene.view(1, SIZE, supersample=1)
    exact = range_along(scene.room, scene.poses[1].center, ray_grid(SIZE).reshape(-1, 3) @ scene.poses[1].rotation)
    np.testing.assert_array_equal(np.nan_to_num(ranges, nan=np.inf).ravel(), exact.astype(np.float32))
    np.testing.assert_array_equal(again.view(1, SIZE, supersample=1)[0], image)
    assert np.abs(other.view(1, SIZE, supersample=1)[0].astype(float) - image).mean() > 3
    assert np.ptp(np.log(scene.gains)) > 0.02


@pytest.mark.parametrize("seed", range(8))
def test_drawn_captures_have_their_cameras_in_free_places(seed: int) -> None:
    scene = draw_capture(seed)
    assert 6 <= len(scene.poses) <= 12
    centers = np.array([pose.center for pose in scene.poses])
    apart = np.linalg.norm(centers[:, None] - centers, axis=-1) + 9 * np.eye(len(centers))
    assert apart.min() > 0.35
    assert np.median(apart.min(axis=1)) < 1.7
    rays = spiral_rays(400)
    for center in centers:
        ranges = range_along(scene.room, center, rays)
        assert ranges.min() > 0.3
        assert range_along(scene.room, center, np.array([[0, 1.0, 0]]))[0] == pytest.approx(1.5, abs=0.4)
        for surface in scene.room.surfaces:
            inner = surface.surface if isinstance(surface, Bounded) else surface
            if isinstance(inner, Cuboid):
                assert not ((inner.low <= center) & (center <= inner.high)).all()


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("views", [3, 8, 20])
def test_cameras_are_a_step_apart(layout: Literal["unordered", "path", "loop"], views: int) -> None:
    ground = Ground(((-6.0, -9.0, 6.0, 9.0),), ((-0.5, -0.5, 0.5, 0.5),))
    for seed in range(5):
        places = stands(ground, layout, views, np.random.default_rng(seed))
        assert places.shape == (views, 2)
        assert ground.free(places)
        steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
        nearest = np.linalg.norm(places[:, None] - places, axis=-1)
        np.fill_diagonal(nearest, np.inf)
        assert nearest.min(axis=1).max() <= 1.8
        if layout != "unordered":
            assert steps.max() <= 1.8
        if layout == "loop":
            assert np.linalg.norm(places[0] - places[-1]) <= 1.8


@given(seed=st.integers(0, 10_000))
@settings(max_examples=20, deadline=None)
def test_a_bound_hides_nothing(seed: int) -> None:
    rng = np.random.default_rng(seed)
    low = rng.uniform(-2, 1, 3)
    high = low + rng.uniform(0.1, 2, 3)
    box = Cuboid(tuple(low), tuple(high), OAK)
    bounded = Bounded(box, tuple((low + high) / 2), float(np.linalg.norm(high - low) / 2))
    origin, rays = rng.uniform(-3, 3, 3), spiral_rays(500)
    (distance, normals), (expected, true_normals) = bounded.hit(origin, rays), box.hit(origin, rays)
    np.testing.assert_allclose(distance, expected, rtol=1e-12)
    met = np.isfinite(expected)
    np.testing.assert_array_equal(normals[met], true_normals[met])
    patterns = (Print(Drawing("motif", OAK), (0.4, 0.4)),)
    pose = Rigid3.from_center(np.eye(3), origin)
    first, second = (render(Room((surface,), textures=patterns), pose, SIZE)[0] for surface in (bounded, box))
    np.testing.assert_array_equal(first, second)
