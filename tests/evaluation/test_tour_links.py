"""Links of virtual tours are compared with the directions of cameras."""

from __future__ import annotations

import json
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from pano_mvs.geometry import Rigid3, rotation_from_rotvec
from tests.evaluation.test_placements import poses_of
from tools.benchmarks.poses.tours.links import offsets, read_links


def test_links_are_read_from_the_scenes_of_a_tour(tmp_path: Path) -> None:
    levels = [{"size": 16, "tileSize": 16}]
    link = {"yaw": 0.5, "pitch": 0.1, "target": "1-room"}
    scenes = [
        {"id": "0-hall", "name": "Hall", "levels": levels, "linkHotspots": [link]},
        {"id": "1-room", "name": "Room", "levels": levels, "linkHotspots": []},
    ]
    for scene, face in product(("0-hall", "1-room"), "frblud"):
        tile = tmp_path / f"app-files/tiles/{scene}/0/{face}/0/0.jpg"
        tile.parent.mkdir(parents=True)
        tile.touch()
    (tmp_path / "app-files/data.js").write_text(f"var APP_DATA = {json.dumps({'scenes': scenes})};\n")
    assert read_links(tmp_path) == (2, {("Hall", "Room"): 0.5})
    with pytest.raises(SystemExit, match=r"no data\.js"):
        read_links(tmp_path / "app-files/tiles")


def test_links_are_read_from_other_configurations(tmp_path: Path) -> None:
    """As people edit data.js by hand, and as Pannellum stores a tour, with angles in degrees."""
    scene = "{{id: '{}', name: '{}', levels: [{{size: 16, tileSize: 16}}], linkHotspots: [{}]}}"
    hall, room = scene.format("hall", "Hall", "{yaw: 0.5, target: 'room'},"), scene.format("room", "Room", "")
    multires = {
        "path": "./room/%l/%s%y_%x",
        "extension": "jpg",
        "tileResolution": 16,
        "maxLevel": 1,
        "cubeResolution": 16,
    }
    spots = [{"sceneId": "b", "yaw": 90.0}, {"type": "info", "yaw": 1.0}]
    stated = {
        "a": {
            "title": "Hall",
            "type": "multires",
            "multiRes": multires | {"path": "./hall/%l/%s%y_%x"},
            "hotSpots": spots,
        },
        "b": {"title": "Room", "type": "multires", "multiRes": multires, "hotSpots": []},
    }
    for name, face in product(("hall", "room"), "frblud"):
        for tile in (f"marzipano/tiles/{name}/0/{face}/0/0.jpg", f"pannellum/{name}/1/{face}0_0.jpg"):
            (tmp_path / tile).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / tile).touch()
    (tmp_path / "marzipano/data.js").write_text(f"var APP_DATA = {{scenes: [{hall}, {room},]}};\n")
    (tmp_path / "pannellum/tour.json").write_text(json.dumps({"default": {"firstScene": "a"}, "scenes": stated}))
    assert read_links(tmp_path / "marzipano") == (2, {("Hall", "Room"): 0.5})
    assert read_links(tmp_path / "pannellum") == (2, {("Hall", "Room"): np.pi / 2})


def test_a_link_is_off_by_the_angle_to_the_other_camera() -> None:
    """The room lies in front of the hall, and the hall to the right of the room's camera."""
    turned = rotation_from_rotvec(np.array([0.0, np.pi / 2, 0.0]))
    cameras = {
        "0-hall.png": Rigid3.from_center(np.eye(3), np.zeros(3)),
        "1-room.png": Rigid3.from_center(turned.T, np.array([0.0, 0.0, 2.0])),
    }
    ray = cameras["1-room.png"].rotation @ np.array([0.0, 0.0, -2.0])
    links = {
        ("0-hall", "1-room"): np.deg2rad(10.0),
        ("1-room", "0-hall"): float(np.arctan2(ray[0], ray[2])) + 2 * np.pi,
        ("0-hall", "2-garden"): 1.0,
    }
    poses = poses_of(cameras, doubts={"1-room.png": "a reason"})
    there, back = offsets(poses, links)
    assert (there.scene, there.target, there.doubted) == ("0-hall", "1-room", True)
    assert there.off_deg == pytest.approx(10.0)
    assert back.off_deg == pytest.approx(0.0, abs=1e-6)
