"""Names, links and pictures of a tour's scenes come from its configuration, which is not trusted."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from pano_mvs_tours.source import TourParams, list_tour
from pano_mvs_tours.tour_folders import TourScene, is_tour, list_scenes
from pano_mvs_tours.tour_players import Link, Scene, krpano_tour, marzipano_data, pannellum_tour

from pano_mvs.core.errors import InputError
from pano_mvs.core.file_names import item_problem, plain_title
from pano_mvs.scene import SceneLink
from tests.synthetic.tour_files import (
    CONFIGURATIONS,
    PITCH_DEG,
    SIDE,
    YAW_DEG,
    face_of,
    write,
    write_configuration,
    write_tour,
)

KEYS = ("a", "b", "c")


def scenes_of(folder: Path) -> list[TourScene]:
    return list_scenes(folder, [])


def targets(scene: TourScene) -> tuple[str, ...]:
    return tuple(link.name for link in scene.links)


@pytest.mark.parametrize("program", CONFIGURATIONS)
def test_titles_order_and_links_come_from_the_configuration(tmp_path: Path, program: str) -> None:
    write_tour(tmp_path, program, KEYS)
    write_configuration(tmp_path, program, {"c": "Kitchen", "a": "Hall: 1/2", "b": ""}, links={"c": ["a", "b", "gone"]})
    scenes = scenes_of(tmp_path)
    assert [scene.name for scene in scenes] == ["Kitchen", "Hall 1 2", "b"]
    assert [targets(scene) for scene in scenes] == [("Hall 1 2", "b"), (), ()]
    assert [link.direction_deg for link in scenes[0].links] == [pytest.approx((YAW_DEG, PITCH_DEG))] * 2
    assert all(len(scene.tiles) == 24 for scene in scenes)
    assert is_tour(tmp_path)
    items = list(list_tour(TourParams.model_validate({"path": tmp_path})))
    assert items[0].name == "Kitchen.png"
    assert [link.name for link in items[0].links] == ["Hall 1 2.png", "b.png"]
    assert "2 links between them" in items[0].notes[-1]


@pytest.mark.parametrize("program", CONFIGURATIONS)
def test_scenes_without_pictures_are_named(tmp_path: Path, program: str) -> None:
    write_tour(tmp_path, program, KEYS[:2])
    write_configuration(tmp_path, program, {"a": "Hall", "b": "Kitchen", "c": "Cellar"}, links={"a": ["c"]})
    notes: list[str] = []
    assert [(scene.name, targets(scene)) for scene in list_scenes(tmp_path, notes)] == [("Hall", ()), ("Kitchen", ())]
    assert notes == ["1 scenes have no complete cube here and are skipped: Cellar"]


@pytest.mark.parametrize(
    ("spot", "direction_deg"),
    [
        ({"yaw": 190, "pitch": 10}, (-170.0, 10.0)),
        ({"yaw": "-30", "pitch": "0"}, (-30.0, 0.0)),
        ({"yaw": 20}, None),
        ({"yaw": "left", "pitch": 0}, None),
        ({"yaw": float("nan"), "pitch": 0}, None),
        ({"yaw": 0, "pitch": 91}, None),
    ],
)
def test_a_link_has_the_stated_direction_or_none(
    tmp_path: Path, spot: dict[str, object], direction_deg: tuple[float, float] | None
) -> None:
    write_tour(tmp_path, "Pannellum", KEYS[:2])
    write_configuration(tmp_path, "Pannellum", {"a": "Hall", "b": "Kitchen"}, {"b": ["a"]})
    stated = json.loads((tmp_path / "tour.json").read_text())
    stated["scenes"]["b"]["hotSpots"] = [{"sceneId": "a"}, {"sceneId": "a", **spot}]
    (tmp_path / "tour.json").write_text(json.dumps(stated))
    assert scenes_of(tmp_path)[1].links == (SceneLink("Hall", direction_deg),)


def test_scenes_with_one_title_are_told_apart(tmp_path: Path) -> None:
    write_tour(tmp_path, "Pannellum", KEYS)
    write_configuration(tmp_path, "Pannellum", {"a": "Hall", "b": "hall", "c": "CON"}, links={})
    assert [scene.name for scene in scenes_of(tmp_path)] == ["Hall (a)", "hall (b)", "scene"]


def test_cubes_that_no_configuration_names_are_used(tmp_path: Path) -> None:
    write_tour(tmp_path, "Pannellum", KEYS)
    write_configuration(tmp_path, "Pannellum", {"b": "Hall"}, links={})
    notes: list[str] = []
    assert [scene.name for scene in list_scenes(tmp_path, notes)] == ["Hall", "a", "c"]
    assert "2 cubes that no configuration names are used, too" in notes[0]


def test_two_tours_in_one_folder_keep_their_own_links(tmp_path: Path) -> None:
    for floor in ("1", "2"):
        write_tour(tmp_path / floor, "Marzipano", ("a", "b"))
        write_configuration(tmp_path / floor, "Marzipano", {"a": f"Hall {floor}", "b": f"Room {floor}"}, {"a": ["b"]})
    links = {scene.name: targets(scene) for scene in scenes_of(tmp_path)}
    assert links == {"Hall 1": ("Room 1",), "Room 1": (), "Hall 2": ("Room 2",), "Room 2": ()}


def test_a_backup_of_the_configuration_adds_nothing(tmp_path: Path) -> None:
    write_tour(tmp_path, "krpano", KEYS[:2])
    write_configuration(tmp_path, "krpano", {"a": "Hall", "b": "Kitchen"}, links={})
    (tmp_path / "tour.xml - backup.xml").write_text((tmp_path / "tour.xml").read_text().replace("Hall", "Old"))
    assert [scene.name for scene in scenes_of(tmp_path)] == ["Hall", "Kitchen"]


def test_a_formatted_script_is_read(tmp_path: Path) -> None:
    """Programs that format code drop the quotes around keys and add commas."""
    write_tour(tmp_path, "Marzipano", KEYS[:2])
    (tmp_path / "app-files/data.js").write_text(
        "// tour\nvar APP_DATA = {\n  scenes: [\n    { id: 'a', name: 'The \"old\" hall', /* was: {x */ levels: "
        "[{ tileSize: 256, size: 256, fallbackOnly: true }, { tileSize: 32, size: 32 }, { tileSize: 32, size: 64 },],\n"
        "linkHotspots: [{ target: 'b', yaw: -1.5e-1, icon: picture },] },\n"
        "{ id: 'b', name: 'It\\'s: {here', levels: [], },\n],\n};\nvar more = {};\n"
    )
    assert [(scene.name, targets(scene)) for scene in scenes_of(tmp_path)] == [
        ("The old hall", ("It's {here",)),
        ("It's {here", ()),
    ]


def test_a_tour_in_a_page_is_read(tmp_path: Path) -> None:
    write_tour(tmp_path, "Pannellum", KEYS[:2])
    write_configuration(tmp_path, "Pannellum", {"a": "Hall", "b": "Kitchen"}, {"b": ["a"]})
    stated = (tmp_path / "tour.json").read_text()
    (tmp_path / "tour.json").unlink()
    (tmp_path / "index.html").write_text(f"<script>viewer = pannellum.viewer('panorama', {stated});</script>")
    assert [(scene.name, targets(scene)) for scene in scenes_of(tmp_path)] == [("Hall", ()), ("Kitchen", ("Hall",))]


def test_the_finest_resolution_is_used_even_if_a_coarser_one_is_stated(tmp_path: Path) -> None:
    """Found in a tour whose tiles had been made again, but whose configuration had not."""
    write_tour(tmp_path, "Pannellum", KEYS[:2])
    for key in KEYS[:2]:
        for face in "frblud":
            write(tmp_path / f"tour/{key}/1/{face}0_0.png", face_of(face)[::2, ::2])
    write_configuration(tmp_path, "Pannellum", {"a": "Hall", "b": "Kitchen"}, {})
    stated = json.loads((tmp_path / "tour.json").read_text())
    for scene in stated["scenes"].values():
        scene["multiRes"] |= {"maxLevel": 1, "cubeResolution": SIDE // 2}
    (tmp_path / "tour.json").write_text(json.dumps(stated))
    assert [(scene.name, len(scene.tiles)) for scene in scenes_of(tmp_path)] == [("Hall", 24), ("Kitchen", 24)]


def test_cubes_of_six_files_are_read_by_their_places_in_the_configuration(tmp_path: Path) -> None:
    for key in ("a", "b"):
        for number, face in enumerate("frblud"):
            write(tmp_path / f"img/{key}{number}.png", face_of(face))
            write(tmp_path / f"panos/{key}/pano_{face}.png", face_of(face))
    cubes = {key: {"type": "cubemap", "cubeMap": [f"../img/{key}{number}.png" for number in range(6)]} for key in "ab"}
    (tmp_path / "js").mkdir()
    (tmp_path / "js/tour.json").write_text(json.dumps({"scenes": cubes}))
    (tmp_path / "tour.xml").write_text(
        '<krpano><scene name="X"><image><cube url="%SWFPATH%/panos/a/pano_%s.png"/></image></scene>'
        '<scene name="y" title="Y"><image><left url="panos/b/pano_l.png"/><front url="panos/b/pano_f.png"/>'
        '<right url="panos/b/pano_r.png"/><back url="panos/b/pano_b.png"/><up url="panos/b/pano_u.png"/>'
        '<down url="panos/b/pano_d.png"/></image><hotspot linkedscene="x"/></scene></krpano>'
    )
    scenes = {scene.name: scene for scene in scenes_of(tmp_path)}
    assert set(scenes) == {"X", "Y", "a", "b"}
    assert targets(scenes["Y"]) == ("X",)
    assert {face: path.name for (face, _, _), path in scenes["a"].tiles.items()} == {
        face: f"a{number}.png" for number, face in enumerate("frblud")
    }
    assert is_tour(tmp_path)


def test_older_krpano_levels_are_read(tmp_path: Path) -> None:
    write_tour(tmp_path, "krpano", ("a", "b"))
    url = "panos/{}.tiles/%s/l2/%0v/l2_%s_%0v_%0h.png"
    scenes = "".join(
        f'<scene name="{key}" title="{key * 3}"><image type="CUBE" multires="true" tilesize="{SIDE // 2}">'
        f'<level tiledimagewidth="{SIDE}" tiledimageheight="{SIDE}"><cube url="{url.format(key)}"/></level>'
        f'<level tiledimagewidth="{SIDE // 2}"><cube url="panos/gone/%s.png"/></level></image></scene>'
        for key in "ab"
    )
    (tmp_path / "tour.xml").write_text(f"<krpano>{scenes}</krpano>")
    assert [(scene.name, len(scene.tiles)) for scene in scenes_of(tmp_path)] == [("aaa", 24), ("bbb", 24)]


def renamed(folder: Path, program: str, change: Callable[[str], str]) -> None:
    path = folder / CONFIGURATIONS[program]
    text = path.read_text()
    assert change(text) != text
    path.write_text(change(text))


@pytest.mark.parametrize(
    ("program", "change"),
    [
        ("Pannellum", lambda text: text.replace('"./tour"', '"https://example.com/houses/12/tour"')),
        ("Pannellum", lambda text: text.replace('"./tour"', '"/var/www/houses/12"')),
        ("Pannellum", lambda text: text.replace('"maxLevel": 2', '"maxLevel": "?"')),
        ("Marzipano", lambda text: text.replace('{"tileSize": 256, "size": 256, "fallbackOnly": true},', "")),
        (
            "Marzipano",
            lambda text: text.replace(f'"size": {SIDE}}}', '"size": 256}').replace('"size": 32', '"size": 96'),
        ),
        ("krpano", lambda text: text.replace("panos/", "https://example.com/house/panos/")),
    ],
)
def test_titles_and_links_survive_other_paths_and_levels(
    tmp_path: Path, program: str, change: Callable[[str], str]
) -> None:
    """The pictures were found by their paths, but titles and links were lost without a word."""
    write_tour(tmp_path, program, KEYS)
    write_configuration(tmp_path, program, {"c": "Kitchen", "a": "Hall", "b": "Attic"}, links={"c": ["a", "b"]})
    if program == "Marzipano":
        indented = tmp_path / CONFIGURATIONS[program]
        data = json.loads(indented.read_text().removeprefix("var APP_DATA = ").rstrip(";\n"))
        indented.write_text(f"var APP_DATA = {json.dumps(data)};")
    renamed(tmp_path, program, change)
    notes: list[str] = []
    scenes = list_scenes(tmp_path, notes)
    assert [(scene.name, targets(scene), len(scene.tiles)) for scene in scenes] == [
        ("Kitchen", ("Hall", "Attic"), 24),
        ("Hall", (), 24),
        ("Attic", (), 24),
    ]
    assert len(notes) == 1
    assert "found by the names of their folders" in notes[0]


def test_panoramas_and_six_files_are_found_by_their_names(tmp_path: Path) -> None:
    for key in "ab":
        write(tmp_path / f"{key}.jpg", np.tile(face_of("f"), (1, 2, 1)))
        for face in "frblud":
            write(tmp_path / f"cubes/{key}/{face}.png", face_of(face))
    base = "https://example.com/tour/"
    stated: dict[str, dict[str, object]] = {key: {"panorama": f"{base}{key}.jpg", "title": key * 3} for key in "ab"}
    for key in "ab":
        files = [f"{base}{key}/{face}.png" for face in "frblud"]
        stated[f"cube {key}"] = {"type": "cubemap", "cubeMap": files, "hotSpots": [{"sceneId": "a"}]}
    (tmp_path / "tour.json").write_text(json.dumps({"scenes": stated}))
    assert [(scene.name, targets(scene), len(scene.tiles)) for scene in scenes_of(tmp_path)] == [
        ("aaa", (), 0),
        ("bbb", (), 0),
        ("cube a", ("aaa",), 6),
        ("cube b", ("aaa",), 6),
    ]


def test_a_configuration_of_another_tour_is_named(tmp_path: Path) -> None:
    write_tour(tmp_path, "Pannellum", KEYS)
    write_configuration(tmp_path, "Pannellum", {"x": "Kitchen", "y": "Hall"}, links={"x": ["y"]})
    notes: list[str] = []
    assert [scene.name for scene in list_scenes(tmp_path, notes)] == ["a", "b", "c"]
    (told,) = notes
    assert told.startswith("titles and links of 2 scenes are not used")
    assert told.endswith("Kitchen, Hall")


WRITERS: dict[str, Callable[[list[Scene]], str]] = {
    "tour.json": lambda scenes: json.dumps(pannellum_tour(scenes)),
    "tour.xml": krpano_tour,
    "data.js": marzipano_data,
}


@pytest.mark.parametrize("file", WRITERS)
def test_our_own_exports_are_read(tmp_path: Path, file: str) -> None:
    for number in range(2):
        write(tmp_path / f"pictures/no {number}.jpg", np.tile(face_of("f"), (1, 2, 1)))
    made = [Scene(f"Room {n}", f"pictures/no {n}.jpg", 128, None, (Link(1 - n, 150.0, -20.0, 0.0),)) for n in range(2)]
    (tmp_path / file).write_text(WRITERS[file](made))
    scenes = scenes_of(tmp_path)
    assert [(scene.name, targets(scene)) for scene in scenes] == [("Room 0", ("Room 1",)), ("Room 1", ("Room 0",))]
    assert [link.direction_deg for scene in scenes for link in scene.links] == [pytest.approx((150.0, -20.0))] * 2
    assert [scene.panorama for scene in scenes] == [tmp_path / f"pictures/no {n}.jpg" for n in range(2)]
    assert is_tour(tmp_path), "links say where scenes stand"
    write(tmp_path / "pictures/another.jpg", np.tile(face_of("f"), (1, 2, 1)))
    assert not is_tour(tmp_path), "no panorama is left out"


HOSTILE = [
    "../secret",
    "/etc",
    "C:\\x",
    "a/../../secret",
    "..\\..\\secret",
    "\u202egnp",
    "nul\0l",
    "x" * 400,
    "%2e%2e/secret",
]


@pytest.mark.parametrize("program", CONFIGURATIONS)
@pytest.mark.parametrize("name", HOSTILE)
def test_nothing_outside_of_the_folder_is_used(tmp_path: Path, program: str, name: str) -> None:
    folder = tmp_path / "inside"
    write_tour(folder, program, KEYS[:2])
    write_tour(tmp_path / "secret", program, ("s",))
    if program == "krpano" and "\0" in name:
        name = name.replace("\0", "")  # XML has no such character
    write_configuration(folder, program, {"a": name, name: "Secret", "b": "CON"}, {"a": [name]})
    scenes = scenes_of(folder)
    assert all(path.is_relative_to(folder) for scene in scenes for path in scene.tiles.values())
    assert len(scenes) == 2
    assert not [problem for scene in scenes if (problem := item_problem(f"{scene.name}.png"))]


@pytest.mark.parametrize(
    ("file", "text"),
    [
        ("tour.xml", '<!DOCTYPE x [<!ENTITY a "aaaa">]><krpano><scene name="&a;"/></krpano>'),
        ("tour.xml", "<krpano><scene></krpano>"),
        ("tour.json", '{"scenes": ' + "[" * 100_000),
        ("tour.json", '{"scenes": {"a": {"type": "multires", "multiRes": {"maxLevel": 1e999}}}'),
        ("data.js", "var APP_DATA = {scenes: f(x)};"),
    ],
)
def test_a_broken_configuration_is_named_and_the_paths_count(tmp_path: Path, file: str, text: str) -> None:
    write_tour(tmp_path, "Pannellum", KEYS[:2])
    (tmp_path / file).write_text(text)
    notes: list[str] = []
    assert [scene.name for scene in list_scenes(tmp_path, notes)] == ["a", "b"]
    assert f"{file}: not used as the configuration of a tour" in notes[0]


@pytest.mark.slow
def test_huge_numbers_cost_nothing(tmp_path: Path) -> None:
    write_tour(tmp_path, "Pannellum", KEYS[:2])
    numbers = {"maxLevel": 999_999_999, "cubeResolution": 1e300, "tileResolution": 1e-300, "path": "/%l/%s%y_%x"}
    scenes = {f"s{n}": {"type": "multires", "multiRes": numbers} for n in range(1000)}
    (tmp_path / "tour.json").write_text(json.dumps({"scenes": scenes | {"a": 1, "b": {"hotSpots": 3, "type": []}}}))
    levels = [{"size": 2 * n, "tileSize": 1} for n in range(5000)]
    (tmp_path / "data.js").write_text(f"APP_DATA = {json.dumps({'scenes': [{'id': 'a', 'levels': levels}]})};")
    multires = " ".join(str(n) for n in range(1, 5000))
    levels_of_krpano = "<level tiledimagewidth='9999999'><cube url='%v'/></level>" * 1000
    (tmp_path / "tour.xml").write_text(
        f'<krpano><scene name="a"><image baseindex="x"><cube url="%00000000000v" multires="{multires}"/></image>'
        f'<image tilesize="1">{levels_of_krpano}</image>'
        "</scene></krpano>"
    )
    assert [scene.name for scene in scenes_of(tmp_path)] == ["a", "b"]


def test_a_picture_cannot_stand_for_several_tiles(tmp_path: Path) -> None:
    write(tmp_path / "one/a.png", face_of("f"))
    for number in range(6):
        write(tmp_path / f"other/{number}.png", face_of("f"))
    cubes = {"a": {"type": "cubemap", "cubeMap": ["one/a.png"] * 6}}
    (tmp_path / "tour.json").write_text(json.dumps({"scenes": cubes}))
    with pytest.raises(InputError, match="no tour here"):
        scenes_of(tmp_path)


@pytest.mark.parametrize(
    ("text", "title"),
    [("Hall / 2", "Hall 2"), (" .. ", ""), ("…a|b\n", "…a b"), ("é" * 100, "é" * 48), ("名" * 40, "名" * 32)],
)
def test_titles_become_parts_of_paths(text: str, title: str) -> None:
    assert plain_title(text) == title
