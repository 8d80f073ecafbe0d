"""The map of a shared page."""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from box_run import box_run, frame_of_page
from pano_mvs_page.maps import MapPlace, closed, coverage_colors, cut_height, place_around, run_plans, top_view
from pano_mvs_page.share import share_run
from test_share import value_of

from pano_mvs.results.run_output import load
from pano_mvs.scene import PointCloud
from pano_mvs.scene.image_file import write_png
from pano_mvs.scene.upright import z_up_from_world


def cloud_of(points: np.ndarray, colors: np.ndarray, views: np.ndarray) -> PointCloud:
    return PointCloud(points.astype(np.float32), np.zeros_like(points, np.float32), colors, views.astype(np.uint8))


def test_the_map_shows_what_is_highest_below_the_cut() -> None:
    grid = np.stack(np.meshgrid(np.arange(-50, 51), [0, 1, 3], np.arange(-25, 26), indexing="ij"), axis=-1) / 10
    points = grid.reshape(-1, 3)
    levels = np.searchsorted([0.05, 0.2], points[:, 1])
    colors = np.eye(3, dtype=np.uint8)[levels] * 200
    cloud = cloud_of(points, colors, np.where(points[:, 0] > 0, 6, 1))
    place = MapPlace(np.array([-5.0, -2.5]), np.array([10.0, 0]), np.array([0, 5.0]))
    picture, coverage = top_view(cloud, place, (-np.inf, 0.2))
    assert picture.shape == (256, 512, 4)
    drawn = picture[..., 3] > 0
    assert (picture[drawn][:, 1] == 200).all()  # the middle level: not the floor, not what lies above the cut
    assert coverage is not None
    assert np.abs(coverage[drawn & (np.arange(512) > 300)][:, :3] - np.array([26, 153, 115])).max() <= 1
    assert np.abs(coverage[drawn & (np.arange(512) < 200)][:, :3] - np.array([199, 38, 74])).max() <= 1


def test_a_place_holds_all_cameras_and_fractions_begin_at_its_corner() -> None:
    points = np.random.default_rng(0).uniform(-1, 1, (500, 3)).astype(np.float32)
    place = place_around(points, [[4.0, 0.5, 0.0]])
    inside = place.fractions(np.array([[4.0, 0.5, 0.0], [place.corner[0], 9, place.corner[1]]]))
    assert inside[1] == pytest.approx([0, 0])
    assert 0.5 < inside[0][0] < 1
    assert cut_height(points, []) == np.inf
    assert 0.5 < cut_height(points, [[0, 0.5, 0]]) < 0.7


def test_coverage_colours_and_gaps() -> None:
    assert coverage_colors(np.array([0, 1, 6, 200], np.uint8)).tolist() == [
        [199, 38, 74, 0],
        [199, 38, 74, 255],
        [26, 153, 115, 255],
        [26, 153, 115, 255],
    ]
    image = np.full((9, 9, 4), 255, np.uint8)
    image[..., :3] = 80
    image[4, 4] = 0
    assert closed(image)[4, 4].tolist() == [80, 80, 80, 255]


def test_without_a_floor_plan_the_cloud_is_the_map(tmp_path: Path) -> None:
    share_run(box_run(tmp_path, points=5_000), tmp_path / "page")
    data = tmp_path / "page" / "data"
    (described,) = value_of(data / "scene.js")["maps"]
    picture = cv2.imdecode(
        np.frombuffer(base64.b64decode(value_of(data / "map/0/colors.js")), np.uint8), cv2.IMREAD_UNCHANGED
    )
    assert picture is not None
    assert picture.shape[1] / picture.shape[0] == pytest.approx(described["aspect"], rel=0.01)
    assert described["coverage"]
    assert described["heights"] is None


def floor_plan(out: Path, count: int, *, rooms: int = 1) -> None:
    """Write floor plans as `export.floor_plan` does, 4 by 2 units around the origin, one storey above the other."""
    (out / "floor_plan").mkdir()
    storeys = []
    for number in range(count):
        picture = np.full((50, 100, 3), 255, np.uint8)
        picture[:25, :50] = (200, 0, 0)
        write_png(out / "floor_plan" / f"storey_{number}.png", picture)
        entry: dict[str, Any] = {
            "png": f"storey_{number}.png",
            "origin_xy": [-2.0, 1.0],
            "units_per_pixel": 0.04,
            "size_px": [100, 50],
        }
        entry["rooms"] = [{}] * rooms if number == 0 else []
        storeys.append({**entry, "z_range": [3.0 * number - 1.5, 3.0 * number + 1.5]})
    about = {"file_from_world": z_up_from_world().tolist(), "storeys": storeys}
    (out / "floor_plan" / "floor_plan.json").write_text(json.dumps(about))


def test_floor_plans_lie_where_they_were_drawn(tmp_path: Path) -> None:
    run = box_run(tmp_path, points=5_000)
    floor_plan(run.out, 2)
    frame = frame_of_page()
    plans, note = run_plans(load(run.out), frame)
    assert note == ""
    assert len(plans) == 2
    # The world has y down, so (x, y, z) of the file is (x, -z, y) of the world.
    points = frame.apply(np.array([[-2, 0, 1], [2, 0, 1], [2, 0, -1], [0, 0, 0]], float))
    assert plans[0].place.fractions(points) == pytest.approx(np.array([[0, 0], [1, 0], [1, 1], [0.5, 0.5]]), abs=1e-9)
    floor, ceiling = frame.apply(np.array([[0, 1.5, 0], [0, -1.5, 0]]))[:, 1]
    assert plans[0].heights == pytest.approx((floor, ceiling))
    assert plans[1].heights == pytest.approx((ceiling, ceiling + 3))
    assert plans[0].picture[3, 3].tolist() == [200, 0, 0]
    share_run(load(run.out), tmp_path / "page")
    maps = value_of(tmp_path / "page" / "data" / "scene.js")["maps"]
    assert [entry["heights"] for entry in maps] == [pytest.approx(plan.heights) for plan in plans]


def test_where_no_room_was_found_the_cloud_is_the_map(tmp_path: Path) -> None:
    run = box_run(tmp_path, points=500)
    floor_plan(run.out, 2, rooms=0)
    assert run_plans(load(run.out), frame_of_page()) == ([], "")


def test_a_damaged_floor_plan_is_named(tmp_path: Path) -> None:
    run = box_run(tmp_path, points=500)
    floor_plan(run.out, 1)
    (run.out / "floor_plan" / "storey_0.png").write_bytes(b"no picture")
    shared = share_run(load(run.out), tmp_path / "page")
    assert "floor_plan.json was left out" in shared.notes[0]
    assert len(value_of(tmp_path / "page" / "data" / "scene.js")["maps"]) == 1
