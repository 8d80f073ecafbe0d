"""The benchmarks of poses: a wrong camera is found and makes no others wrong; links of tours against cameras."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.geometry import Rigid3, Similarity3, rotation_from_rotvec
from pano_mvs.scene import Poses
from tests.algorithms.poses.synthetic_capture import random_poses, random_rotation
from tools.benchmarks.poses.placements import judge_placements
from tools.benchmarks.poses.tours.links import offsets, read_links


def poses_of(cameras: dict[str, Rigid3], **more: Any) -> Poses:
    return replace(Poses.without_points(cameras, frame="any", scale="any", metric=False), **more)


def moved(cameras: dict[str, Rigid3], rng: np.random.Generator) -> dict[str, Rigid3]:
    similarity = Similarity3(float(rng.uniform(0.1, 10)), random_rotation(rng), rng.normal(size=3))
    return {name: similarity.move_camera(pose) for name, pose in cameras.items()}


def extent_of(cameras: dict[str, Rigid3]) -> float:
    centers = np.array([pose.center for pose in cameras.values()])
    return float(np.linalg.norm(centers[:, None] - centers, axis=-1).max())


def displaced(
    pose: Rigid3, *, by: NDArray[np.float64] | tuple[float, float, float] = (0.0, 0.0, 0.0), turn_deg: float = 0.0
) -> Rigid3:
    turn = rotation_from_rotvec([0, np.deg2rad(turn_deg), 0])
    return Rigid3.from_center(turn @ pose.rotation, pose.center + np.array(by))


@pytest.mark.parametrize("seed", range(4))
def test_right_cameras_are_right_in_any_world_frame_and_scale(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = random_poses(rng, 6)
    placed = judge_placements(poses_of(moved(truth, rng)), truth)
    assert placed.right.all()
    assert placed.names == tuple(truth)
    assert placed.rotation_deg.max() < 1e-5
    assert placed.center_shares.max() < 1e-9
    assert placed.expected == 6


@pytest.mark.parametrize("seed", range(4))
def test_a_camera_that_is_far_off_spoils_no_other(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = random_poses(rng, 6)
    names = list(truth)
    step = 20 * extent_of(truth) * np.array([0, 0, 1.0])
    estimated = truth | {
        names[2]: displaced(truth[names[2]], by=step),
        names[4]: displaced(truth[names[4]], turn_deg=3),
    }
    placed = judge_placements(poses_of(moved(estimated, rng), doubts={names[4]: "odd"}), truth)
    assert placed.right.tolist() == [True, True, False, True, False, True]
    assert placed.center_shares[2] == pytest.approx(20, rel=1e-6)
    assert placed.rotation_deg[4] == pytest.approx(3, rel=1e-6)
    assert placed.doubted.tolist() == [False] * 4 + [True, False]
    assert placed.unreported == (names[2],)


def test_limits_are_a_degree_and_a_fiftieth_of_the_true_extent() -> None:
    rng = np.random.default_rng(5)
    truth = random_poses(rng, 12)
    names, extent = list(truth), extent_of(truth)
    verdicts = []
    for share, turn_deg in ((0.018, 0.0), (0.03, 0.0), (0.0, 0.95), (0.0, 1.2)):
        estimated = truth | {names[0]: displaced(truth[names[0]], by=(0, share * extent, 0), turn_deg=turn_deg)}
        placed = judge_placements(poses_of(estimated), truth)
        assert placed.right[1:].all()
        verdicts.append(bool(placed.right[0]))
    # The fit to all right cameras takes up a little of what one of twelve is off.
    assert verdicts == [True, False, True, False]


def test_of_two_pieces_that_contradict_each_other_the_larger_is_right() -> None:
    rng = np.random.default_rng(6)
    truth = random_poses(rng, 7)
    names = list(truth)
    shifted = {name: displaced(truth[name], by=(extent_of(truth), 0, 0)) for name in names[:3]}
    placed = judge_placements(poses_of(moved(truth | shifted, rng)), truth)
    assert placed.right.tolist() == [False] * 3 + [True] * 4


def test_groups_are_aligned_each_by_itself() -> None:
    rng = np.random.default_rng(7)
    truth = random_poses(rng, 6)
    names = list(truth)
    first, second = ({name: truth[name] for name in part} for part in (names[:3], names[3:5]))
    estimated = moved(first, rng) | moved(second, rng) | moved({names[5]: truth[names[5]]}, rng)
    group_idx = np.array([0, 0, 0, 1, 1, 2], np.int32)
    placed = judge_placements(poses_of(estimated, group_idx=group_idx), truth)
    assert placed.right.tolist() == [True] * 5
    assert placed.alone == (names[5],)
    assert judge_placements(poses_of(estimated), truth).right.sum() < 5


def test_two_cameras_are_right_though_the_direction_between_them_is_not_exact() -> None:
    """A fit to centres alone once turned two close cameras by the error of their direction, and both were wrong."""
    rng = np.random.default_rng(10)
    truth = random_poses(rng, 6)
    names = list(truth)
    first = truth[names[0]]
    near = 0.05 * extent_of(truth) * np.array([1.0, 0, 0])
    truth[names[1]] = displaced(first, by=near)
    estimated = {names[0]: first, names[1]: displaced(first, by=near + np.array([0, 0.1 * near[0], 0]))}  # 6° off
    assert judge_placements(poses_of(moved(estimated, rng)), truth).right.all()


def assert_links(tour: Path, *, azimuth_rad: float) -> None:
    count, links = read_links(tour)
    assert count == 2
    assert links == {("Hall", "Room"): pytest.approx(azimuth_rad)}


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
    assert_links(tmp_path, azimuth_rad=0.5)
    with pytest.raises(SystemExit, match="no links with directions"):
        read_links(tmp_path / "app-files/tiles")


def test_links_are_read_from_other_configurations(tmp_path: Path) -> None:
    """As people edit data.js by hand, and as Pannellum stores a tour, with angles in degrees."""
    scene = "{{id: '{}', name: '{}', levels: [{{size: 16, tileSize: 16}}], linkHotspots: [{}]}}"
    hall, room = (
        scene.format("hall", "Hall", "{yaw: 0.5, pitch: 0.1, target: 'room'},"),
        scene.format("room", "Room", ""),
    )
    multires = {
        "path": "./room/%l/%s%y_%x",
        "extension": "jpg",
        "tileResolution": 16,
        "maxLevel": 1,
        "cubeResolution": 16,
    }
    spots = [{"sceneId": "b", "yaw": 90.0, "pitch": -10.0}, {"type": "info", "yaw": 1.0}]
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
    assert_links(tmp_path / "marzipano", azimuth_rad=0.5)
    assert_links(tmp_path / "pannellum", azimuth_rad=np.pi / 2)


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
