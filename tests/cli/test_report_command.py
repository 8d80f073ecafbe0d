"""The commands that show a finished run: report, tour and view."""

from __future__ import annotations

import json
import shutil
import webbrowser
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import pano_mvs
from pano_mvs.cli.app import app
from pano_mvs.cli.page_commands import open_in_browser
from pano_mvs.engine.running.publish import Publisher
from pano_mvs.geometry import ray_from_pixel
from pano_mvs.results.summary import RunSummary
from pano_mvs.scene.image_file import decode_image
from pano_mvs.session.session import Session
from pano_mvs.testing.room import capture_poses, default_room
from tests.cli.conftest import SMALL, Command, Outcome, run_json
from tests.engine.conftest import Toy
from tests.report.html_page import Page
from tests.report.test_report import assert_sound
from tests.synthetic.capture_files import write_capture
from tests.viewer.scenes import turned_poses, world_color, write_output


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
        f"scores.truth={truth}",
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
    assert "Comparison with ground truth" in first.words
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


@pytest.fixture(autouse=True)
def opened(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The addresses that were opened, on a machine with a screen."""
    addresses: list[str] = []

    def open_address(address: str) -> bool:
        addresses.append(address)
        return True

    monkeypatch.setattr(webbrowser, "open", open_address)
    monkeypatch.setenv("DISPLAY", ":0")
    return addresses


@pytest.mark.slow
def test_from_a_folder_to_the_page(pano_mvs: Command, capture: Path, opened: list[str]) -> None:
    options = ("--workflow", "fast", *SMALL)
    first = pano_mvs("tour", capture / "images", *options)
    assert first.code == RunSummary.read(Path("out/images")).exit_code
    page = Path("out/images_page/index.html")
    assert "4 panoramas" in first.flat
    assert opened == [page.resolve().as_uri()]
    assert first.text.rstrip().endswith("next:\n  pano-mvs view out/images")
    page.unlink()
    again = pano_mvs("tour", capture / "images", *options, "--no-open")
    assert "nothing to compute" in again.flat
    assert again.code == first.code
    assert page.exists()
    assert len(opened) == 1
    assert f"open {page} in a browser" not in again.flat


@pytest.mark.parametrize(("name", "workflow"), [("rooms", "mesh"), ("walk.mp4", "walk")])
def test_the_preset_is_chosen_by_what_is_given(
    pano_mvs: Command, monkeypatch: pytest.MonkeyPatch, name: str, workflow: str
) -> None:
    Path("rooms").mkdir()
    Path("walk.mp4").touch()
    sessions: list[Session] = []

    def stop(session: Session, *_: object, **__: object) -> int:
        sessions.append(session)
        return 4

    monkeypatch.setattr("pano_mvs.cli.page_commands.run_decided", stop)
    result = pano_mvs("tour", name, "--cache", "kept")
    (session,) = sessions
    assert (result.code, session.workflow.name, session.store_root) == (4, workflow, Path("kept"))
    assert session.out == Path("out") / Path(name).stem
    assert "give the same command again" in result.flat


def test_a_run_with_nothing_to_show_has_no_page(pano_mvs: Command, toy: Toy, opened: list[str]) -> None:
    shutil.copytree(toy.folder / "capture", "numbers")
    arguments = ("tour", "numbers", "--workflow", toy.folder / "wf.yaml", "--out", "sums", "--cache", "kept")
    result = pano_mvs(*arguments)
    assert result.code == 0
    assert "no page is written" in result.flat
    Path("numbers/b.txt").write_text("13")
    assert pano_mvs(*arguments).code == 3
    assert opened == []
    assert not Path("sums_page").exists()


def test_a_folder_in_the_place_of_the_page_is_noticed_before_the_run(pano_mvs: Command, toy: Toy) -> None:
    Path("work_page").mkdir()
    Path("work_page/notes.txt").touch()
    Path("numbers").mkdir()
    result = pano_mvs("tour", "numbers", "--workflow", toy.folder / "wf.yaml", "--out", "work")
    assert result.code == 2
    assert "the page would be written to work_page: the folder is not empty" in result.flat
    assert not Path("work").exists()


@pytest.mark.parametrize(("name", "what"), [("nowhere", "no such folder or video"), ("", "the name is empty")])
def test_what_is_no_folder(pano_mvs: Command, name: str, what: str) -> None:
    result = pano_mvs("tour", name)
    assert result.code == 2
    assert what in result.flat


def test_no_browser_is_started_in_a_terminal_without_a_screen(tmp_path: Path, opened: list[str]) -> None:
    page = tmp_path / "my page" / "index.html"
    assert not open_in_browser(page, environment={}, platform="linux")
    assert opened == []
    assert open_in_browser(page, environment={"WAYLAND_DISPLAY": "wayland-0"}, platform="linux")
    assert open_in_browser(page, environment={}, platform="darwin")
    assert opened == [page.as_uri()] * 2


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
