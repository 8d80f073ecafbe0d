"""house.json says where panoramas stand, and is read as it was written."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from pano_mvs.core.errors import InputError
from pano_mvs.io.house_file import house_document, read_house
from pano_mvs.scene import House, RoomOutline


def house() -> House:
    return House(
        names=("a", "b"),
        rotations=np.array([np.eye(3), np.diag([-1.0, 1.0, -1.0])]),
        translations=np.array([[0.0, 0.0, 0.0], [1.0, 2.0, 3.0]]),
        parts=np.array([0, 1], np.int32),
        groups=np.array([0, -1], np.int32),
        scales=np.array([1.0, 1.0]),
        placed_by=("matches", "links"),
        center_stds=np.array([0.0, np.inf]),
        turn_stds_rad=np.array([0.0, 0.1]),
        links=(("b",), ()),
        camera_height=1.5,
    )


def test_a_house_is_read_as_it_was_written(tmp_path: Path) -> None:
    file = tmp_path / "house.json"
    file.write_text(json.dumps(house_document(house())))
    again = read_house(file)
    assert again.names == ("a", "b")
    assert again.placed_by == ("matches", "links")
    assert again.groups.tolist() == [0, -1]
    assert again.camera_height == 1.5
    assert again.links == (("b",), ())
    assert np.allclose(again.rotations, house().rotations)
    assert np.allclose(again.translations, house().translations)
    assert again.center_stds.tolist() == [0.0, np.inf]
    assert np.allclose(again.turn_stds_rad, [0.0, 0.1])


def room() -> RoomOutline:
    distances = np.linspace(1.0, 2.0, 360).astype(np.float32)
    distances[7] = np.nan
    probabilities = np.where(np.isnan(distances), np.float32(np.nan), np.float32(0.75))
    return RoomOutline(np.diag([1.0, -1.0, -1.0]), 0.3, 0.62, distances, probabilities)


def test_rooms_are_read_as_they_were_written(tmp_path: Path) -> None:
    file = tmp_path / "house.json"
    nothing = RoomOutline.unknown()
    with_rooms = house().with_rooms({"b": room(), "a": nothing, "gone": room()})
    with_rooms.check()
    file.write_text(json.dumps(house_document(with_rooms), allow_nan=False))
    again = read_house(file).rooms
    assert list(again) == ["b"]
    assert again["b"].ceiling == 0.62
    assert again["b"].wall_rad == pytest.approx(0.3, abs=1e-4)
    assert np.array_equal(again["b"].cam_from_level, room().cam_from_level)
    assert np.allclose(again["b"].distances, room().distances, atol=1e-4, equal_nan=True)
    assert np.allclose(again["b"].probabilities, room().probabilities, equal_nan=True)
    # Files of earlier versions say nothing of rooms.
    document = house_document(house())
    for row in document["panoramas"]:
        del row["room"]
    file.write_text(json.dumps(document))
    assert read_house(file).rooms == {}


@pytest.mark.parametrize(
    ("field", "value"),
    [
        *(("distances", value) for value in ([1.0] * 3, [-1.0] * 360, ["far"] * 360, [10**400] * 360)),
        *(("ceiling", value) for value in (0.0, -0.5, 10**400, None, "high")),
        *(("rotation", value) for value in ([[0.0] * 3] * 3, [[100.0, 0, 0], [0, 100, 0], [0, 0, 100]], 7)),
        *(("probabilities", value) for value in ([-5.0] * 360, [0.5] * 3, [None] * 360)),
        ("wall_deg", None),
    ],
)
def test_a_room_that_cannot_be_is_refused_by_name(tmp_path: Path, field: str, value: object) -> None:
    document = house_document(house().with_rooms({"b": room()}))
    document["panoramas"][1]["room"][field] = value
    file = tmp_path / "house.json"
    file.write_text(json.dumps(document))
    with pytest.raises(InputError, match=r"house\.json"):
        read_house(file)


@pytest.mark.parametrize(
    "text", ["", "[]", "{}", '{"panoramas": [{}], "camera_height": null}', '{"panoramas": 3, "camera_height": null}']
)
def test_another_file_is_refused_by_name(tmp_path: Path, text: str) -> None:
    file = tmp_path / "house.json"
    file.write_text(text)
    with pytest.raises(InputError, match=r"house\.json"):
        read_house(file)


@pytest.mark.parametrize("height", [10**400, 0, -1.0, "high", 1e999])
def test_a_height_that_cannot_be_is_refused_by_name(tmp_path: Path, height: object) -> None:
    file = tmp_path / "house.json"
    file.write_text(json.dumps(house_document(house()) | {"camera_height": height}))
    with pytest.raises(InputError, match=r"house\.json"):
        read_house(file)


def test_a_place_by_an_unknown_source_is_refused(tmp_path: Path) -> None:
    document = house_document(house())
    document["panoramas"][0]["placed_by"] = "magic"
    file = tmp_path / "house.json"
    file.write_text(json.dumps(document))
    with pytest.raises(InputError, match="placed_by"):
        read_house(file)
