"""Sheets of plans at a scale, the table of rooms, and what both state of sizes."""

from __future__ import annotations

import csv
import html
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pano_mvs_floor_plan.stages import FloorPlanParams, floor_plan

from pano_mvs.api import Context, Files, Poses, WorldAxes
from pano_mvs.geometry import Rigid3
from tests.stored import read_picture
from tests.synthetic.floor_plan_rooms import WORLD_FROM_Z_UP, flat_ranges, room_cloud, the_cloud, the_poses

INCH = 25.4
DPI = 200


def flat_poses(*, metric: bool = True) -> Poses:
    return the_poses((1.0, 1.5, 1.5), (3.0, 2.2, 1.5), (5.5, 1.0, 1.5), metric=metric)


def planned(folder: Path, poses: Poses | None = None, **settings: Any) -> tuple[Files, Context]:
    """Return the plan of two rooms, 4 by 3 and 3 by 3 m, 2.6 m high, with a wall of .2 m between them."""
    folder.mkdir(exist_ok=True)
    poses = poses or flat_poses()
    plan_from_world = Rigid3(WORLD_FROM_Z_UP.T, np.zeros(3))
    ranges = {
        name: flat_ranges(poses.cam_from_world(idx) @ plan_from_world.inverse(), turn=np.eye(2))
        for idx, name in enumerate(poses.names)
    }
    ctx = Context(np.random.default_rng(0), folder)
    params = FloorPlanParams.model_validate({"formats": ("svg",)} | settings)
    return floor_plan(the_cloud(room_cloud(density=1)), poses, ranges, None, params, ctx), ctx


def texts(files: Files, name: str = "storey_0_sheet.svg") -> list[str]:
    return re.findall(r"<text[^>]*>([^<]*)</text>", files.files[f"floor_plan/{name}"].read_text(encoding="utf-8"))


def extent_mm(files: Files) -> tuple[float, float]:
    """Return the extent of the dark walls in the drawing of the PNG, without frame and title block."""
    picture = read_picture(files.files["floor_plan/storey_0_sheet.png"])
    dark = picture.max(axis=-1) < 100
    edge, block = round(12 / INCH * DPI), round(45 / INCH * DPI)
    rows, columns = np.nonzero(dark[edge:-block, edge:-edge])
    return float(np.ptp(columns)) / DPI * INCH, float(np.ptp(rows)) / DPI * INCH


@pytest.mark.slow
def test_the_sheet_is_at_its_scale_and_states_sizes(tmp_path: Path) -> None:
    files, ctx = planned(tmp_path, sheets=("pdf", "svg", "png"), title="The flat", room_names={"2.jpg": "Bath"})
    kinds = {f"storey_0_{kind}.{suffix}" for kind in ("sheet", "ceiling_sheet") for suffix in ("svg", "png")}
    expected = kinds | {"sheets.pdf", "rooms.csv", "storey_0.svg", "floor_plan.json"}
    assert set(files.files) == {f"floor_plan/{name}" for name in expected}
    shown = texts(files)
    for text in (
        "The flat",
        "Floor plan, storey 0",
        "Scale 1:50 on A4",
        "Room 1",
        "Bath",
        "Unit of length: not stated",
    ):
        assert text in shown
    assert ("N" in shown, "unknown" in shown) == (False, True)  # north
    assert "4.00 × 3.00 ± 0.01 m" in shown
    assert shown.count("h 2.60 ± 0.01 m") == 2
    wide, high = extent_mm(files)
    assert wide == pytest.approx(7200 / 50, abs=1)  # lines are .4 mm wide
    assert high == pytest.approx(3000 / 50, abs=1)
    assert "Reflected ceiling plan, storey 0" in texts(files, "storey_0_ceiling_sheet.svg")
    pdf = files.files["floor_plan/sheets.pdf"].read_bytes()
    assert pdf.startswith(b"%PDF-")
    assert len(re.findall(rb"/Type /Page\b", pdf)) == 3  # plan, ceiling and table
    assert b"/MediaBox [ 0 0 841.8" in pdf  # A4 across
    assert not ctx.notes
    (storey,) = json.loads(files.files["floor_plan/floor_plan.json"].read_text())["storeys"]
    assert storey["sheet_svg"] == "storey_0_sheet.svg"
    assert [room["name"] for room in storey["rooms"]] == ["Room 1", "Bath"]
    for room, width in zip(storey["rooms"], (4, 3), strict=True):
        assert room["size"] == pytest.approx([width, 3], abs=0.005)
        assert room["is_rectangle"]
        assert room["height"] == pytest.approx(2.6, abs=0.005)
        # Ranges of up to 3 m with a standard deviation of .3 %, for each of two walls.
        assert all(0.002 < std < 0.013 for std in (*room["size_stds"], *room["length_stds"], room["height_std"]))
        assert 0 < room["area_std"] < 0.05
    (door,) = (one for one in storey["openings"] if one["kind"] == "door")
    assert door["width"] == pytest.approx(0.9, abs=0.06)
    assert door["rooms"] == [0, 1]
    assert door["leaf"] is None


@pytest.mark.slow
def test_the_table_has_a_row_for_each_room(tmp_path: Path) -> None:
    files, _ = planned(tmp_path, sheets=())
    with files.files["floor_plan/rooms.csv"].open(newline="", encoding="utf-8") as stream:
        first, second = csv.DictReader(stream)
    assert (first["storey"], first["room"]) == ("storey_0", "Room 1")
    assert (first["is_closed"], first["is_rectangle"]) == ("true", "true")
    for column, value in (("length_m", 4), ("width_m", 3), ("height_m", 2.6), ("area_m2", 12), ("perimeter_m", 14)):
        assert float(first[column]) == pytest.approx(value, rel=0.005)
    assert float(first["volume_m3"]) == pytest.approx(31.2, rel=0.01)
    assert float(first["wall_area_m2"]) == pytest.approx(36.4, rel=0.01)
    assert (first["doors"], first["windows"]) == ("1", "1")
    assert (second["doors"], second["windows"]) == ("1", "0")


def test_what_is_not_known_is_empty_or_unknown(tmp_path: Path) -> None:
    """A cloud has no standard deviations, and this one no ceiling."""
    cloud = the_cloud(room_cloud())
    kept = cloud.points_in_world[:, 1] > -2.4
    names = ("points_in_world", "normals_in_world", "colors_rgb", "view_counts")
    cloud = replace(cloud, **{name: getattr(cloud, name)[kept] for name in names})
    ctx = Context(np.random.default_rng(0), tmp_path)
    params = FloorPlanParams(formats=("svg",), sheets=("svg",))
    files = floor_plan(cloud, the_poses((2, 2, 1.5)), None, None, params, ctx)
    with files.files["floor_plan/rooms.csv"].open(newline="", encoding="utf-8") as stream:
        (room,) = csv.DictReader(stream)
    assert room["is_rectangle"] == "false"
    assert all(room[name] == "" for name in ("height_m", "volume_m3", "wall_area_m2", "length_m_std", "area_m2_std"))
    shown = texts(files)
    assert "height unknown" in shown
    assert any(re.fullmatch(r"max\. 5\.9\d × 4\.9\d m|max\. 6\.0\d × 5\.0\d m", text) for text in shown)
    sides = sorted(float(text) for text in shown if re.fullmatch(r"\d\.\d\d", text))
    assert sides == pytest.approx([2, 2.5, 3, 3.5, 5, 6], abs=0.06)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("settings", "scale", "noted"),
    [
        ({"scale": 100, "paper": "a3"}, "1:100 on A3", ""),
        ({"scale": 25}, "1:50 on A4", "the plan does not fit on A4 at 1:25: 1:50 is used"),
    ],
)
def test_a_scale_that_does_not_fit_is_replaced(
    tmp_path: Path, settings: dict[str, Any], scale: str, noted: str
) -> None:
    files, ctx = planned(tmp_path, sheets=("svg",), **settings)
    assert f"Scale {scale}" in texts(files)
    assert ctx.notes == ([noted] if noted else [])


@pytest.mark.slow
def test_without_a_unit_no_scale_is_stated(tmp_path: Path) -> None:
    files, ctx = planned(tmp_path, flat_poses(metric=False), sheets=("svg",), scale=50)
    shown = texts(files)
    assert "No scale: no length is known" in shown
    assert any(text.endswith(" units") for text in shown)
    assert not any(text.endswith((" m", " m²")) for text in shown)
    assert ctx.notes == ["sheets are not at 1:50: no length is known"]


def turned_flat(folder: Path, angle_deg: float, **settings: Any) -> Files:
    """Return the plan of the two rooms in a world with north that is turned."""
    poses, angle = flat_poses(), np.deg2rad(angle_deg)
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    turned = Poses.without_points(
        {name: poses.cam_from_world(idx) @ Rigid3(turn.T, np.zeros(3)) for idx, name in enumerate(poses.names)},
        frame="", scale="", metric=True, axes=WorldAxes.NORTH,
    )  # fmt: skip
    plan_from_world = Rigid3(WORLD_FROM_Z_UP.T @ turn.T, np.zeros(3))
    ranges = {
        name: flat_ranges(turned.cam_from_world(idx) @ plan_from_world.inverse(), turn=np.eye(2))
        for idx, name in enumerate(turned.names)
    }
    params = FloorPlanParams.model_validate({"formats": ("svg",)} | settings)
    ctx = Context(np.random.default_rng(0), folder)
    return floor_plan(the_cloud(room_cloud(density=1)), turned, ranges, None, params, ctx)


@pytest.mark.slow
def test_a_turned_plan_lies_along_the_paper_and_north_turns_with_it(tmp_path: Path) -> None:
    angle_deg = -35.0
    files = turned_flat(tmp_path, angle_deg, sheets=("png", "svg"))
    wide, high = extent_mm(files)
    assert wide == pytest.approx(7200 / 50, abs=1.5)
    assert high == pytest.approx(3000 / 50, abs=1.5)
    (storey,) = json.loads(files.files["floor_plan/floor_plan.json"].read_text())["storeys"]
    way = np.diff(storey["rooms"][0]["outline"], axis=0)[0]
    turn = (np.arctan2(way[1], way[0]) + np.pi / 4) % (np.pi / 2) - np.pi / 4  # of the walls, in the plan
    assert abs(turn) == pytest.approx(np.deg2rad(abs(angle_deg)), abs=0.01)
    svg = files.files["floor_plan/storey_0_sheet.svg"].read_text(encoding="utf-8")
    assert "unknown" not in texts(files)
    (place,) = re.findall(r"<text([^>]*)>N</text>", svg)
    x, y = (float(value) for value in re.findall(r"-?[\d.]+", place.split("rotate(")[1])[1:3])
    # From the middle of the field of the north arrow, which is at the right end of the title block; in mm.
    across, up = x * INCH / 72 - (297 - 8 - 11), 210 - y * INCH / 72 - (8 + 15 - 1.5)
    assert np.arctan2(across, up) == pytest.approx(turn, abs=0.15)


@pytest.mark.slow
def test_the_plan_is_not_mirrored_and_the_ceiling_lies_over_it(tmp_path: Path) -> None:
    """The notch of the L is in the upper right corner; the ceiling has a red patch in the lower right one."""
    room = room_cloud(density=2000)
    patch = (room.points[:, 2] > 2.5) & (room.points[:, 0] > 5) & (room.points[:, 1] < 1)
    room = replace(room, colors=np.where(patch[:, None], np.array([220, 0, 0], np.uint8), room.colors))
    ctx = Context(np.random.default_rng(0), tmp_path)
    params = FloorPlanParams(formats=("svg",), sheets=("png",))
    files = floor_plan(the_cloud(room), the_poses((2, 2, 1.5)), None, None, params, ctx)
    edge, block = round(12 / INCH * DPI), round(45 / INCH * DPI)
    sheets = [
        read_picture(files.files[f"floor_plan/storey_0_{kind}.png"])[edge:-block, edge:-edge].astype(int)
        for kind in ("sheet", "ceiling_sheet")
    ]
    rows, columns = np.nonzero(sheets[0].max(axis=-1) < 100)
    top, left, high, wide = rows.min(), columns.min(), np.ptp(rows), np.ptp(columns)

    def dark_share(row: float, column: float) -> float:
        y, x = round(top + row * high), round(left + column * wide)
        return float((sheets[0][y - 6 : y + 7, x - 6 : x + 7].max(axis=-1) < 100).mean())

    corners = {corner: dark_share(*corner) for corner in ((0, 0), (0, 1), (1, 0), (1, 1))}
    assert corners[0, 1] == 0
    assert min(share for corner, share in corners.items() if corner != (0, 1)) > 0.1
    red = (sheets[1][..., 2] - sheets[1][..., 1] > 100) & (sheets[1][..., 2] > 150)  # walls are less red
    rows, columns = np.nonzero(red)
    assert (rows.mean() - top) / high == pytest.approx(4.5 / 5, abs=0.03)
    assert (columns.mean() - left) / wide == pytest.approx(5.5 / 6, abs=0.03)


def test_an_end_that_was_not_seen_is_open(tmp_path: Path) -> None:
    """A corridor of 12 m whose last part no point shows."""
    corridor = room_cloud(((0.0, 0.0), (12.0, 0.0), (12.0, 2.0), (0.0, 2.0)), table=False)
    kept = corridor.points[:, 0] < 9
    part = replace(corridor, **{name: getattr(corridor, name)[kept] for name in ("points", "normals", "colors")})
    ctx = Context(np.random.default_rng(0), tmp_path)
    params = FloorPlanParams(formats=("svg",), sheets=("svg",))
    files = floor_plan(the_cloud(part), the_poses((2, 1, 1.5), (6, 1, 1.5)), None, None, params, ctx)
    (storey,) = json.loads(files.files["floor_plan/floor_plan.json"].read_text())["storeys"]
    (room,) = storey["rooms"]
    assert not room["is_closed"]
    assert room["size"] == [None, pytest.approx(2.0, abs=0.05)]
    shown = texts(files)
    assert any(re.fullmatch(r"open × (1\.9|2\.0)\d m", text) for text in shown)
    assert any(re.fullmatch(r"over 1\d\.\d m²", text) for text in shown)
    with files.files["floor_plan/rooms.csv"].open(newline="", encoding="utf-8") as stream:
        (row,) = csv.DictReader(stream)
    assert (row["is_closed"], row["length_m"], row["volume_m3"]) == ("false", "", "")


@pytest.mark.slow
def test_names_that_nothing_shows_are_said(tmp_path: Path) -> None:
    names = {"0.jpg": "Hall", "1.jpg": "Kitchen", "9.jpg": "Attic"}
    files, ctx = planned(
        tmp_path, sheets=("svg",), room_names=names, title="A house in a street with a long name, 1234"
    )
    assert ctx.notes == [
        "room_names: 1.jpg is in the room Hall, which it would call Kitchen",
        "room_names: there is no camera 9.jpg",
    ]
    shown = texts(files)
    assert "1234" in " ".join(shown)  # of a title of several lines
    for wrong in (
        {"title": ""},
        {"title": "a\nb"},
        {"room_names": {"0.jpg": " "}},
        {"room_names": {"0.jpg": "x" * 41}},
    ):
        with pytest.raises(ValueError, match=r"must have letters|at most 40|at least 1"):
            FloorPlanParams.model_validate(wrong)


@pytest.mark.slow
def test_any_name_is_text_and_the_same_plan_gives_the_same_bytes(tmp_path: Path) -> None:
    names = {"0.jpg": "$x^2$ & <b>", "2.jpg": "台所"}
    named: dict[str, Any] = {"sheets": ("pdf", "svg", "png"), "title": "$5 _{ flat", "room_names": names}
    first, second = (planned(tmp_path / name, **named)[0] for name in "ab")
    shown = [html.unescape(text) for text in texts(first)]
    assert {"$5 _{ flat", *names.values()} <= set(shown)
    for name, path in first.files.items():
        assert path.read_bytes() == second.files[name].read_bytes(), name
