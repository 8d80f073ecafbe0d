"""The cloud in the page: its points, and its pictures from three places."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.rendering import Viewpoint, draw_cloud, facing, horizontal_axes, inside_camera, viewpoints
from pano_mvs.report import cloud as cloud_module
from pano_mvs.report.cloud import MAX_POINTS, encoded, level_axes, one_per_voxel, turnable_cloud
from pano_mvs.report.earlier_page import EarlierPage
from pano_mvs.report.page import write_report
from pano_mvs.results.stored_values import StoredValues
from pano_mvs.results.summary import RunSummary
from pano_mvs.testing.tiny_capture import TinyCapture
from tests.report.conftest import summary_of
from tests.synthetic.viewed_scenes import box_cloud

UP = np.array([0.0, -1.0, 0.0])


def decoded(fact: dict[str, Any]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points, normals and colours as the viewer's shader sees them."""
    packed = np.frombuffer(base64.b64decode(fact["data"]), np.uint8).reshape(-1, 12)
    places = np.ascontiguousarray(packed[:, :6]).view("<u2").astype(float) / 65535
    return places * fact["size"] + np.array(fact["lower"]), packed[:, 6:9].view(np.int8) / 127, packed[:, 9:]


def test_the_viewers_frame_has_y_up_and_is_right_handed() -> None:
    for up in (UP, np.array([0.0, 0.6, 0.8]), np.array([0.0, 0.0, 1.0])):
        rotation = level_axes(up)
        assert rotation @ up == pytest.approx([0, 1, 0])
        assert np.linalg.det(rotation) == pytest.approx(1)
    assert level_axes(UP) @ [0, 0, 1] == pytest.approx([0, 0, -1]), "forward is into the picture"


def test_points_normals_and_colours_survive_the_encoding() -> None:
    cloud = box_cloud(500, quality=False)
    fact = encoded(cloud, level_axes(UP))
    points, normals, colors = decoded(fact)
    assert fact["count"] == fact["total"] == 500
    assert points * (1, -1, -1) == pytest.approx(cloud.points_in_world, abs=2e-4)
    assert normals * (1, -1, -1) == pytest.approx(cloud.normals_in_world, abs=0.01)
    assert (colors == cloud.colors_rgb).all()
    assert fact["middle"] == pytest.approx([0, 0, 0], abs=0.2)
    assert fact["radius"] == pytest.approx(np.linalg.norm([3, 1.5, 4]), rel=0.05)


def test_far_outliers_do_not_coarsen_the_places() -> None:
    cloud = box_cloud(2000, quality=False)
    cloud.points_in_world[7] = 1e5
    fact = encoded(cloud, level_axes(UP))
    assert fact["count"] == 1999
    assert fact["size"] == pytest.approx(8, rel=0.01)


def test_thinning_spreads_points_evenly() -> None:
    """A wall that was seen from nearby has a hundred times as many points as an equal one far away."""
    rng = np.random.default_rng(0)
    near, far = rng.uniform(0, 1, (50_000, 3)) * (1, 1, 0), rng.uniform(0, 1, (500, 3)) * (1, 1, 0) + (0, 0, 1)
    points = np.concatenate([near, far])
    chosen, spacing = one_per_voxel(points, 700)
    assert 600 <= len(chosen) <= 700
    assert (np.diff(chosen) > 0).all()
    assert 0.4 < (points[chosen, 2] == 1).mean() < 0.5
    assert 0.04 < spacing < 0.08


def test_few_points_are_all_kept() -> None:
    chosen, spacing = one_per_voxel(np.eye(3), 10)
    assert chosen.tolist() == [0, 1, 2]
    assert spacing > 0
    assert one_per_voxel(np.zeros((5, 3)), 10)[0].tolist() == [0]


def test_the_page_carries_the_points_and_the_next_page_reuses_them(
    results: StoredValues, tiny: TinyCapture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    summary = RunSummary.from_json(
        summary_of(tiny) | {"poses": summary_of(tiny)["poses"] | {"doubts": {"000.png": "x"}}}
    )
    write_report(tmp_path, summary, results)
    monkeypatch.setattr(cloud_module, "encoded", lambda *_: pytest.fail("encoded again"))
    earlier = EarlierPage.of_file(tmp_path / "report.html")
    turnable = turnable_cloud(results, summary.poses, earlier, up=UP)
    assert turnable is not None
    assert turnable.points == turnable.total == 240
    assert [camera[3:] for camera in turnable.cameras] == [
        (True, "000.png"),
        *((False, name) for name in tiny.names[1:]),
    ]
    at = np.array([camera[:3] for camera in turnable.cameras])
    assert at * (1, -1, -1) == pytest.approx(np.array(summary.poses.centers), abs=1e-4)


def test_without_a_cloud_there_is_no_viewer(tmp_path: Path, tiny: TinyCapture) -> None:
    assert turnable_cloud(StoredValues(), RunSummary().poses, EarlierPage(), up=UP) is None
    write_report(tmp_path, RunSummary.from_json(summary_of(tiny)))
    assert 'id="viewer"' not in (tmp_path / "report.html").read_text(encoding="utf-8")


def test_the_largest_cloud_takes_its_share_of_the_page() -> None:
    assert MAX_POINTS * cloud_module.POINT_BYTES * 4 / 3 <= 2_400_000


SIZE_HW = (60, 96)


def room(
    rng: np.random.Generator, count: int = 20_000
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.uint8]]:
    """Return points on the inside of a box 6 × 3 × 4 around the origin, their normals inwards, one colour a side."""
    points = rng.uniform(-1, 1, (count, 3))
    axis = rng.integers(0, 3, count)
    side = rng.choice([-1.0, 1.0], count)
    points[np.arange(count), axis] = side
    normals = np.zeros((count, 3))
    normals[np.arange(count), axis] = -side
    colors = np.array([[200, 0, 0], [0, 200, 0], [0, 0, 200]], np.uint8)[axis] + (side > 0)[:, None] * np.uint8(50)
    return (points * (3, 1.5, 2)).astype(np.float32), normals.astype(np.float32), colors.astype(np.uint8)


def test_from_above_the_floor_is_seen_and_no_ceiling() -> None:
    points, normals, colors = room(np.random.default_rng(1))
    above, outside, _ = viewpoints(points, np.zeros((1, 3)), UP, aspect=1.6)
    for viewpoint in (above, outside):
        shown = facing(points, normals, viewpoint)
        assert shown[normals[:, 1] < 0].all(), "the floor: y is down"
        assert not shown[normals[:, 1] > 0].any(), "the ceiling"
    image = draw_cloud(points, normals, colors, viewpoint=above, size_hw=SIZE_HW)
    seen = image[20:40, 38:58].reshape(-1, 3)
    seen = seen[(seen != (238, 241, 244)).any(axis=1)]
    assert len(seen) > 100
    assert (seen == (50, 250, 50)).all(), "the floor in the middle"


def test_from_above_it_is_true_to_scale_with_z_upwards() -> None:
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 0, 1], [-1, 0, -1]], np.float32)
    normals = np.tile(UP.astype(np.float32), (4, 1))
    colors = np.array([[9, 9, 9], [255, 0, 0], [0, 255, 0], [0, 0, 255]], np.uint8)
    above, _, _ = viewpoints(points, np.zeros((0, 3)), UP, aspect=1.6)
    image = draw_cloud(points, normals, colors, viewpoint=above, size_hw=SIZE_HW).astype(int)
    places = {
        channel: np.argwhere((image[..., channel] == 255) & (image.sum(axis=-1) == 255)).mean(axis=0)
        for channel in range(3)
    }
    red, green, blue = places[0], places[1], places[2]
    assert red[1] > green[1] > blue[1], "x to the right"
    assert green[0] < red[0] < blue[0], "z upwards"
    assert np.linalg.norm(red - green) == pytest.approx(np.sqrt(2) * (blue[0] - red[0]), abs=1.5)


def test_from_inside_the_outermost_camera_looks_at_the_others() -> None:
    centers = np.array([[0, 0, 0], [0.2, 0, 0], [4, 0.5, 0]], float)
    assert inside_camera(centers) == 2
    *_, inside = viewpoints(np.eye(3, dtype=np.float32), centers, UP, aspect=1.6, place="2.jpg")
    assert inside.eye.tolist() == [4, 0.5, 0]
    assert inside.target - inside.eye == pytest.approx([-1, 0, 0], abs=1e-9), "level"
    assert "2.jpg" in inside.title


@pytest.mark.parametrize("points", [[[1, 2, 3]], [[1, 2, 3]] * 5, [[0, 0, 0], [0, 9, 0]], [[1e6, 0, 0], [1e6, 1, 0]]])
@pytest.mark.parametrize("centers", [[], [[1, 2, 3]], [[1, 2, 3]] * 3, [[0, 0, 0], [0, 5, 0]]])
@pytest.mark.parametrize("up", [[0, -1, 0], [0, 0, 1], [1, 0, 0]])
def test_whatever_lies_where_there_is_a_picture(
    points: Sequence[Sequence[float]], centers: Sequence[Sequence[float]], up: Sequence[float]
) -> None:
    places = np.array(points, np.float32)
    found = viewpoints(places, np.array(centers, float).reshape(-1, 3), np.array(up, float), aspect=1.6)
    for viewpoint in found:
        for vector in (viewpoint.eye, viewpoint.target, viewpoint.up):
            assert np.isfinite(vector).all()
        assert np.linalg.norm(viewpoint.target - viewpoint.eye) > 0
        image = draw_cloud(
            places, np.zeros_like(places), np.full(places.shape, 7, np.uint8), viewpoint=viewpoint, size_hw=SIZE_HW
        )
        assert image.shape == (*SIZE_HW, 3)


def test_the_nearer_point_hides_the_farther_one() -> None:
    ahead = Viewpoint("", np.zeros(3), np.array([0.0, 0, 1]), UP, fov_deg=60)
    points = np.array([[0, 0, 2], [0, 0, 1], [0, 0, 3], [0, 0, -1]], np.float32)
    colors = np.array([[1, 1, 1], [250, 0, 0], [2, 2, 2], [3, 3, 3]], np.uint8)
    image = draw_cloud(points, np.zeros_like(points), colors, viewpoint=ahead, size_hw=SIZE_HW)
    drawn = np.unique(image.reshape(-1, 3), axis=0).tolist()
    assert drawn == [[238, 241, 244], [250, 0, 0]]
    assert (image[30, 48] == (250, 0, 0)).all()


@pytest.mark.parametrize("up", [[0, -1, 0], [0, 0, 1], [0.6, 0, 0.8], [0, 0, -1]])
def test_horizontal_axes_are_across_up_with_right_on_the_right(up: Sequence[float]) -> None:
    right, forward = horizontal_axes(np.array(up, float))
    frame = np.stack([right, np.array(up, float), forward])
    assert frame @ frame.T == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(frame) == pytest.approx(-1), "seen from above, forward up the page, right is to the right"
