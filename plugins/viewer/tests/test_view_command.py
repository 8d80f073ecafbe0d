"""`pano-mvs view` and `pano_mvs.view_run`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import pano_mvs
from pano_mvs.cli.app import app
from pano_mvs.geometry import ray_from_pixel
from pano_mvs.scene.image_file import decode_image
from tests.cli.conftest import Outcome
from tests.synthetic.viewed_scenes import turned_poses, world_color, write_output


def view(*arguments: object, **environment: str) -> Outcome:
    result = CliRunner().invoke(app, ["view", *map(str, arguments)], env={"COLUMNS": "200", **environment})
    return Outcome(result.exit_code, result.output)


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_output(tmp_path_factory.mktemp("view"), turned_poses(3), points=3000)


@pytest.mark.parametrize("name", ["a.png", "deep/b.jpg"])
def test_a_picture_is_written_without_a_display(out: Path, tmp_path: Path, name: str) -> None:
    file = tmp_path / name
    outcome = view(out, "--screenshot", file, "--size", "320x200", "--view", "inside:001", DISPLAY="")
    assert outcome.code == 0, outcome.text
    assert f"picture in {file}" in outcome.flat
    picture = decode_image(file)
    assert picture.shape == (200, 320, 3)
    ahead = turned_poses(3)["lobby/001.png"].rotation.T @ ray_from_pixel([64, 32], (64, 128))
    assert np.abs(picture[100, 160].astype(int) - world_color(ahead)).max() <= 10


def test_a_run_is_viewed_from_python(out: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    options = pano_mvs.ViewOptions(screenshot=str(tmp_path / "a.png"), images=str(tmp_path), size="320x200")
    picture = pano_mvs.view_run(str(out), options)
    assert picture is not None
    assert (picture == decode_image(tmp_path / "a.png")).all()
    with pytest.raises(pano_mvs.UsageError, match="no display"):
        pano_mvs.view_run(out)


def test_what_is_missing_is_said(tmp_path: Path) -> None:
    bare = write_output(tmp_path, turned_poses(2), points=0)
    outcome = view(bare, "--screenshot", tmp_path / "a.png", "--size", "100x80", "--view", "top")
    assert outcome.code == 0
    assert "note: no cloud.ply" in outcome.flat


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "no display"),
        (("--screenshot", "a.bmp"), "images must end in .png"),
        (("--screenshot", "a.png", "--size", "big"), "give the width and the height"),
        (("--screenshot", "a.png", "--view", "inside:roof"), "no camera 'roof'; there are: lobby/000.png"),
        (("--screenshot", "a.png", "--view", "below"), "there are overview, top, front and inside:NAME"),
        (("--screenshot", "a.png", "--color", "views"), "quality: true"),
        (("--screenshot", "a.png", "--show", "both"), "there is no mesh.ply"),
        (("--screenshot", "a.png", "--show", "all"), "must be cloud, mesh or both"),
    ],
)
def test_mistakes_are_told_with_a_remedy(out: Path, arguments: tuple[str, ...], message: str) -> None:
    outcome = view(out, *arguments, DISPLAY="")
    assert outcome.code == 2
    assert message in outcome.flat
    assert "Traceback" not in outcome.text


def test_a_place_that_cannot_be_written_is_told(out: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    outcome = view(out, "--screenshot", tmp_path / "file" / "a.png", "--size", "64x64")
    assert outcome.code == 4
    assert "cannot be written" in outcome.flat


def test_a_folder_without_results_is_told(tmp_path: Path) -> None:
    outcome = view(tmp_path, "--screenshot", tmp_path / "a.png")
    assert outcome.code == 2
    assert "Give the output folder of a run" in outcome.flat
