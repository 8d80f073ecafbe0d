"""Videos as the input of runs."""

from __future__ import annotations

from pathlib import Path

from tests.cli.conftest import Command, run_json
from tests.synthetic.video_files import write_video

FILM = """
pano_mvs: 1
stages:
  images:   {use: source.video, path: walk.avi, every_s: 0.5}
  features: {use: features.orb_tangent, max_keypoints: 200}
  pairs:    {use: pairs.sequential, window: 1}
"""


def test_a_video_is_read_once_and_only_what_is_new_again(pano_mvs: Command, tmp_path: Path) -> None:
    write_video(tmp_path / "walk.avi", 60)
    (tmp_path / "film.yaml").write_text(FILM)
    run = ("run", tmp_path / "film.yaml", "--out", "out", "--cache", "cache")
    first = pano_mvs(*run)
    assert first.code == 0, first.text
    stages = {stage["name"]: stage for stage in run_json(Path("out"))["stages"]}
    assert (stages["images"]["run"], stages["features"]["run"]) == (6, 6)
    assert "0 units computed" in pano_mvs(*run).text
    explained = pano_mvs("plan", *run[1:2], "--cache", "cache", "--explain", "images:walk_00001000ms.png")
    assert "figure   time_s: 1" in explained.text

    shorter = pano_mvs(*run, "--set", "images.end_s=1.2")
    assert shorter.code == 0
    stages = {stage["name"]: stage for stage in run_json(Path("out"))["stages"]}
    assert (stages["images"]["run"], stages["images"]["cached"], stages["features"]["run"]) == (0, 3, 0)

    next(Path("cache/blobs").rglob("*.png")).write_bytes(b"damaged")
    again = pano_mvs(*run)
    assert again.code == 0, again.text
    plan = pano_mvs("plan", *run[1:2], "--cache", "cache", "--set", "images.every_s=0.25")
    assert "12" in plan.text.splitlines()[3]


def test_a_folder_of_videos_is_read_by_the_source_that_the_message_names(pano_mvs: Command, tmp_path: Path) -> None:
    (tmp_path / "films").mkdir()
    write_video(tmp_path / "films" / "walk.avi", 60)
    settings = ("--set", "images.use=source.video", "--set", "pairs.use=pairs.sequential", "--until", "pairs")
    result = pano_mvs("run", "quickstart", "--images", tmp_path / "films", *settings, "--out", "out")
    assert result.code == 0, result.text


def test_a_single_video_is_read_by_the_preset_for_walks(pano_mvs: Command, tmp_path: Path) -> None:
    write_video(tmp_path / "walk.avi", 60)
    result = pano_mvs("run", "quickstart", "--images", tmp_path / "walk.avi")
    assert result.code == 2
    assert "this is a video. Use the preset walk, or --set images.use=source.video" in result.flat
    settings = ("--set", "images.keyframes=time", "--until", "images", "--out", "out")
    result = pano_mvs("run", "walk", "--images", tmp_path / "walk.avi", *settings)
    assert result.code == 0, result.text
