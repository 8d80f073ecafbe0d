"""The workflow of the paper, PatchMatch, and cropped panoramas."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest

from pano_mvs.algorithms.poses.frame.metric_scale import unit_translations
from pano_mvs.geometry import Rigid3, rotation_from_rotvec
from pano_mvs.io.ply import read_ply
from pano_mvs.io.ranges import read_range_tiff
from pano_mvs.scene import Poses
from pano_mvs.testing.room import capture_poses
from tests.cli.conftest import SIZE_HW, SMALL, Command, run_json
from tests.cli.truth import constant_errors, pose_errors, range_errors
from tests.io.images.pictures import png_chunk, xmp
from tests.stored import read_picture

FAITHFUL = """\
pano_mvs: 1
stages:
  images:   {{use: source.folder, path: "{images}"}}
  features: {{use: features.sphorb, max_keypoints: 3000}}
  pairs:    {{use: pairs.exhaustive}}
  matches:
    {{use: matches.brute_force, ratio: 0.75, mutual: false, solver: eight_point, refine: false, threshold_deg: 1}}
  poses:    {{use: poses.scaled_translation, scale_estimator: kappa, kappa: 0.01, adjust: false}}
  colmap:   {{use: export.colmap}}
"""


@pytest.fixture
def faithful(capture: Path, tmp_path: Path) -> Path:
    workflow = tmp_path / "paper_poses.yaml"
    workflow.write_text(FAITHFUL.format(images=capture / "images"))
    return workflow


@pytest.mark.slow
def test_a_workflow_can_say_what_the_paper_does(faithful: Path, tmp_path: Path, pano_mvs: Command) -> None:
    outcome = pano_mvs("run", faithful, "--out", tmp_path / "out")
    assert outcome.code in (0, 3), outcome.text  # 3: the paper's poses are not adjusted, so one may be doubtful
    summary = run_json(tmp_path / "out")
    found = np.array(summary["poses"]["centers"])
    true = np.array([pose.center for pose in capture_poses(4, spread=0.4)])
    np.testing.assert_allclose(found, true / np.linalg.norm(true[1]), atol=0.05)
    stages = {stage["name"]: stage for stage in summary["stages"]}
    assert stages["poses"]["params"]["adjust"] is False
    metrics = stages["matches"]["metrics"]
    assert metrics["inliers"] > 100
    assert 0 < metrics["residual_deg"] < 1
    assert 0 < metrics["direction_std_deg"] < 1
    assert metrics["parallax_deg"] > 2


FEW_PLANES = ("--set", "features.max_keypoints=3000", "--set", "depth.planes=48")


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cache for all runs of the paper's workflow, so that its stages are computed once."""
    return tmp_path_factory.mktemp("cache")


@pytest.fixture
def run(rendered: Path, pano_mvs: Command, cache: Path) -> Callable[..., dict[str, Any]]:
    def call(*overrides: str, out: str = "out") -> dict[str, Any]:
        options = [part for override in overrides for part in ("--set", override)]
        result = pano_mvs(
            *f"run paper --images {rendered / 'images'} --out {out} --cache {cache}".split(),
            *f"--set scores.truth={rendered / 'truth'}".split(),
            *FEW_PLANES,
            *options,
        )
        assert result.code in (0, 3), result.text  # 3: a pose that is not adjusted may be doubtful
        return run_json(Path(out))

    return call


@pytest.mark.slow
def test_the_papers_way_from_pictures_to_ranges(run: Callable[..., dict[str, Any]], rendered: Path) -> None:
    summary = run()
    params = {stage["name"]: stage["params"] for stage in summary["stages"]}
    assert params["depth"]["spacing"] == "uniform"
    assert (params["depth"]["near"], params["depth"]["far"]) == (0.05, 10)
    assert (params["depth"]["cost"], params["depth"]["window"], params["depth"]["selection"]) == ("sad", 7, "winner")
    constants = constant_errors(rendered / "truth")
    for name, errors in range_errors(Path("out"), rendered / "truth").items():
        # Ranges of a plane sweep over uniform hypotheses are coarse far away; no constant comes near them all the same.
        assert errors.psnr_db > max(constant.psnr_db for constant in constants[name]) + 4, name
        assert errors.mae < 0.65 * min(constant.mae for constant in constants[name]), name
        assert errors.near > max(constant.near for constant in constants[name]), name
        assert errors.median < 0.16, name
    for name in ("000", "003"):
        ranges = read_range_tiff(Path("out") / f"range/{name}.tiff")
        assert ranges.shape == SIZE_HW
        assert np.nanmin(ranges) >= 0.05
        assert np.nanmax(ranges) <= 10


@pytest.mark.slow
def test_each_ablation_is_one_switch(run: Callable[..., dict[str, Any]], rendered: Path) -> None:
    full = run()
    unscaled = run("unscaled.enabled=true", out="unscaled")
    lengths = [np.linalg.norm(center) for center in unscaled["poses"]["centers"]]
    np.testing.assert_allclose(lengths, [0, 1, 1, 1], atol=1e-9)
    assert np.ptp(np.linalg.norm(full["poses"]["centers"], axis=1)[1:]) > 0.01
    plain = run("depth.prefilter_diameter=0", "depth.derotate=false", "smooth.keep_confidence=1", out="plain")
    stages = {stage["name"]: stage["params"] for stage in plain["stages"]}
    assert (stages["depth"]["prefilter_diameter"], stages["smooth"]["keep_confidence"]) == (0, 1)
    truth = rendered / "truth"
    runs = [range_errors(Path(out), truth)["000"].psnr_db for out in ("out", "unscaled", "plain")]
    assert len(set(runs)) == 3
    wrong = [pose_errors(Path(out), truth).scale_ratio_max for out in ("out", "unscaled")]
    assert wrong[0] < 0.5 * wrong[1]


def test_without_scale_factors_directions_and_rotations_stay() -> None:
    rng = np.random.default_rng(0)
    cameras = {
        f"{idx}": Rigid3.from_center(rotation_from_rotvec(rng.normal(size=3)), rng.normal(size=3) * (idx > 0) + 5)
        for idx in range(4)
    }
    poses = Poses.without_points(cameras, rejected={"x": "why"}, frame="f", scale="s", metric=True)
    moved = unit_translations(poses)
    np.testing.assert_allclose(moved.rotations, poses.rotations)
    offsets, before = moved.centers - 5, poses.centers - 5
    np.testing.assert_allclose(np.linalg.norm(offsets[1:], axis=1), 1)
    np.testing.assert_allclose(offsets[1:], before[1:] / np.linalg.norm(before[1:], axis=1, keepdims=True))
    assert (moved.rejected, moved.metric) == ({"x": "why"}, False)


WORKFLOW = """\
pano_mvs: 1
stages:
  images:   {use: source.folder, path: capture/images}
  poses:    {use: poses.from_model, path: capture/truth/poses.json}
  views:    {use: views.nearest, sources: 3}
  depth:    {use: depth.sweep, planes: 32, near: 0.5, far: 6}
  refined:  {use: depth.patchmatch, rounds: 2}
  checked:  {use: filters.consistency}
  exported: {use: export.ranges}
  colmap:   {use: export.colmap}
"""


@pytest.mark.slow
def test_refinement_makes_more_pixels_consistent_and_all_more_precise(capture: Path, pano_mvs: Command) -> None:
    path = capture.parent / "planes.yaml"
    views, errors = {}, {}
    for name, text in {"with": WORKFLOW, "without": WORKFLOW.replace("  refined:", "  # ")}.items():
        path.write_text(text)
        out = capture.parent / name
        outcome = pano_mvs("run", path, "--out", out)
        assert outcome.code == 0, outcome.text
        views[name] = {view["name"]: view for view in run_json(out)["views"]}
        errors[name] = range_errors(out, capture / "truth")
    assert len(views["with"]) == len(errors["with"]) == 4
    for name, view in views["with"].items():
        assert view["consistent"] > views["without"][name]["consistent"]
        after, before = (errors[way][Path(name).stem].median for way in ("with", "without"))
        assert after < 0.6 * before


LEFT, TOP, WIDTH, HEIGHT = 20, 18, 290, 121


def cut(path: Path, *, half: bool = False) -> None:
    """Leave a part of a panorama in its file, with the metadata that say so."""
    part = read_picture(path)[TOP : TOP + HEIGHT, LEFT : LEFT + WIDTH]
    if half:
        part = cv2.resize(part, (WIDTH // 2, round(HEIGHT / 2)), interpolation=cv2.INTER_AREA)
    packet = xmp(
        {
            "FullPanoWidthPixels": SIZE_HW[1],
            "FullPanoHeightPixels": SIZE_HW[0],
            "CroppedAreaImageWidthPixels": WIDTH,
            "CroppedAreaImageHeightPixels": HEIGHT,
            "CroppedAreaLeftPixels": LEFT,
            "CroppedAreaTopPixels": TOP,
        }
    )
    data = bytes(cv2.imencode(".png", part)[1])
    path.write_bytes(data[:33] + png_chunk(b"iTXt", b"XML:com.adobe.xmp\0\0\0\0\0" + packet) + data[33:])


@pytest.mark.slow
def test_cropped_and_masked_panoramas_from_files_to_cloud(pano_mvs: Command, capture: Path) -> None:
    pictures = sorted((capture / "images").iterdir())
    for idx, path in enumerate(pictures):
        cut(path, half=idx == 3)
    poses = json.loads((capture / "truth" / "poses.json").read_text())
    for view in poses["views"]:
        view.pop("sha256", None)  # of the whole pictures
    (capture / "truth" / "poses.json").write_text(json.dumps(poses))
    (capture / "drawn").mkdir()
    of_picture = np.full((HEIGHT, WIDTH), 255, np.uint8)
    of_picture[30:60, 100:140] = 0
    of_sphere = np.full(SIZE_HW, 255, np.uint8)
    of_sphere[TOP + 30 : TOP + 60, LEFT + 100 : LEFT + 140] = 0
    cv2.imwrite(str(capture / "drawn" / "000.png.png"), of_picture)
    cv2.imwrite(str(capture / "drawn" / "001.png"), of_sphere)
    result = pano_mvs(
        *f"run known_poses --images {capture / 'images'} --out out".split(),
        *SMALL,
        *f"--set depth.planes=64 --set poses.path={capture / 'truth' / 'poses.json'}".split(),
        *f"--set scores.truth={capture / 'truth'} --set images.masks={capture / 'drawn'}".split(),
    )
    assert result.code == 0, result.text
    assert "fields count the original's pixels" in result.flat
    cameras = pycolmap.Reconstruction("out/colmap/sparse/0").cameras.values()
    assert {(camera.model.name, camera.width, camera.height) for camera in cameras} == {("EQUIRECTANGULAR", 320, 160)}
    inside = np.zeros(SIZE_HW, np.bool_)
    inside[TOP : TOP + HEIGHT, LEFT : LEFT + WIDTH] = True
    with np.load(capture / "truth" / "depth.npz") as file:
        truth = {path.stem: file[path.stem] for path in pictures}
    for idx, path in enumerate(pictures[:3]):
        ranges = read_range_tiff(Path(f"out/range/{path.stem}.tiff"))
        seen = inside & ((of_sphere > 0) if idx < 2 else True)
        assert ranges.shape == SIZE_HW
        assert np.isnan(ranges[~seen]).all()
        with np.errstate(invalid="ignore"):
            right = np.abs(ranges / truth[path.stem] - 1) < 0.05
        assert right[seen].mean() > 0.75, right[seen].mean()
    assert read_range_tiff(Path("out/range/003.tiff")).shape == (SIZE_HW[0] // 2, SIZE_HW[1] // 2)
    assert len(read_ply(Path("out/cloud.ply"))) > 1000
