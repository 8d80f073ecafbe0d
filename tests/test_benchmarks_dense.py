"""The benchmarks of depth measure what they say: on a tiny scene, with settings whose effect is known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pano_mvs.geometry import ray_grid
from pano_mvs.scene import RangeMap
from pano_mvs.testing.scenes import weak_room, white_room, write_scene
from tests.benchmarks.captures import Capture, read_capture, scene_capture
from tests.benchmarks.dense_chain import DenseChain, score_view
from tests.benchmarks.depth.stored_chain import StoredChain
from tests.benchmarks.depth_metrics import depth_metrics
from tests.benchmarks.scenes import line, measure
from tests.benchmarks.tables import reported

SMALL = ["depth.planes=48", "depth.near=1.0", "depth.far=6.0"]


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    folder = tmp_path_factory.mktemp("scene")
    return scene_capture(weak_room(views=3), folder, width=192)


def test_a_chain_runs_the_dense_stages_with_true_poses(capture: Capture) -> None:
    run = DenseChain("known_poses", overrides=SMALL).run(capture)
    assert list(run.range_maps) == ["depth", "checked", "sky", "smooth"]
    assert all(list(step) == list(capture.panoramas) for step in run.range_maps.values())
    name = next(iter(capture.panoramas))
    raw, final = (score_view(run.range_maps[step][name], capture.ranges[name]) for step in ("depth", "smooth"))
    assert raw.filled.w_delta_105 > 0.4
    assert raw.consistent.completeness == 0
    assert final.consistent.completeness > 0.2
    assert all(seconds >= 0 for seconds in run.cpu_s.values())
    assert (
        len(line("x", measure(DenseChain("known_poses", overrides=SMALL), capture, references=1), outdoor=False)) > 40
    )


def test_overrides_reach_the_stages(capture: Capture) -> None:
    chain = DenseChain("known_poses", overrides=[*SMALL, "depth.far=1.5"])
    chain.dense = ["depth"]
    near = chain.run(capture, references=["000.png"])
    assert list(near.range_maps["depth"]) == ["000.png"]
    assert np.nanmax(near.range_maps["depth"]["000.png"].range) <= 1.6


def test_skies_are_counted() -> None:
    truth = np.full((4, 8), 2.0, np.float32)
    truth[:2] = np.nan
    found = RangeMap(np.full((4, 8), 2.0, np.float32), np.full((4, 8), 130, np.uint8))
    found.confidence[0, :4] = 63
    found.confidence[1, :4], found.range[1, :4] = 0, np.nan
    scores = score_view(found, truth, scale=1.0)
    assert (scores.sky_seen, scores.sky_filled) == (0.5, 0.75)
    assert scores.filled.psnr_db == np.inf
    assert depth_metrics(found.range, truth).completeness == 1


def test_a_capture_on_disk_is_the_scene(tmp_path: Path, capture: Capture) -> None:
    write_scene(tmp_path, weak_room(views=3), (96, 192))
    read = read_capture(tmp_path)
    assert list(read.panoramas) == list(capture.panoramas)
    for name, ranges in capture.ranges.items():
        np.testing.assert_array_equal(read.ranges[name], ranges)
        np.testing.assert_array_equal(read.panoramas[name].load(), capture.panoramas[name].load())
        np.testing.assert_allclose(read.poses[name].translation, capture.poses[name].translation, atol=1e-12)
    half = read_capture(tmp_path, width=96).first(2)
    assert [panorama.load().shape for panorama in half.panoramas.values()] == [(48, 96, 3)] * 2
    assert all(ranges.shape == (48, 96) for ranges in half.ranges.values())


def test_the_papers_figures_stand_where_they_belong() -> None:
    assert reported("classroom", 4, 7, "estimated") == "0.193 / 27.18"
    assert reported("smallroom", 2, 9, "estimated") == "21.27"
    assert reported("smallroom", 2, 9, "known") == reported("court", 4, 7, "known") == "–"


def test_quickstart_gives_a_plain_ceiling_its_plane(tmp_path: Path) -> None:
    """With census alone, plain surfaces win at chance ranges, and no plane fits them."""
    room = scene_capture(white_room(views=3, seed=12), tmp_path, width=192)
    name = "000.png"
    run = StoredChain("quickstart", overrides=["depth.planes=64"]).run(room, label="room", references=[name])
    found, truth = run.range_maps["planes"][name], room.ranges[name]
    above = (ray_grid((96, 192)) @ room.poses[name].rotation)[..., 1] < -0.7
    assert (np.abs(found.range / truth - 1) < 0.05)[above].mean() > 0.6
