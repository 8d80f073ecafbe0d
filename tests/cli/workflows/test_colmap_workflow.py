"""COLMAP's mappers in a workflow, and new pictures against known poses, from pictures to poses."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from pano_mvs.geometry.pose_errors import PoseErrors, relative_pose_errors
from pano_mvs.io.colmap.reader import read_colmap_model
from pano_mvs.io.poses.json_files import read_posed_views
from tests.cli.conftest import SIZE_HW, SMALL, Command, run_json

POSES_ONLY = """\
pano_mvs: 1
stages:
  images: {{use: source.folder, path: {images}, masks: {masks}}}
{poses}
  colmap: {{use: export.colmap}}
"""
MATCHED = """\
  features: {use: features.sift_tangent, max_keypoints: 1500}
  pairs: {use: pairs.exhaustive}
  matches: {use: matches.brute_force}
"""


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One store for all tests, so that key points and matches are computed once."""
    return tmp_path_factory.mktemp("cache")


def workflow(folder: Path, capture: Path, poses: str) -> Path:
    """A workflow that ends with the poses, their export and their scores."""
    masks = folder / "masks"
    masks.mkdir(exist_ok=True)
    valid = np.full(SIZE_HW, 255, np.uint8)
    valid[-20:] = 0
    for path in (capture / "images").iterdir():
        cv2.imwrite(str(masks / f"{path.name}.png"), valid)
    path = folder / "poses.yaml"
    path.write_text(POSES_ONLY.format(images=capture / "images", masks=masks, poses=poses))
    return path


def errors(out: Path, capture: Path) -> PoseErrors:
    """The errors of the exported model."""
    model = read_colmap_model(out / "colmap/sparse/0")
    found = {name: model.cam_from_world(idx) for idx, name in enumerate(model.names)}
    views, _ = read_posed_views(capture / "truth" / "poses.json")
    return relative_pose_errors(found, {Path(view.name).name: view.cam_from_world for view in views})


@pytest.mark.slow
def test_colmap_preset_runs_from_pictures_to_cloud(pano_mvs: Command, rendered: Path) -> None:
    arguments = ("colmap", "--images", rendered / "images", "--out", "o", *SMALL)
    result = pano_mvs("run", *arguments, "--set", f"scores.truth={rendered / 'truth'}")
    assert result.code == 0, result.text
    poses = errors(Path("o"), rendered)
    assert poses.registered == 4
    assert poses.median_pair_deg < 0.3
    assert Path("o/cloud.ply").exists()
    model = read_colmap_model(Path("o/colmap/sparse/0"))
    assert len(model.names) == 4
    assert len(model.points_in_world) > 50


@pytest.mark.parametrize(
    ("solver", "most_deg"),
    [
        (f"{MATCHED}  poses: {{use: poses.colmap, mapper: incremental}}", 0.3),
        pytest.param(
            f"{MATCHED}  poses: {{use: poses.colmap, mapper: global, cameras: faces}}", 0.3, marks=pytest.mark.slow
        ),
        pytest.param("  poses: {use: poses.colmap_sift}", 1, marks=pytest.mark.slow),
    ],
    ids=["incremental", "global", "sift"],
)
def test_every_mode_registers_all(
    pano_mvs: Command, rendered: Path, cache: Path, tmp_path: Path, solver: str, most_deg: float
) -> None:
    result = pano_mvs("run", workflow(tmp_path, rendered, solver), "--out", "o", "--cache", cache)
    assert result.code == 0, result.text
    found = errors(Path("o"), rendered)
    assert found.registered == 4
    assert found.median_pair_deg < most_deg


@pytest.mark.parametrize("solver", ["poses.extend, path", "poses.colmap, fixed"])
def test_a_new_picture_joins_known_poses_that_stay(
    solver: str, pano_mvs: Command, rendered: Path, cache: Path, tmp_path: Path
) -> None:
    data = json.loads((rendered / "truth" / "poses.json").read_text())
    known = tmp_path / "known.json"
    known.write_text(json.dumps(data | {"views": data["views"][:3]}))
    path = workflow(tmp_path, rendered, f"{MATCHED}  poses: {{use: {solver}: {known}}}")
    result = pano_mvs("run", path, "--out", "o", "--cache", cache)
    assert result.code == 0, result.text
    found = errors(Path("o"), rendered)
    assert found.registered == 4
    assert found.median_pair_deg < 0.3
    summary = run_json(Path("o"))["poses"]
    assert summary["metric"] is True
    for center, view in zip(summary["centers"], data["views"][:3], strict=False):
        assert center == pytest.approx(-np.transpose(view["R"]) @ np.array(view["t"]), abs=1e-12)


def test_the_global_mapper_holds_nothing_fixed(pano_mvs: Command, rendered: Path, cache: Path, tmp_path: Path) -> None:
    known = rendered / "truth" / "poses.json"
    path = workflow(tmp_path, rendered, f"{MATCHED}  poses: {{use: poses.colmap, mapper: global, fixed: {known}}}")
    result = pano_mvs("run", path, "--out", "o", "--cache", cache)
    assert result.code == 2
    assert "use mapper: incremental" in result.flat
