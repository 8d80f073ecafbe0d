"""`pano-mvs tour`: from a folder to the page."""

from __future__ import annotations

import json
import shutil
import webbrowser
from pathlib import Path

import pytest
from pano_mvs_page.sharing import open_in_browser

from pano_mvs.io.house_file import read_house
from pano_mvs.results.summary import RunSummary
from pano_mvs.scene.image_file import write_png
from pano_mvs.session.session import Session
from tests.cli.conftest import SMALL, Command
from tests.engine.conftest import Toy
from tests.synthetic.drawn_rooms import box


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


WORKFLOW = """\
pano_mvs: 1
name: rooms
stages:
  images: {use: source.folder, path: tour}
  features: {use: features.sift_tangent, max_keypoints: 300}
  pairs: {use: pairs.exhaustive}
  matches: {use: matches.brute_force}
  poses: {use: poses.scaled_translation}
  verified: {use: poses.verify}
  room_lines: {use: features.room_lines, only_linked: true}
  ceilings: {use: features.ceilings}
  rooms: {use: features.rooms}
  house: {use: house.links}
  house_file: {use: export.house}
  views: {use: views.nearest}
"""


@pytest.mark.slow
def test_a_tour_whose_rooms_matches_do_not_join_has_a_page(pano_mvs: Command, opened: list[str]) -> None:
    """One panorama a room: links say where the rooms are, and each picture outlines its own."""
    Path("tour").mkdir()
    scenes = {}
    for number, (other, yaw_deg) in enumerate(((1, 40.0), (0, -75.0))):
        write_png(Path(f"tour/{number}.png"), box(25.0 + 20 * number, walls=(1.4, 2.2, 1.9 + number, 1.1)))
        link = {"type": "scene", "sceneId": f"s{other}", "yaw": yaw_deg, "pitch": -15.0}
        scenes[f"s{number}"] = {
            "title": f"Room {number}", "type": "equirectangular", "panorama": f"{number}.png", "hotSpots": [link],
        }  # fmt: skip
    Path("tour/tour.json").write_text(json.dumps({"scenes": scenes}))
    Path("rooms.yaml").write_text(WORKFLOW)
    result = pano_mvs("tour", "tour", "--workflow", "rooms.yaml")
    assert result.code == 4
    assert "no two panoramas could be registered" in result.flat
    assert "2 rooms without ranges are drawn as the picture outlines them" in result.flat
    assert "2 panoramas" in result.flat
    assert len(opened) == 1
    house = read_house(Path("out/tour/house.json"))
    assert house.placed_by == ("links", "links")
    assert [round(room.ceiling or 0.0, 1) for room in house.rooms.values()] == [0.7, 0.7]


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

    monkeypatch.setattr("pano_mvs_page.sharing.run_capture", stop)
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
