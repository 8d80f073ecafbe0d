"""The benchmark of whole captures: its figures, what counts as worse, and that each capture is compared."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pano_mvs.geometry import Rigid3
from pano_mvs.scene import FilePart, Panorama, Poses
from tests.algorithms.poses.synthetic_capture import random_poses
from tools.benchmarks import whole
from tools.benchmarks.captures import Capture
from tools.benchmarks.whole import BEST, CAPTURES, RULES, SCENES, figures, main, prepared, worse_figures

BASE = {
    "right": 9,
    "silent": 0,
    "false": 1,
    "pair_deg": 0.04,
    "within_5": 0.9,
    "psnr_db": 30.0,
    "missing": 0.0,
    "cpu_ratio": 3.0,
}


def capture_of(poses: dict[str, Rigid3], ranges: dict[str, np.ndarray]) -> Capture:
    panoramas = {name: Panorama(FilePart(Path(name)), (8, 16), (8, 16)) for name in poses}
    return Capture("any", panoramas, poses, ranges)


def poses_of(cameras: dict[str, Rigid3], **more: Any) -> Poses:
    return replace(Poses.without_points(cameras, frame="any", scale="any", metric=False), **more)


def test_figures_count_cameras_and_what_has_a_range() -> None:
    truth = random_poses(np.random.default_rng(0), 5)
    first, second, wrong, *_ = truth
    true = {name: np.full((8, 16), 2.0, np.float32) for name in truth}
    for each in true.values():
        each[:, :4] = 30.0  # farther than what is scored
    scale = 0.5  # of the estimates
    cameras = {name: Rigid3.from_center(pose.rotation, scale * pose.center) for name, pose in truth.items()}
    found = {name: scale * each for name, each in true.items()}
    found[first] = 1.1 * found[first]
    found[second][:, 4:8] = np.nan
    found[wrong][:, :4] = 1.0
    doubted = poses_of(cameras, doubts={first: "any"})
    result = figures(doubted, found, capture_of(truth, true))
    assert (result["right"], result["silent"], result["false"]) == (5, 0, 1)
    assert result["pair_deg"] == pytest.approx(0, abs=1e-5)
    assert result["within_5"] == pytest.approx(4 / 5)
    assert result["missing"] == pytest.approx(1 / 3 / 5)
    off = {wrong: Rigid3.from_center(cameras[wrong].rotation, cameras[wrong].center + 20)}
    misplaced = figures(poses_of(cameras | off), found, capture_of(truth, true))
    assert (misplaced["right"], misplaced["silent"], misplaced["false"]) == (4, 1, 0)
    assert misplaced["within_5"] == pytest.approx(result["within_5"])  # it does not change the scale of the others


def test_without_poses_there_are_no_right_cameras_and_no_errors() -> None:
    truth = random_poses(np.random.default_rng(0), 3)
    result = figures(None, {}, capture_of(truth, {}))
    assert result == {"right": 0, "silent": 0, "false": 0}
    assert len(worse_figures(result, BASE)) == len(RULES) - 2  # none is wrong or doubted


@pytest.mark.parametrize(
    ("name", "worse", "as_good"),
    [
        ("right", 8, 9),
        ("silent", 1, 0),
        ("false", 2, 1),
        ("pair_deg", 0.047, 0.0459),
        ("within_5", 0.894, 0.8951),
        ("psnr_db", 29.7, 29.81),
        ("missing", 0.003, 0.002),
        ("cpu_ratio", 3.4, 3.29),
        ("psnr_db", float("nan"), 40.0),
    ],
)
def test_a_figure_is_worse_beyond_its_tolerance(name: str, worse: float, as_good: float) -> None:
    assert [each.split(f" {worse:{RULES[name].form}},")[0] for each in worse_figures(BASE | {name: worse}, BASE)] == [
        RULES[name].label
    ]
    assert worse_figures(BASE | {name: as_good}, BASE) == []


def test_best_figures_are_those_of_captures_that_exist() -> None:
    best = json.loads(BEST.read_text(encoding="utf-8"))
    assert {*best} <= {*CAPTURES}
    assert all(row.keys() == RULES.keys() for row in best.values())


@pytest.mark.parametrize("name", SCENES)
def test_a_scene_has_room_for_its_views(name: str) -> None:
    scene = SCENES[name]()
    assert len(scene.poses) == {"colonnade": 24, "hall": 9, "street": 14}[name]


def test_a_scene_is_rendered_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(whole, "WIDTH", 32)
    scene = SCENES["hall"]()
    monkeypatch.setitem(SCENES, "hall", lambda: replace(scene, poses=scene.poses[:2]))
    folder, capture = prepared("hall", tmp_path)
    assert sorted(path.name for path in (folder / "images").iterdir()) == ["000.png", "001.png"]
    assert capture.poses.keys() == capture.ranges.keys() == {"000.png", "001.png"}
    monkeypatch.setitem(SCENES, "hall", pytest.fail)
    assert prepared("hall", tmp_path)[1].poses.keys() == capture.poses.keys()
    assert [path.name for path in tmp_path.iterdir()] == ["hall"]


def test_the_sample_is_not_copied(tmp_path: Path) -> None:
    folder, capture = prepared("classroom", tmp_path)
    assert len(capture.poses) == len(list((folder / "images").iterdir())) == 4
    assert not list(tmp_path.iterdir())


def test_worse_figures_and_failed_runs_are_reported_and_best_ones_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    best = tmp_path / "best.json"
    best.write_text(json.dumps({"hall": BASE, "street": BASE}))
    monkeypatch.setattr(whole, "BEST", best)

    def measured(name: str, out: Path) -> tuple[dict[str, float], float, float]:
        if name == "street":
            raise SystemExit("no disk")
        return BASE | {"psnr_db": 31.004 if name == "classroom" else 20.0}, 3.0, 2.0

    monkeypatch.setattr(whole, "measured", measured)
    assert main(["hall", "street", "classroom"], tmp_path) == 1
    said = capsys.readouterr().out
    assert "| hall | 9 | 0 | 1 | 0.0400 | 0.9000 | 20.00 | 0.0000 | 3.00 | 3 | 2 |" in said
    assert "worse: hall: PSNR dB 20.00, best 30.00\n" in said
    assert "street: the run failed.\n\nno disk" in said
    assert "classroom has no best figures yet" in said
    assert main(["classroom"], tmp_path, write=True) == 0
    assert json.loads(best.read_text()) == {"hall": BASE, "street": BASE, "classroom": BASE | {"psnr_db": 31.0}}
    capsys.readouterr()
    assert main(["classroom"], tmp_path) == 0
    assert "Nothing is worse." in capsys.readouterr().out


def test_unknown_captures_are_refused(tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="there is no capture garden; there are classroom, colonnade"):
        main(["hall", "garden"], tmp_path)
