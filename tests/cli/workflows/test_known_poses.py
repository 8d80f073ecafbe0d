"""Poses from files that fit the capture badly."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import pytest

from tests.cli.conftest import Command, run_json
from tests.stored import read_picture

WORKFLOW = """\
pano_mvs: 1
stages:
  images:   {use: source.folder, path: capture/images}
  poses:    {use: poses.from_model, path: poses.json}
"""
POINTS = """\
  features: {use: features.orb_tangent, max_keypoints: 400}
  pairs:    {use: pairs.exhaustive}
  matches:  {use: matches.brute_force}
  points:   {use: poses.triangulate}
"""


@pytest.fixture
def known(capture: Path) -> Path:
    path = capture.parent / "known.yaml"
    path.write_text(WORKFLOW)
    return path


def write(known: Path, capture: Path, names: list[str], *, one_place: bool = False) -> None:
    """Write a pose for each of the names, one after the other, from the capture's truth."""
    truth = json.loads((capture / "truth" / "poses.json").read_text())
    for view, name in zip(truth["views"], names, strict=False):
        view["image"] = name
        if one_place:
            view["t"] = [0, 0, 0]
    truth["views"] = truth["views"][: len(names)]
    (known.parent / "poses.json").write_text(json.dumps(truth))


def test_one_pose_is_not_given_to_several_pictures(pano_mvs: Command, known: Path, capture: Path) -> None:
    images = capture / "images"
    for folder, names in (("a", ("000.png", "001.png")), ("b", ("002.png", "003.png"))):
        (images / folder).mkdir()
        for name in names:
            (images / name).rename(images / folder / f"{int(name[:3]) % 2:03}.png")
    write(known, capture, ["a/000.png", "a/001.png"])
    known.write_text(WORKFLOW + POINTS)
    result = pano_mvs("run", known, "--out", "out")
    assert result.code == 3, result.text
    assert run_json(Path("out"))["poses"]["registered"] == ["a/000.png", "a/001.png"]
    write(known, capture, ["000.png", "001.png"])
    result = pano_mvs("run", known, "--out", "out")
    assert result.code == 4
    assert "that matches several images" in result.flat


def test_cameras_in_one_place_are_refused(pano_mvs: Command, known: Path, capture: Path) -> None:
    write(known, capture, ["000.png", "001.png", "002.png"], one_place=True)
    result = pano_mvs("run", known, "--out", "out")
    assert result.code == 2
    assert "are in the same place" in result.flat
    assert Path("out/report.html").exists()


def test_names_of_another_capture_are_an_input_error(pano_mvs: Command, known: Path, capture: Path) -> None:
    write(known, capture, ["x.png", "y.png"])
    result = pano_mvs("run", known, "--out", "out")
    assert result.code == 2
    assert "none of its 2 images is one of this capture" in result.flat


def test_poses_of_other_pictures_of_the_same_names_are_refused(pano_mvs: Command, known: Path, capture: Path) -> None:
    """The sample's own poses were given to anybody's 000.png to 003.png once."""
    write(known, capture, ["000.png", "001.png", "002.png", "003.png"])
    assert pano_mvs("run", known, "--out", "out").code == 0
    for path in sorted((capture / "images").iterdir()):
        picture = read_picture(path)
        if path.name == "001.png":
            picture[0, 0] ^= 1
            cv2.imwrite(str(path), picture)
    touched = pano_mvs("run", known, "--out", "out")
    assert touched.code == 0
    assert "001.png is not the image whose pose poses.json records: the files differ" in touched.flat
    for path in sorted((capture / "images").iterdir()):
        cv2.imwrite(str(path), 255 - read_picture(path))
    others = pano_mvs("run", known, "--out", "out")
    assert others.code == 2
    assert "records other images under these names: not one of 4" in others.flat
    for path in sorted((capture / "images").iterdir()):
        cv2.imwrite(str(path.with_suffix(".jpg")), read_picture(path))
        path.unlink()
    assert pano_mvs("run", known, "--out", "out").code == 0, "saved in another format, they must be others"


def test_the_presets_own_poses_are_for_its_own_pictures(pano_mvs: Command, capture: Path) -> None:
    result = pano_mvs("run", "known_poses", "--images", capture / "images", "--until", "poses", "--out", "out")
    assert result.code == 2
    assert "--set poses.path=FILE" in result.flat
