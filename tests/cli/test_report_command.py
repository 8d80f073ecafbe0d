"""The command that shows a finished run again: report."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from pano_mvs.engine.running.publish import Publisher
from pano_mvs.testing.room import capture_poses, default_room
from tests.cli.conftest import Command, run_json
from tests.engine.conftest import Toy
from tests.report.html_page import Page
from tests.report.test_report import assert_sound
from tests.synthetic.capture_files import write_capture


def page_in(out: Path) -> Page:
    page = Page((out / "report.html").read_text(encoding="utf-8"))
    assert_sound(page)
    return page


def pictures(page: Page) -> dict[str | None, str | None]:
    return {attrs["alt"]: attrs["src"] for attrs in page.all("img") if attrs["alt"]}


@pytest.mark.slow
def test_a_run_its_repetition_and_the_command_show_the_same(pano_mvs: Command, tmp_path: Path) -> None:
    write_capture(tmp_path / "capture", default_room(), capture_poses(3, spread=0.4), size_hw=(96, 192))
    truth = tmp_path / "capture" / "truth"
    command = (
        "known_poses",
        "--images",
        tmp_path / "capture" / "images",
        "--out",
        "out",
        "--cache",
        "cache",
        "--set",
        f"poses.path={truth / 'poses.json'}",
        "--set",
        "depth.planes=16",
        "--set",
        "features.max_keypoints=400",
    )
    assert pano_mvs("run", *command).code == 0
    out = Path("out")
    first = page_in(out)
    for name in ("000.png", "001.png", "002.png"):
        words = [str(alt).partition(": ")[2] for alt in pictures(first) if str(alt).startswith(f"{name}:")]
        assert len([word for word in words if "its own scale" not in word]) == 4
    others = [str(alt) for alt in pictures(first) if not str(alt).startswith("00")]
    assert len(others) == 3, "of the cloud from three places"
    assert first.all("div", id="viewer")
    assert "metres, as the file has it" in first.words
    summary = run_json(out)
    assert set(summary["results"]) == {"images", "pairs", "poses", "ranges", "cloud", "static"}
    assert summary["machine"]["cores"] >= 1
    assert all(len(link) == 5 for link in summary["poses"]["links"])

    (out / "report.html").unlink()
    assert pano_mvs("report", "out").code == 0
    assert (out / "report.html").read_text() == first.source

    assert pano_mvs("run", *command).code == 0
    again = page_in(out)
    assert "Nothing has changed" in again.words
    assert pictures(again) == pictures(first)

    shutil.rmtree("cache")
    result = pano_mvs("report", "out")
    assert result.code == 2
    assert "there is no cache" in result.flat
    assert page_in(out).source == again.source, "the page with pictures stays"


@pytest.mark.parametrize("text", [None, "no json", "[]", '{"stages": 1}'])
def test_a_folder_without_a_run_is_refused(pano_mvs: Command, text: str | None) -> None:
    Path("out").mkdir()
    if text is not None:
        Path("out/run.json").write_text(text)
    result = pano_mvs("report", "out")
    assert result.code == 2
    assert "run.json" in result.flat


def run(pano_mvs: Command, toy: Toy, *options: str) -> int:
    folder = toy.folder
    return pano_mvs("run", folder / "wf.yaml", "--cache", folder / "cache", "--out", folder / "out", *options).code


def test_an_interrupted_run_has_a_report(pano_mvs: Command, toy: Toy) -> None:
    toy.edit("plug.py", lambda text: text.replace('"""Mean of the', 'raise KeyboardInterrupt\n    """Mean of the'))
    assert run(pano_mvs, toy) == 130
    summary = run_json(toy.folder / "out")
    assert (summary["exit_code"], summary["stopped"]) == (130, "interrupted")
    page = page_in(toy.folder / "out")
    assert "Interrupted" in page.words
    assert "Run the same command again to continue" in page.words


def test_a_run_that_a_gate_stops_says_why_at_once(pano_mvs: Command, toy: Toy) -> None:
    toy.edit("wf.yaml", lambda text: text.replace("use: toy.scale", "use: toy.scale, gate: {value: 1000}"))
    assert run(pano_mvs, toy) == 4
    page = page_in(toy.folder / "out")
    assert "Stopped by a quality threshold" in page.words
    assert page.words.index("requires") < page.words.index("Stages")


def test_a_run_that_breaks_has_a_report_and_keeps_its_error(
    pano_mvs: Command,
    toy: Toy,  # the fixture above
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def broken(*_args: object, **_options: object) -> None:
        raise OSError("the disk has gone")

    monkeypatch.setattr(Publisher, "publish", broken)
    assert run(pano_mvs, toy) == 1
    assert run_json(toy.folder / "out")["exit_code"] == 1
    page = page_in(toy.folder / "out")
    assert "Stopped by an internal error" in page.words
    assert "the disk has gone" in page.words


def test_a_run_that_does_nothing_leaves_the_report_before(pano_mvs: Command, toy: Toy) -> None:
    assert run(pano_mvs, toy) == 0
    before = (toy.folder / "out" / "report.html").read_bytes()
    toy.edit(
        "plug.py", lambda text: text.replace("for path in sorted", "raise ValueError('no')\n    for path in sorted")
    )
    assert run(pano_mvs, toy) not in (0, 3)
    assert (toy.folder / "out" / "report.html").read_bytes() == before
    assert json.loads((toy.folder / "out" / "run.json").read_text())["exit_code"] == 0


@pytest.mark.slow
def test_what_an_interrupted_run_had_made_is_shown(
    pano_mvs: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The filter behind was interrupted before its first view: the views are those of the stage before it."""

    def interrupted(*_args: object, **_options: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("pano_mvs.stages.filters.fast_bilateral_solver", interrupted)
    write_capture(tmp_path / "capture", default_room(), capture_poses(2, spread=0.4), size_hw=(32, 64))
    truth = tmp_path / "capture" / "truth"
    result = pano_mvs(
        *f"run known_poses --images {tmp_path / 'capture' / 'images'} --out out --cache c".split(),
        *f"--set poses.path={truth / 'poses.json'} --set scores.truth={truth} --set depth.planes=8".split(),
        *["--set", "features.max_keypoints=200"],
    )
    assert result.code == 130
    summary = run_json(Path("out"))
    assert summary["results"]["ranges"] == "sky"
    assert [view["name"] for view in summary["views"]] == ["000.png", "001.png"]
    page = page_in(Path("out"))
    assert "The run was interrupted" in page.words
    assert sum(": the panorama" in str(alt) for alt in pictures(page)) == 2
