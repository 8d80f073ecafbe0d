"""The rooms in which panoramas were taken."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from box_run import NAMES, box_run
from pano_mvs_page.scene_parts import ShareOptions
from pano_mvs_page.share import Sight, given_rooms, rooms_by_sight, rooms_of, share_run
from test_share import value_of
from typer.testing import CliRunner

from pano_mvs.cli.app import app
from pano_mvs.core.errors import InputError
from pano_mvs.geometry import Rigid3, ray_grid, rotation_from_rotvec


def sight(center: tuple[float, float, float], turned: float) -> Sight:
    """Return what is seen in two rooms of 4 by 3 by 5, side by side along x, with a doorway 0.8 wide between them."""
    rotation = rotation_from_rotvec([0, turned, 0])
    rays = ray_grid((64, 128)) @ rotation
    origin = np.array(center)
    with np.errstate(divide="ignore", invalid="ignore"):
        ranges = _to_walls(origin, rays, np.sign(origin[0]))
        through = -origin[0] / rays[..., 0]
        door = origin + through[..., None] * rays
        open_ = (through > 0) & (np.abs(door[..., 2]) < 0.4) & (door[..., 1] > -0.6)
        ranges = np.where(open_, _to_walls(origin, rays, -np.sign(origin[0])), ranges)
    return Sight(Rigid3.from_center(rotation, origin), ranges.astype(np.float32))


def _to_walls(origin: np.ndarray, rays: np.ndarray, side: float) -> np.ndarray:
    low, high = np.array([min(0, 4 * side), -1.5, -2.5]), np.array([max(0, 4 * side), 1.5, 2.5])
    distances = np.where(rays > 0, high - origin, low - origin) / rays
    return np.asarray(np.min(distances, axis=-1, where=rays != 0, initial=np.inf))


CENTERS = [(-1.0, 0, 0), (1.2, 0.1, -1), (-3.0, 0.1, 1.5), (3.0, 0, 2), (-2.5, 0, -1.8), (2.2, 0, 0)]


@pytest.mark.parametrize("holes", [0.0, 0.4])
def test_rooms_are_distinguished_by_what_their_panoramas_see(holes: float) -> None:
    rng = np.random.default_rng(0)
    sights = [sight(center, turned) for center, turned in zip(CENTERS, rng.uniform(-3, 3, 6), strict=True)]
    for each in sights:
        each.ranges[rng.random(each.ranges.shape) < holes] = np.nan
    assert rooms_by_sight(sights) == [1, 2, 1, 2, 1, 2]
    assert rooms_by_sight(sights[::2]) == [1, 1, 1]
    names = [f"{idx}.jpg" for idx in range(6)]
    seen = dict(zip(names, sights, strict=True))
    assert rooms_of(names, seen) == ["Room 1", "Room 2"] * 3
    assert rooms_of([*names, "lost.jpg"], seen)[-1] == ""
    assert rooms_of(names[::2], seen) == [""] * 3  # one room needs no name


def test_folders_and_names_without_digits_name_rooms() -> None:
    assert rooms_of(["tour/kitchen/01.jpg", "tour/hall/01.jpg"], {}) == ["kitchen", "hall"]
    assert rooms_of(["living_room.jpg", "entry.jpg"], {}) == ["living room", "entry"]
    assert rooms_of(["day1/a1.jpg", "day2/b1.jpg"], {}) == ["", ""]
    assert rooms_of(["lobby/a1.jpg", "lobby/b1.jpg"], {}) == ["", ""]


def test_a_file_names_rooms(tmp_path: Path) -> None:
    run = box_run(tmp_path, points=500)
    rooms = tmp_path / "rooms.yaml"
    rooms.write_text("Küche: [lobby/000.png]\nHall: ['*/00[12].png']\n", encoding="utf-8")
    assert rooms_of(NAMES, {}, given_rooms(rooms)) == ["Küche", "Hall", "Hall"]
    done = CliRunner().invoke(app, ["share", str(run.out), "--to", str(tmp_path / "page"), "--rooms", str(rooms)])
    assert done.exit_code == 0, done.output
    cameras = value_of(tmp_path / "page" / "data" / "scene.js")["cameras"]
    assert [camera["room"] for camera in cameras] == ["Küche", "Hall", "Hall"]


def test_names_that_match_nothing_are_noted(tmp_path: Path) -> None:
    run = box_run(tmp_path, points=500)
    rooms = {"Küche": [NAMES[0], "nosuch.jpg"], "Hall": ["*"], "Up": ["up/*"]}
    shared = share_run(run, tmp_path / "page", ShareOptions(rooms=rooms))
    assert [note for note in shared.notes if "--rooms" in note] == [
        f"--rooms: {name} matches no panorama of the page" for name in ("nosuch.jpg", "up/*")
    ]
    (tmp_path / "rooms.yaml").write_text(f"Hall: ['{NAMES[0]}']\n", encoding="utf-8")
    share_run(run, tmp_path / "page", ShareOptions(rooms=str(tmp_path / "rooms.yaml")))
    cameras = value_of(tmp_path / "page" / "data" / "scene.js")["cameras"]
    assert [camera["room"] for camera in cameras] == ["Hall", "", ""]
    assert rooms_of(["a[1].jpg", "b.jpg"], {}, {"Hall": ["a[1].jpg"]}) == ["Hall", ""]


@pytest.mark.parametrize("entry", ["5", "null", "[a]", "{a: b}"])
def test_a_name_that_is_not_text_is_refused(tmp_path: Path, entry: str) -> None:
    (tmp_path / "rooms.yaml").write_text(f"Up: [a.jpg, {entry}]\n")
    with pytest.raises(InputError, match=r"--rooms .*rooms\.yaml: Up: .* is not text"):
        given_rooms(tmp_path / "rooms.yaml")


@pytest.mark.parametrize("text", ["- a\n- b\n", "Hall: 3\n", "Hall: [a\n", ""])
def test_a_file_of_another_layout_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "rooms.yaml").write_text(text)
    with pytest.raises(InputError, match=r"--rooms.*rooms\.yaml"):
        given_rooms(tmp_path / "rooms.yaml")
    with pytest.raises(InputError, match=r"none\.yaml"):
        given_rooms(tmp_path / "none.yaml")


def test_rooms_of_another_layout_are_refused(tmp_path: Path) -> None:
    run = box_run(tmp_path, points=500)
    for rooms, told in (("nofile", "nofile"), ({"Hall": "a.jpg"}, "lists of panoramas"), ({"Hall": [5]}, "5 is not")):
        with pytest.raises(InputError, match=told):
            share_run(run, tmp_path / "page", ShareOptions(rooms=rooms))  # type: ignore[arg-type]
    assert not (tmp_path / "page").exists()
