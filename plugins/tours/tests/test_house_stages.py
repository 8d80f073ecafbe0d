"""A tour whose rooms matches do not join becomes one house."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pano_mvs_tours.house import house_file, links
from pano_mvs_tours.source import TourParams, list_tour, tour

from pano_mvs.engine.stages.context import Context
from pano_mvs.geometry import Rigid3
from pano_mvs.io.house_file import read_house
from pano_mvs.scene import Panorama, Poses
from tests.synthetic.tour_files import CONFIGURATIONS, write_configuration, write_tour

KEYS = ("a", "b", "c")
NAMES = ("Hall.png", "Kitchen.png", "Bath.png")


def images_of(folder: Path, program: str) -> dict[str, Panorama]:
    """Return the panoramas of a tour in which the hall and the kitchen lead to each other."""
    write_tour(folder / "tour", program, KEYS)
    titles = dict(zip(KEYS, ("Hall", "Kitchen", "Bath"), strict=True))
    write_configuration(folder / "tour", program, titles, links={"a": ["b"], "b": ["a"]})
    params = TourParams.model_validate({"path": folder / "tour"})
    found = {}
    for item in list_tour(params):
        scratch = folder / item.name
        scratch.mkdir()
        found[item.name] = tour(item, params, Context(np.random.default_rng(0), scratch, 1))
    return found


def poses_of(*names: str) -> Poses:
    cameras = {name: Rigid3(np.eye(3), np.array([-float(idx), 0.0, 0.0])) for idx, name in enumerate(names)}
    return Poses.without_points(cameras, frame="", scale="", metric=False)


@pytest.mark.parametrize("program", CONFIGURATIONS)
def test_links_of_all_programs_place_scenes(tmp_path: Path, program: str) -> None:
    images = images_of(tmp_path, program)
    assert tuple(images) == NAMES
    context = Context(np.random.default_rng(0), tmp_path, 1)
    house = links(poses_of(), images, None, context)
    house.check()
    assert house.placed_by == ("links", "links", "nothing")
    # Both links are at 30° to the right, so that one scene is turned by 180° relative to the other.
    there = house.cam_from_house(1).center - house.cam_from_house(0).center
    assert np.rad2deg(np.arctan2(there[0], there[2])) == pytest.approx(30.0, abs=0.5)
    assert np.allclose(house.rotations[1] @ house.rotations[0].T, np.diag([-1.0, 1.0, -1.0]), atol=0.02)
    # They stand 12° below the horizon, on the floor.
    assert np.linalg.norm(there) / (house.camera_height or 0) == pytest.approx(1 / np.tan(np.deg2rad(12.0)), rel=0.02)
    assert house.links == (("Kitchen.png",), ("Hall.png",), ())


def test_the_file_says_where_panoramas_stand(tmp_path: Path) -> None:
    images = images_of(tmp_path, "Pannellum")
    house = links(poses_of("Hall.png", "Bath.png"), images, None, Context(np.random.default_rng(0), tmp_path, 1))
    assert house.placed_by == ("matches", "links", "matches")
    written = house_file(house, Context(np.random.default_rng(0), tmp_path, 1))
    assert list(written.files) == ["house.json"]
    again = read_house(written.files["house.json"])
    assert again.names == NAMES
    assert np.allclose(again.translations, house.translations)
    assert json.loads(written.files["house.json"].read_text())["panoramas"][1]["placed_by"] == "links"


def test_without_links_there_is_no_file(tmp_path: Path) -> None:
    images = {name: replace(image, links=()) for name, image in images_of(tmp_path, "Pannellum").items()}
    house = links(poses_of(*NAMES), images, None, Context(np.random.default_rng(0), tmp_path, 1))
    assert house.placed_by == ("matches",) * 3
    assert not house_file(house, Context(np.random.default_rng(0), tmp_path, 1)).files


def test_links_are_kept_when_a_panorama_is_stored(tmp_path: Path) -> None:
    image = images_of(tmp_path, "krpano")["Hall.png"]
    parts = image.to_parts()
    again = Panorama.from_parts({**parts, "meta": json.loads(json.dumps(parts["meta"]))})
    assert again.links == image.links
    (link,) = again.links
    assert link.name == "Kitchen.png"
    assert link.direction_deg == pytest.approx((30.0, -12.0))
