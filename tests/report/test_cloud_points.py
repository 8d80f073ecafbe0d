"""The cloud for the viewer in the page: thinned evenly, level, and encoded as the script reads it."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pano_mvs.report import cloud_points
from pano_mvs.report.cloud_points import MAX_POINTS, encoded, level_axes, one_per_voxel, turnable_cloud
from pano_mvs.report.earlier_page import EarlierPage
from pano_mvs.report.page import write_report
from pano_mvs.results.stored_values import StoredValues
from pano_mvs.results.summary import RunSummary
from pano_mvs.testing.tiny_capture import TinyCapture
from tests.report.conftest import summary_of
from tests.viewer.scenes import box_cloud

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
    monkeypatch.setattr(cloud_points, "encoded", lambda *_: pytest.fail("encoded again"))
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
    assert MAX_POINTS * cloud_points.POINT_BYTES * 4 / 3 <= 2_400_000
