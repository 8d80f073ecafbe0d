"""Workflows with mistakes: all are reported, with their places."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.cli.conftest import Command

PLANTED = "import pathlib\npathlib.Path(__file__).with_suffix('.ran').touch()\n"
HEAD = "pano_mvs: 1\nstages:\n"


@pytest.mark.parametrize("command", ["check", "plan", "run", "status", "schema"])
def test_every_command_refuses_in_the_same_way(pano_mvs: Command, command: str) -> None:
    Path("bad.yaml").write_text(
        HEAD + "  images: {use: source.folder, path: !!python/object/apply:os.system [touch x]}\n"
    )
    result = pano_mvs(command, "bad.yaml")
    assert result.code == 2, result.text
    assert "bad.yaml:3:38: tag" in result.flat
    assert "Traceback" not in result.text
    assert [path.name for path in Path.cwd().iterdir()] == ["bad.yaml"], "no cache, no output, nothing else"


def test_a_folder_of_ones_name_does_not_hide_a_preset(pano_mvs: Command) -> None:
    Path("quickstart").mkdir()
    assert pano_mvs("check", "quickstart").code == 0


@pytest.mark.slow
def test_nothing_is_imported_from_the_current_folder_but_what_is_named(tmp_path: Path) -> None:
    """Modules that anything of ours might look for lie among somebody's pictures, and beside the workflow."""
    names = ("numpy", "numba", "json", "pickle", "random", "helper", "sitecustomize", "conftest", "jinja2")
    for name in (*names, "plug"):
        (tmp_path / f"{name}.py").write_text(PLANTED)
    (tmp_path / "wf.yaml").write_text("pano_mvs: 1\nplugins: [plug.py]\nextends: quickstart\n")
    result = subprocess.run(
        [sys.executable, "-m", "pano_mvs", "check", "wf.yaml"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 2
    assert "plug.py defines no stage" in " ".join(result.stderr.split())
    assert [path.name for path in tmp_path.glob("*.ran")] == ["plug.ran"]


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
