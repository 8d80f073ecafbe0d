"""Parts of a house stand where links and walls say."""

from __future__ import annotations

import numpy as np
import pytest
from made_tours import MadeTour, made_tour
from pano_mvs_tours.layout import Place, layout
from pano_mvs_tours.parts import Part, part_links

from pano_mvs.geometry import Rigid3
from pano_mvs.scene import SceneLink

WALL_RAD = 0.3


def single(tour: MadeTour, number: int, *, walls: bool = True) -> Part:
    wall = float((WALL_RAD - tour.turns_rad[number]) % (np.pi / 2)) if walls else np.nan
    return Part({str(number): Rigid3.identity()}, wall_rad=wall)


def group(tour: MadeTour, numbers: tuple[int, ...], *, unit: float = 1.0, height: float | None = None) -> Part:
    cameras = {str(number): tour.level_camera(number, unit) for number in numbers}
    return Part(cameras, 1 / unit if height is None else height, WALL_RAD)


def placed(parts: list[Part], tour: MadeTour) -> list[Place]:
    places = layout(parts, part_links(parts, tour.links), rng=np.random.default_rng(0))
    assert all(places)
    return [place for place in places if place is not None]


def errors(tour: MadeTour, places: list[Place], numbers: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Return errors of positions in camera heights, and of turns in degrees, of single panoramas after the first."""
    positions = np.array([place.position for place in places[1:]])
    turns = np.array([place.turn_rad for place in places[1:]])
    off = np.angle(np.exp(1j * (turns - tour.turns_rad[numbers])), deg=True)
    return np.linalg.norm(positions - tour.positions[numbers], axis=1), np.abs(off)


def test_exact_links_put_single_panoramas_where_they_stand() -> None:
    tour = made_tour()
    numbers = [2, 3, 4, 5]
    places = placed([group(tour, (0, 1)), *(single(tour, number) for number in numbers)], tour)
    apart, turned = errors(tour, places, numbers)
    assert apart.max() < 0.02
    assert turned.max() < 0.2


@pytest.mark.slow
def test_walls_correct_the_turns_that_links_give() -> None:
    tour = made_tour(seed=1, noise_deg=8.0)
    numbers = [2, 3, 4, 5]
    with_walls, without = (
        errors(tour, placed([group(tour, (0, 1)), *(single(tour, n, walls=walls) for n in numbers)], tour), numbers)
        for walls in (True, False)
    )
    assert with_walls[1].max() < 1.0 < without[1].max()
    assert with_walls[0].max() < 1.0


def test_a_single_link_through_a_door_does_not_turn_a_room() -> None:
    tour = made_tour(seed=2)
    link = tour.links["0"][1]
    assert link.direction_deg is not None
    tour.links["0"][1] = SceneLink(link.name, (link.direction_deg[0] + 40.0, link.direction_deg[1]))
    numbers = [2, 3, 4, 5]
    apart, turned = errors(tour, placed([group(tour, (0, 1)), *(single(tour, n) for n in numbers)], tour), numbers)
    assert turned.max() < 1.0
    assert apart.max() < 0.5


@pytest.mark.parametrize("unit", [0.2, 1.0, 7.0])
def test_camera_heights_give_groups_one_unit(unit: float) -> None:
    tour = made_tour(seed=3)
    places = placed([group(tour, (0, 1)), group(tour, (2, 3), unit=unit)], tour)
    assert places[1].scale == pytest.approx(unit, rel=0.02)
    assert np.linalg.norm(places[1].position) < 0.02


def test_links_within_a_group_give_the_unit_without_a_floor() -> None:
    tour = made_tour(seed=3)
    places = placed([group(tour, (0, 1)), group(tour, (2, 3), unit=4.0, height=np.nan)], tour)
    assert places[1].scale == pytest.approx(4.0, rel=0.1)


def test_a_link_in_one_direction_alone_gives_the_position() -> None:
    tour = made_tour(seed=4, one_way=(2,))
    places = placed([group(tour, (0, 1)), single(tour, 4, walls=False)], tour)
    assert np.linalg.norm(places[1].position - tour.positions[4]) < 0.02
    assert not np.isfinite(places[1].turn_std_rad), "nothing says how it is turned"


@pytest.mark.parametrize("seed", range(4))
def test_a_turn_that_several_solutions_give_is_not_said_to_be_sure(seed: int) -> None:
    """Walls are parallel after each quarter of a turn, and a link in one direction alone tells none of them."""
    tour = made_tour(seed=seed, one_way=(2,))
    places = placed([group(tour, (0, 1)), single(tour, 4)], tour)
    assert places[1].turn_std_rad > np.deg2rad(60.0)


@pytest.mark.slow
def test_rounding_does_not_choose_between_equal_solutions() -> None:
    tour = made_tour(seed=6, noise_deg=8.0, one_way=(0, 2, 4))
    parts = [group(tour, (0, 1)), *(single(tour, number) for number in (2, 3, 4, 5))]
    links = part_links(parts, tour.links)
    rounded = [link._replace(azimuth_rad=link.azimuth_rad * (1 + 1e-15)) for link in links]
    first, second = (layout(parts, each, rng=np.random.default_rng(0)) for each in (links, rounded))
    for one, other in zip(first, second, strict=True):
        assert one is not None
        assert other is not None
        assert one.turn_rad == pytest.approx(other.turn_rad, abs=1e-3)
        assert np.allclose(one.position, other.position, atol=1e-3)


def test_links_on_the_horizon_stand_at_a_usual_distance() -> None:
    tour = made_tour(seed=5, on_floor=False)
    places = placed([group(tour, (0, 1)), single(tour, 4)], tour)
    assert 1.0 < np.linalg.norm(places[1].position) < 4.0
    assert places[1].position_std > 0.3


def test_parts_that_no_link_joins_have_no_place() -> None:
    tour = made_tour()
    parts = [group(tour, (0, 1)), single(tour, 5)]
    assert layout(parts, part_links(parts, tour.links), rng=np.random.default_rng(0))[1] is None


def test_links_without_directions_are_not_used() -> None:
    tour = made_tour()
    links = {name: [SceneLink(link.name) for link in own] for name, own in tour.links.items()}
    assert part_links([single(tour, number) for number in range(6)], links) == []
