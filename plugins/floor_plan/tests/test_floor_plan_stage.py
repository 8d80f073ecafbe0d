"""Floor plans of rooms whose walls are known: pictures, drawings and what floor_plan.json states."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import Any

import ezdxf
import numpy as np
import pytest
import trimesh
from ezdxf.filemanagement import readfile
from pano_mvs_floor_plan.stages import FloorPlanParams, floor_plan

from pano_mvs.api import Context, Files, PointCloud, Poses, RangeMap, WorldAxes
from pano_mvs.geometry import Rigid3
from tests.stored import read_picture
from tests.synthetic.floor_plan_rooms import (
    WORLD_FROM_Z_UP,
    distance_to,
    flat_ranges,
    room_cloud,
    samples,
    the_cloud,
    the_poses,
    walls_of,
)

STAIRS = ((0.0, 0.0), (4.0, 0.0), (4.0, 3.0), (0.0, 3.0))
SVG_LINE = re.compile(r'<line x1="([-.\d]+)" y1="([-.\d]+)" x2="([-.\d]+)" y2="([-.\d]+)"/>')


def planned(
    folder: Path, cloud: PointCloud, poses: Poses, ranges: dict[str, RangeMap] | None = None, **settings: Any
) -> tuple[Files, Context]:
    folder.mkdir(exist_ok=True)
    ctx = Context(np.random.default_rng(0), folder)
    return floor_plan(
        cloud, poses, ranges, None, FloorPlanParams.model_validate({"width_px": 600, "sheets": ()} | settings), ctx
    ), ctx


def stated(files: Files, folder: str = "floor_plan") -> dict[str, Any]:
    about: dict[str, Any] = json.loads(files.files[f"{folder}/floor_plan.json"].read_text())
    return about


def svg_walls(files: Files, name: str = "floor_plan/storey_0.svg") -> np.ndarray:
    found = SVG_LINE.findall(files.files[name].read_text().split('<g id="walls">')[1].split("</g>")[0])
    return np.array(found, np.float64).reshape(-1, 2, 2)


def test_the_drawings_have_the_walls_of_the_room(tmp_path: Path) -> None:
    files, ctx = planned(tmp_path, the_cloud(room_cloud()), the_poses((2, 2, 1.5)), formats=("png", "svg", "dxf"))
    drawings = {f"storey_0.{suffix}" for suffix in ("png", "pgw", "svg", "dxf")}
    names = {"floor_plan.json", "rooms.csv"} | drawings
    assert set(files.files) == {f"floor_plan/{name}" for name in names}
    true = walls_of(((0, 0), (6, 0), (6, 3), (3.5, 3), (3.5, 5), (0, 5)))
    walls = svg_walls(files)
    assert len(walls) == 6
    assert distance_to(true, samples(walls)).max() < 0.04
    assert distance_to(walls, samples(true)).max() < 0.04
    drawing = readfile(files.files["floor_plan/storey_0.dxf"])
    lines = drawing.modelspace().query('LINE[layer=="WALLS"]')
    ends = np.array([[tuple(line.dxf.start.vec2), tuple(line.dxf.end.vec2)] for line in lines])
    np.testing.assert_allclose(ends, walls, atol=1e-5)
    assert drawing.units == ezdxf.units.M
    with files.files["floor_plan/storey_0.dxf"].open("rb") as stream:
        plan = trimesh.load_path(stream, file_type="dxf")  # by a reader of its own
    found = np.array([plan.vertices[line.points] for line in plan.entities if line.layer == "WALLS"])
    np.testing.assert_allclose(sorted(found.reshape(-1, 4).tolist()), sorted(ends.reshape(-1, 4).tolist()), atol=1e-5)
    assert ctx.metrics == {"storeys": 1, "rooms": 1, "walls": 6}
    (room,) = stated(files)["storeys"][0]["rooms"]
    assert room["area"] == pytest.approx(25, rel=0.01)
    assert sorted(room["lengths"]) == pytest.approx([2, 2.5, 3, 3.5, 5, 6], abs=0.03)
    assert not ctx.notes


def test_rooms_doors_and_thickness_are_stated(tmp_path: Path) -> None:
    """Two rooms of which there are range maps, but hardly a cloud."""
    poses = the_poses((1.0, 1.5, 1.5), (3.0, 2.2, 1.5), (5.5, 1.0, 1.5))
    plan_from_world = Rigid3(WORLD_FROM_Z_UP.T, np.zeros(3))
    ranges = {
        name: flat_ranges(poses.cam_from_world(idx) @ plan_from_world.inverse(), turn=np.eye(2))
        for idx, name in enumerate(poses.names)
    }
    files, _ = planned(tmp_path, the_cloud(room_cloud(density=1)), poses, ranges, formats=("png", "svg", "dxf"))
    (storey,) = stated(files)["storeys"]
    assert sorted(room["area"] for room in storey["rooms"]) == pytest.approx([9, 12], rel=0.02)
    assert {wall["thickness"] and round(wall["thickness"], 1) for wall in storey["walls"]} == {None, 0.2}
    assert sorted(one["kind"] for one in storey["openings"]) == ["door", "window"]
    drawing = readfile(files.files["floor_plan/storey_0.dxf"]).modelspace()
    assert [len(drawing.query(f'LINE[layer=="{layer}"]')) for layer in ("DOORS", "WINDOWS")] == [1, 1]
    assert len(drawing.query('LWPOLYLINE[layer=="ROOMS"]')) == 2
    text = files.files["floor_plan/storey_0.svg"].read_text()
    assert len(re.findall(r">\d+\.\d m²<", text)) == 2
    assert text.count("<polygon") == 4


def test_the_world_file_places_the_picture(tmp_path: Path) -> None:
    files, _ = planned(tmp_path, the_cloud(room_cloud(density=1500)), the_poses((2, 2, 1.5)))
    about = stated(files)
    (storey,) = about["storeys"]
    picture = read_picture(files.files["floor_plan/storey_0.png"])[..., ::-1]
    assert list(picture.shape[1::-1]) == storey["size_px"]
    assert picture.shape[0] > storey["plan_size_px"][1]  # with the strip of the scale bar
    size, skew_1, skew_2, down, x, y = map(float, files.files["floor_plan/storey_0.pgw"].read_text().split())
    assert (skew_1, skew_2, down) == (0, 0, -size)
    assert size == pytest.approx(storey["metres_per_pixel"])
    assert [x - size / 2, y + size / 2] == pytest.approx(storey["origin_xy"])
    column, row = round((1.6 - x) / size), round((y - 1.4) / size)
    assert picture[row, column].tolist() == [30, 30, 220]  # the table
    column, row = round((5.0 - x) / size), round((y - 4.0) / size)
    assert picture[row, column].tolist() == [255, 255, 255]  # outside
    column, row = round((3.0 - x) / size), round((y - 0.0) / size)
    assert picture[row, column].max() < 100  # a wall
    assert storey["z_range"] == pytest.approx([0, 2.6], abs=0.03)
    assert storey["cameras"] == {"0.jpg": pytest.approx([2, 2])}
    assert about["unit"] == "metre"
    assert about["file_from_world"] == [[1, 0, 0], [0, 0, 1], [0, -1, 0]]


def test_each_storey_has_its_plan(tmp_path: Path) -> None:
    cloud = the_cloud(room_cloud(), room_cloud(STAIRS, floor=2.9, seed=1))
    files, _ = planned(tmp_path, cloud, the_poses((2, 2, 1.5), (1, 1, 4.4), (2, 1, 1.6)), formats=("svg",))
    storeys = stated(files)["storeys"]
    assert [storey["svg"] for storey in storeys] == ["storey_0.svg", "storey_1.svg"]
    assert [list(storey["cameras"]) for storey in storeys] == [["0.jpg", "2.jpg"], ["1.jpg"]]
    assert distance_to(walls_of(STAIRS), samples(svg_walls(files, "floor_plan/storey_1.svg"))).max() < 0.04
    assert "png" not in storeys[0]


def test_without_a_scale_units_are_scene_units(tmp_path: Path) -> None:
    files, _ = planned(tmp_path, the_cloud(room_cloud()), the_poses((2, 2, 1.5), metric=False), formats=("svg", "dxf"))
    assert stated(files)["unit"] == "scene unit"
    assert stated(files)["storeys"][0]["metres_per_pixel"] is None
    assert ">1 scene unit</text>" in files.files["floor_plan/storey_0.svg"].read_text()
    assert readfile(files.files["floor_plan/storey_0.dxf"]).units == 0


def test_groups_have_a_plan_each_and_too_few_points_none(tmp_path: Path) -> None:
    large = the_cloud(room_cloud())
    few = PointCloud(
        *(getattr(large, name)[:50] for name in ("points_in_world", "normals_in_world", "colors_rgb", "view_counts"))
    )
    cameras = {f"{idx}.jpg": Rigid3(np.eye(3), np.array([-2.0 - idx, 1.5, -2.0])) for idx in range(5)}
    one = Poses.without_points(cameras, frame="", scale="", metric=True, axes=WorldAxes.LEVEL)
    both = Poses(**{**vars(one), "group_idx": np.array([0, 0, 0, 1, 1], np.int32), "other_worlds": (("b", "", False),)})
    files, ctx = planned(tmp_path, PointCloud.of_groups([large, few]), both, formats=("svg",))
    names = {"floor_plan.json", "rooms.csv", "storey_0.svg"}
    assert set(files.files) == {f"floor_plan/{name}" for name in names}
    assert ctx.notes == ["group 1: no floor plan: 50 points of the cloud are seen from 2 views"]
    files, _ = planned(tmp_path / "b", PointCloud.of_groups([large, large]), both, formats=("svg",))
    assert "floor_plan_1/storey_0.svg" in files.files
    assert stated(files, "floor_plan_1")["unit"] == "scene unit"


def test_too_many_pixels_are_limited(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pano_mvs_floor_plan.stages._MAX_SIDE_PX", 300)
    files, ctx = planned(tmp_path, the_cloud(room_cloud()), the_poses((2, 2, 1.5)), pixel=0.0005, formats=("svg",))
    assert max(stated(files)["storeys"][0]["plan_size_px"]) <= 300
    assert "would be too many" in ctx.notes[0]


def test_dxf_needs_ezdxf(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ezdxf", None)
    with pytest.raises(ValueError, match=r"pip install 'pano-mvs\[dxf\]'"):
        FloorPlanParams(formats=("dxf",))
