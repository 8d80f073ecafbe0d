"""`check` reports all mistakes of a workflow at once, whatever the first one is."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.cli.conftest import Command

GOOD = "pano_mvs: 1\nstages:\n  images: {use: source.folder, path: photos}\n"
WRONG = "  keys: {use: features.sift_tangent, max_keypoint: 3}\n"
KEY = "unknown setting 'max_keypoint'"
PORT = "has no port 'imag'"

CASES = {
    "a stage that does not exist, and a port": (
        GOOD + "  a: {use: features.nothing}\n  keys: {use: features.sphorb, in: {imag: images}}\n",
        ["there is no stage 'features.nothing'", PORT],
    ),
    "a stage that does not exist, and a stage in in": (
        GOOD + "  a: {use: features.nothing}\n  keys: {use: features.sphorb, in: {image: imagse}}\n",
        ["there is no stage 'features.nothing'", "there is no stage 'imagse'"],
    ),
    "a key twice, and a setting": (
        GOOD.replace("path: photos", "path: photos, path: b") + WRONG,
        ["occurs twice", KEY],
    ),
    "a file below that is not YAML, and a setting": ("extends: broken.yaml\n" + GOOD + WRONG, ["broken.yaml:2", KEY]),
    "a stage without use, and a port": (
        GOOD + "  a: {}\n  keys: {use: features.sphorb, in: {imag: images}}\n",
        ["stage 'a' needs `use: NAME`", PORT],
    ),
    "a plugin that does not exist, and a setting": ("plugins: [none.py]\n" + GOOD + WRONG, ["none.py", KEY]),
    "a setting, and a file that does not exist": (
        GOOD + "  poses: {use: poses.from_model, path: none.json, pth: a}\n",
        ["unknown setting 'pth'", "none.json does not exist"],
    ),
    "two axes, and a port": (
        GOOD + "  a: {use: features.sphorb}\n  b: {use: features.sphorb, in: {imag: images}}\n"
        "  ply: {use: export.ply}\n",
        [PORT, "stage 'ply' needs cloud"],
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_check_reports_every_mistake(pano_mvs: Command, tmp_path: Path, name: str) -> None:
    text, expected = CASES[name]
    (tmp_path / "photos").mkdir()
    (tmp_path / "broken.yaml").write_text("stages: [\n")
    (tmp_path / "wf.yaml").write_text(text)
    result = pano_mvs("check", tmp_path / "wf.yaml")
    assert result.code == 2
    for what in expected:
        assert what in result.flat
    # What nothing is known of is not guessed about: a line for each mistake, no more.
    assert len(re.findall(r"\.yaml:\d+:\d+: ", result.flat)) == len(expected), result.text


def test_mistakes_of_the_file_are_reported_beside_those_of_the_options(pano_mvs: Command, tmp_path: Path) -> None:
    (tmp_path / "wf.yaml").write_text(GOOD + WRONG)
    result = pano_mvs("check", tmp_path / "wf.yaml", "--images", tmp_path / "none", "--set", "a.b=1")
    assert result.code == 2
    for what in ("--images", "--set a.b=1", KEY):
        assert what in result.flat


@pytest.mark.parametrize("command", ["check", "plan", "run"])
def test_an_empty_name_of_the_images_is_refused(pano_mvs: Command, tmp_path: Path, command: str) -> None:
    """An empty variable of the shell named the current folder."""
    (tmp_path / "wf.yaml").write_text(GOOD)
    result = pano_mvs(command, tmp_path / "wf.yaml", "--images", "")
    assert result.code == 2
    assert "the name is empty" in result.flat
