"""Ground truth beside a capture, whole, in part and damaged."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pano_mvs.core.errors import InputError
from pano_mvs.geometry import Rigid3
from pano_mvs.io.poses.files import read_poses
from pano_mvs.io.truth import read_truth
from pano_mvs.testing.room import Room, capture_poses, default_room, render
from pano_mvs.testing.surfaces import Ball
from tests.stored import write_npz
from tests.synthetic.capture_files import write_capture

SIZE = (16, 32)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("capture")
    write_capture(folder, default_room(), capture_poses(3), size_hw=SIZE)
    return folder


def edited(capture: Path, tmp_path: Path, change: Callable[[dict[str, Any]], object]) -> Path:
    """A copy of the truth with poses.json changed."""
    data = json.loads((capture / "truth" / "poses.json").read_text())
    change(data)
    (tmp_path / "poses.json").write_text(json.dumps(data))
    return tmp_path


def test_poses_ranges_and_digests_are_those_of_the_room(capture: Path) -> None:
    truth = read_truth(capture / "truth")
    assert truth.metric
    assert list(truth.views) == ["images/000.png", "images/001.png", "images/002.png"]
    for (name, view), pose in zip(truth.views.items(), capture_poses(3), strict=True):
        np.testing.assert_array_equal(view.cam_from_world.rotation, pose.rotation)
        np.testing.assert_array_equal(truth.poses[name].translation, pose.translation)
        np.testing.assert_array_equal(truth.range_map(view), render(default_room(), pose, SIZE)[1])
        assert view.sha256 == hashlib.sha256((capture / name).read_bytes()).hexdigest()


def test_images_are_found_by_the_names_that_a_capture_gives_them(capture: Path) -> None:
    matched = read_truth(capture / "truth").match(["002.png", "000.jpg", "other.png"])
    assert {name: view.name for name, view in matched.items()} == {
        "002.png": "images/002.png",
        "000.jpg": "images/000.png",
    }


def test_where_there_is_no_surface_the_range_is_nan(tmp_path: Path) -> None:
    room = Room((Ball((0, 0, 3), 1.0, ((1, 1, 1), (1, 1, 1))),))
    write_capture(tmp_path, room, [Rigid3.identity()], size_hw=SIZE)
    assert np.isinf(np.load(tmp_path / "truth" / "depth.npz")["000"]).any()
    truth = read_truth(tmp_path / "truth")
    expected = render(room, Rigid3.identity(), SIZE)[1]
    np.testing.assert_array_equal(truth.range_map(truth.views["images/000.png"]), expected)


def test_views_without_ranges_and_ranges_without_views_do_no_harm(capture: Path, tmp_path: Path) -> None:
    folder = edited(capture, tmp_path, lambda data: data["views"].pop())
    ranges = {"001": np.ones(SIZE, np.float32), "077": np.ones(SIZE, np.float32)}
    write_npz(folder / "depth.npz", ranges)
    truth = read_truth(folder)
    assert truth.range_map(truth.views["images/000.png"]) is None
    np.testing.assert_array_equal(truth.range_map(truth.views["images/001.png"]), ranges["001"])


def test_without_any_ranges_there_are_poses(capture: Path, tmp_path: Path) -> None:
    truth = read_truth(edited(capture, tmp_path, lambda data: None))
    assert len(truth.poses) == 3
    assert {truth.range_map(view) for view in truth.views.values()} == {None}


def test_ranges_are_found_by_the_views_number(capture: Path, tmp_path: Path) -> None:
    folder = edited(capture, tmp_path, lambda data: data["views"][1].update(image="images/lobby.png"))
    write_npz(folder / "depth.npz", {"001": np.full(SIZE, 2, np.float32)})
    truth = read_truth(folder)
    file = truth.views["images/lobby.png"].range_file
    assert file is not None
    assert file.key == "001"


def test_damaged_ranges_are_named(capture: Path, tmp_path: Path) -> None:
    folder = edited(capture, tmp_path, lambda data: None)
    (folder / "depth.npz").write_bytes(b"PK\x03\x04 this is no archive")
    with pytest.raises(InputError, match=r"depth\.npz: not a readable \.npz file"):
        read_truth(folder)
    whole = (capture / "truth" / "depth.npz").read_bytes()
    (folder / "depth.npz").write_bytes(whole[:300] + bytes(100) + whole[400:])
    truth = read_truth(folder)
    with pytest.raises(InputError, match=r"depth\.npz: the range map of images/000\.png cannot be read"):
        truth.range_map(truth.views["images/000.png"])
    write_npz(folder / "depth.npz", {"000": np.zeros(3, np.float32)})
    truth = read_truth(folder)
    with pytest.raises(InputError, match=r"depth\.npz: 000 holds \(3,\) float32, not a map of ranges"):
        truth.range_map(truth.views["images/000.png"])


def test_the_same_file_gives_known_poses(capture: Path) -> None:
    poses = read_poses(capture / "truth" / "poses.json")
    poses.check()
    assert poses.metric
    assert poses.names == ("images/000.png", "images/001.png", "images/002.png")
    np.testing.assert_array_equal(poses.rotations[2], capture_poses(3)[2].rotation)
    assert read_poses(capture).names == poses.names


@pytest.mark.parametrize(
    ("change", "what"),
    [
        (lambda data: data.update(views=3), "key 'views' must be a list"),
        (lambda data: data.update(views=[]), "contains no poses"),
        (lambda data: data["views"].insert(1, 5), r"views\[1\]: expected an object, got int"),
        (lambda data: data["views"][1].pop("image"), r"views\[1\]: key 'image' must be the name of the image"),
        (lambda data: data["views"][1].update(R=[[1, 0], [0, 1]]), r"views\[1\]: key 'R' must hold 3 × 3 numbers"),
        (lambda data: data["views"][2].update(t=["a", 0, 0]), r"views\[2\]: key 't' must hold 3 numbers"),
        (lambda data: data["views"][0].update(R=[[2, 0, 0], [0, 1, 0], [0, 0, 1]]), r"views\[0\] .*not orthonormal"),
        (lambda data: data["views"][0].update(R=[[-1, 0, 0], [0, 1, 0], [0, 0, 1]]), r"views\[0\] .*reflection"),
        (lambda data: data["views"][0].update(t=[float("nan"), 0, 0]), r"views\[0\] .*NaN"),
        (lambda data: data["views"][0].update(image="images/001.png"), "'images/001.png' is listed twice"),
    ],
)
def test_a_malformed_entry_is_named_with_its_key(
    capture: Path, tmp_path: Path, change: Callable[[dict[str, Any]], object], what: str
) -> None:
    with pytest.raises(InputError, match=rf"poses\.json: .*{what}"):
        read_truth(edited(capture, tmp_path, change))


class TestPicturesOfOneNameInTwoFolders:
    @staticmethod
    def written(folder: Path, names: Sequence[str], keys: Sequence[str]) -> Path:
        pose = {"R": np.eye(3).tolist(), "t": [0, 0, 0]}
        data = {"views": [{"image": name, **pose} for name in names]}
        (folder / "poses.json").write_text(json.dumps(data))
        write_npz(folder / "depth.npz", {key: np.full((2, 4), idx + 1.0) for idx, key in enumerate(keys)})
        return folder

    @pytest.mark.parametrize("keys", [("a/1", "b/1"), ("a/1.png", "b/1.png"), ("images/a/1", "images/b/1")])
    def test_each_has_its_own_range_map(self, tmp_path: Path, keys: tuple[str, str]) -> None:
        truth = read_truth(self.written(tmp_path, ["images/a/1.png", "images/b/1.png"], keys))
        ranges = [truth.range_map(view) for view in truth.views.values()]
        assert [None if map_ is None else float(map_[0, 0]) for map_ in ranges] == [1, 2]

    def test_one_map_for_both_is_refused(self, tmp_path: Path) -> None:
        with pytest.raises(InputError, match=r"array 1 might be that of a/1\.png or of b/1\.png.*such as b/1"):
            read_truth(self.written(tmp_path, ["a/1.png", "b/1.png"], ["1"]))

    def test_a_whole_name_goes_before_a_stem(self, tmp_path: Path) -> None:
        views = read_truth(self.written(tmp_path, ["b/1.png", "1.png"], ["1"])).views
        assert {name: view.range_file and view.range_file.key for name, view in views.items()} == {
            "b/1.png": None,
            "1.png": "1",
        }
