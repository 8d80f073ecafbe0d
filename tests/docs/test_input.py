"""What docs/input.md and docs/installation.md show works as it stands."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from pano_mvs.io.images.captures import PICTURE_SUFFIXES, VIDEO_SUFFIXES
from pano_mvs.stages.source_video import VideoParams
from tests.cli.conftest import Command, pano_mvs, run_json
from tests.io.images.videos import write_video

__all__ = ["pano_mvs"]  # the fixture

DOCS = Path(__file__).parents[2] / "docs"
INPUT = (DOCS / "input.md").read_text(encoding="utf-8")
INSTALLATION = (DOCS / "installation.md").read_text(encoding="utf-8")


def test_the_workflow_for_a_video_runs(pano_mvs: Command) -> None:
    found = re.search(r"<!-- workflow -->\n```yaml\n(.*?)```", INPUT, re.DOTALL)
    assert found
    Path("mine.yaml").write_text(found[1].replace("walk.mp4", "walk.avi"))
    write_video(Path("walk.avi"), 60)
    result = pano_mvs("run", "mine.yaml", "--until", "pairs", "--out", "out")
    assert result.code == 0, result.text
    assert run_json(Path("out"))["stages"][0]["run"] == 3


@pytest.mark.parametrize(("preset", "last"), [("quickstart", "pairs"), ("walk", "masked")])
def test_the_commands_for_a_folder_of_videos_run(preset: str, last: str, pano_mvs: Command) -> None:
    (line,) = [line for line in INPUT.splitlines() if line.startswith(f"pano-mvs run {preset}")]
    Path("videos").mkdir()
    write_video(Path("videos/walk.avi"), 60)
    result = pano_mvs(*line.split()[1:], "--set", "images.max_s=1", "--until", last, "--out", "out")
    assert result.code == 0, result.text


def test_all_settings_and_kinds_are_told() -> None:
    assert all(f"`{name}`" in INPUT for name in VideoParams.model_fields)
    assert all(f"`{suffix.lstrip('.')}`" in INPUT for suffix in VIDEO_SUFFIXES)
    told = INPUT.lower()
    assert all(suffix.lstrip(".").replace("jpg", "jpeg").replace("heif", "heic") in told for suffix in PICTURE_SUFFIXES)


def test_all_extras_are_told() -> None:
    project = (DOCS.parent / "pyproject.toml").read_text(encoding="utf-8")
    section = project.partition("[project.optional-dependencies]")[2].partition("\n[")[0]
    extras = re.findall(r"^(\w+) = \[", section, re.MULTILINE)
    assert len(extras) >= 4
    assert all(f"'pano-mvs[{extra}]'" in INSTALLATION for extra in extras)
