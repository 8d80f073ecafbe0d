"""`evaluate` is a group of commands, and still takes an output folder at once."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from pano_mvs.geometry import Rigid3, Similarity3, quat_wxyz_from_rotation, rotation_from_rotvec
from tests.algorithms.poses.synthetic_capture import random_poses, random_rotation
from tests.cli.conftest import Command


def write_json(path: Path, poses: dict[str, Rigid3], *, metric: bool = True) -> Path:
    views = [{"image": n, "R": p.rotation.tolist(), "t": p.translation.tolist()} for n, p in poses.items()]
    path.write_text(json.dumps({"metric": metric, "views": views}))
    return path


def write_csv(path: Path, poses: dict[str, Rigid3]) -> Path:
    lines = ["name,tx,ty,tz,qw,qx,qy,qz"]
    for name, pose in poses.items():
        numbers = [*pose.translation, *quat_wxyz_from_rotation(pose.rotation)]
        lines.append(",".join([name, *(repr(float(number)) for number in numbers)]))
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.fixture
def truth() -> dict[str, Rigid3]:
    return random_poses(np.random.default_rng(11), 5)


def test_poses_in_another_world_unit_form_and_folder_have_no_error(
    pano_mvs: Command, tmp_path: Path, truth: dict[str, Rigid3]
) -> None:
    moved = Similarity3(4.0, random_rotation(np.random.default_rng(1)), np.ones(3))
    model = write_csv(tmp_path / "m.csv", {f"deep/{n}": moved.move_camera(pose) for n, pose in truth.items()})
    result = pano_mvs("evaluate", "poses", model, "--truth", write_json(tmp_path / "t.json", truth), "--json")
    assert result.code == 0, result.text
    told = json.loads(result.text)
    assert (told["registered"], told["of"], told["pairs"], told["unit"]) == (5, 5, 10, "m")
    for errors in ("rotation_deg", "direction_deg", "pair_deg", "center"):
        assert 0 <= told[errors]["median"] <= told[errors]["max"] < 1e-4
    assert told["auc"].keys() == {"0.1", "0.5", "1", "5"}
    assert told["auc"]["5"] == pytest.approx(1, abs=1e-5)
    assert told["center"]["scale"] == pytest.approx(0.25)
    assert told["scale_ratio_error"]["max"] < 1e-6
    assert told["without_truth"] == []


def test_the_table_tells_a_turned_camera_and_a_missing_one(
    pano_mvs: Command, tmp_path: Path, truth: dict[str, Rigid3]
) -> None:
    turn = Rigid3(rotation_from_rotvec([0, np.deg2rad(2.0), 0]), np.zeros(3))
    estimated = {**truth, "1.jpg": turn @ truth["1.jpg"], "more.jpg": truth["0.jpg"]}
    del estimated["4.jpg"]
    model, known = write_json(tmp_path / "m.json", estimated), write_json(tmp_path / "t.json", truth, metric=False)
    text = pano_mvs("evaluate", "poses", model, "--truth", known).flat
    assert "4 of 5 images registered" in text
    assert "over 6 pairs of registered images" in text
    assert "AUC over all 10 pairs, %: 30.0 @ 0.1°" in text
    assert "camera centre, units of the truth" in text
    assert "no ground truth for more.jpg" in text
    told = json.loads(pano_mvs("evaluate", "poses", model, "--truth", known, "--json").text)
    assert told["rotation_deg"]["max"] == pytest.approx(2.0, abs=1e-6)
    assert told["pair_deg_all"]["max"] == 180


def test_two_images_and_duplicates_are_compared_too(
    pano_mvs: Command, tmp_path: Path, truth: dict[str, Rigid3]
) -> None:
    two = {name: truth[name] for name in ("0.jpg", "1.jpg")}
    twice = {**two, "again.jpg": truth["0.jpg"]}
    for poses in (two, twice):
        moved = Similarity3(0.1, random_rotation(np.random.default_rng(2)), np.ones(3))
        model = write_json(tmp_path / "m.json", {name: moved.move_camera(pose) for name, pose in poses.items()})
        known = write_json(tmp_path / "t.json", poses)
        told = json.loads(pano_mvs("evaluate", "poses", model, "--truth", known, "--json").text)
        assert told["center"]["max"] < 1e-6
        assert told["pair_deg"]["max"] < 1e-4
    one_place = write_json(tmp_path / "m.json", dict.fromkeys(two, truth["0.jpg"]))
    result = pano_mvs("evaluate", "poses", one_place, "--truth", write_json(tmp_path / "t.json", two))
    assert result.code == 0
    assert "camera centres are not compared: the estimated centres of all 2 images coincide" in result.flat
    told = json.loads(pano_mvs("evaluate", "poses", one_place, "--truth", tmp_path / "t.json", "--json").text)
    assert "coincide" in told["center"]["reason"]
    assert told["scale_ratio_error"] == {"median": None, "max": None}


def test_what_cannot_be_compared_is_named(pano_mvs: Command, tmp_path: Path, truth: dict[str, Rigid3]) -> None:
    known = write_json(tmp_path / "t.json", truth)
    others = write_json(tmp_path / "m.json", {f"x{name}": pose for name, pose in truth.items()})
    result = pano_mvs("evaluate", "poses", others, "--truth", known)
    assert result.code == 2
    assert "have no images in common, two are needed" in result.flat
    assert "x0.jpg, x1.jpg, x2.jpg … (5 in all)" in result.flat
    single = write_json(tmp_path / "s.json", {"0.jpg": truth["0.jpg"]})
    assert "have 1 image in common" in pano_mvs("evaluate", "poses", single, "--truth", known).flat
    ambiguous = write_json(tmp_path / "a.json", {f"{d}/{name}": pose for d in "ab" for name, pose in truth.items()})
    assert "have no images in common" in pano_mvs("evaluate", "poses", ambiguous, "--truth", known).flat
    assert "no such file or folder" in pano_mvs("evaluate", "poses", tmp_path / "nothing", "--truth", known).flat
    assert pano_mvs("evaluate", "poses", others).code == 2


def test_the_old_form_still_takes_an_output_folder(pano_mvs: Command, tmp_path: Path) -> None:
    for call in (
        ("evaluate", tmp_path, "--truth", tmp_path),
        ("evaluate", "run", tmp_path, "--truth", tmp_path),
        ("evaluate", "--truth", tmp_path, tmp_path),
    ):
        result = pano_mvs(*call)
        assert result.code == 2
        assert "Give the output folder of a finished run" in result.flat
    help_text = pano_mvs("evaluate", "--help")
    assert help_text.code == 0
    assert "poses" in help_text.text
    assert "run" in help_text.text
    assert pano_mvs("evaluate", "run", "--help").code == 0
