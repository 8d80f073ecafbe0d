"""Finished runs are put into metres from their cache."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import pano_mvs
from pano_mvs.api import Context, InputError, PointCloud, Poses, UsageError
from pano_mvs.cli.scale_command import scale_output
from pano_mvs.geometry import Rigid3
from pano_mvs.results.records import PoseGroup, PosesSummary
from pano_mvs.results.run_output import load
from pano_mvs.results.stored_values import StoredValues
from pano_mvs.scene import Pose, RangeMap
from pano_mvs.scene.pose_groups import join_groups
from pano_mvs.scene.surfaces import Structure
from pano_mvs.session.running import Execution, run_session
from pano_mvs.session.scaling import (
    lost_scale,
    measured_between,
    measured_camera_height,
    metres_from_text,
    scaled_session,
)
from pano_mvs.session.session import Session, open_session
from pano_mvs.session.summarise import _scale_notes, camera_height, height_note
from pano_mvs.stages.depth_planes import scale_planes
from pano_mvs.stages.filters import ScaleRangesParams, scale_ranges
from pano_mvs.stages.fusion import ScaleCloudParams, scale_cloud
from pano_mvs.stages.poses_frame import ScaleParams, scale
from pano_mvs.testing.tiny_capture import Variant, tiny_capture
from tests.io.test_ply import vertices
from tests.synthetic.floor_plan_rooms import room_cloud, the_cloud, the_poses

WORKFLOW = """
pano_mvs: 1
name: tiny
stages:
  images: {{use: source.folder, path: {images}}}
  poses:  {{use: poses.from_model, path: {poses}}}
  views:  {{use: views.nearest, sources: 2}}
  depth:  {{use: depth.sweep, planes: 8, near: 0.5, far: 8}}
  smooth: {{use: filters.median}}
  cloud:  {{use: fusion.vote, min_views: 1}}
  ply:    {{use: export.ply}}
  ranges: {{use: export.ranges}}
  colmap: {{use: export.colmap}}
"""


@pytest.fixture
def run(made: Path, tmp_path: Path) -> pano_mvs.RunOutput:
    """A run of a tiny capture whose unit is unknown."""
    shutil.copytree(made / "out", tmp_path / "out")
    return load(tmp_path / "out")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    tmp_path = tmp_path_factory.mktemp("tiny")
    capture = tiny_capture(Variant((32, 64)))
    views = [
        {"image": name, "R": pose.rotation.tolist(), "t": pose.translation.tolist()}
        for name, pose in zip(capture.names, capture.poses, strict=True)
    ]
    (tmp_path / "known.json").write_text(json.dumps({"metric": False, "views": views}))
    text = WORKFLOW.format(images=capture.folder / "images", poses=tmp_path / "known.json")
    (tmp_path / "tiny.yaml").write_text(text)
    pano_mvs.run(tmp_path / "tiny.yaml", out=tmp_path / "out", cache=tmp_path / "cache", executor="serial")
    return tmp_path


def scaled(run: pano_mvs.RunOutput, first: str, second: str, metres: float) -> pano_mvs.RunOutput:
    session = scaled_session(run, measured_between(run, first, second, metres=metres))
    return run_session(session, Execution(executor="serial"))


def test_all_results_are_scaled_together_and_nothing_dense_runs_again(run: pano_mvs.RunOutput) -> None:
    before = vertices(run.out / "cloud.ply")
    ranges = run.views["000.png"].range_map
    assert run.poses is not None
    assert ranges is not None
    length = float(np.linalg.norm(run.poses.centers[1] - run.poses.centers[0]))
    after = scaled(run, "000", "001.png", 5.0)
    factor = 5.0 / length
    assert after.ok
    assert after.poses is not None
    assert np.linalg.norm(after.poses.centers[1] - after.poses.centers[0]) == pytest.approx(5.0)
    np.testing.assert_allclose(vertices(after.out / "cloud.ply"), before * factor, rtol=1e-5)
    now = after.views["000.png"].range_map
    assert now is not None
    np.testing.assert_allclose(now, ranges * factor, rtol=1e-5)
    assert after.summary.poses.metric
    assert after.summary.poses.scale == "metres, by the distance of 5 m from 000.png to 001.png"
    units = {stage.name: (stage.run, stage.cached) for stage in after.summary.stages}
    assert units["depth"][0] == units["smooth"][0] == units["cloud"][0] == 0
    assert units["metres_cloud"] == (1, 0)
    # The exported files agree: they are read without the cache.
    files = replace_values(load(after.out))
    assert files.poses is not None
    assert files.cloud is not None
    np.testing.assert_allclose(files.poses.centers, after.poses.centers, atol=1e-6)
    assert after.cloud is not None
    np.testing.assert_array_equal(files.cloud.points_in_world, after.cloud.points_in_world)


def replace_values(run: pano_mvs.RunOutput) -> pano_mvs.RunOutput:
    return pano_mvs.RunOutput(run.out, run.summary, StoredValues())


@pytest.mark.slow
def test_a_second_measurement_corrects_the_first_and_the_workflow_can_be_run(run: pano_mvs.RunOutput) -> None:
    first = scaled(run, "000.png", "001.png", 5.0)
    second = scaled(first, "000.png", "001.png", 4.0)
    assert second.poses is not None
    assert np.linalg.norm(second.poses.centers[1] - second.poses.centers[0]) == pytest.approx(4.0)
    assert [stage.name for stage in second.summary.stages] == [stage.name for stage in first.summary.stages]
    again = pano_mvs.run(run.out / "metres.yaml", out=run.out, cache=run.summary.cache, executor="serial")
    assert (again.summary.units.run, again.summary.workflow.name) == (0, "tiny")


def test_the_command_takes_points_and_lengths(
    run: pano_mvs.RunOutput, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from pano_mvs.cli.console import Console

    seen: list[Session] = []

    def keep(session: Session, _: Execution) -> int:
        seen.append(session)
        return 0

    monkeypatch.setattr("pano_mvs.cli.scale_command.run_workflow", keep)
    ends = ("-1,0,0.5", "1,0,0.5", "300cm")
    assert scale_output(run.out, ends, camera_height="", group=0, cache=None, console=Console()) == 0
    assert seen[0].workflow.stages["metres_poses"].params.model_dump()["factor"] == pytest.approx(1.5)
    assert "one unit is 1.5 m" in capsys.readouterr().out
    assert (run.out / "metres.yaml").read_text().startswith("pano_mvs: 1\nname: tiny\n")
    parted = ("-1,0,0.5", "1,0,0.5", "300", "cm")  # as a shell passes 300 cm without quotes
    scale_output(run.out, parted, camera_height="", group=0, cache=None, console=Console())
    assert seen.pop().workflow.stages["metres_poses"].params.model_dump()["factor"] == pytest.approx(1.5)
    capsys.readouterr()
    scale_output(run.out, (), camera_height="", group=0, cache=None, console=Console())
    assert "one unit is" in capsys.readouterr().out
    assert len(seen) == 1
    for known, height, message in (
        (("000.png", "1m"), "", "two images, or two points"),
        (("000.png", "000.png", "1m"), "", "in the same place"),
        (("000.png", "nothing", "1m"), "", "not one registered image"),
        (("000.png", "001.png", "one"), "", "is not a length"),
        (("000.png", "001.png", "1m"), "1.6", "either two ends"),
        ((), "1.6m", "no floor was found"),
    ):
        with pytest.raises(UsageError, match=message):
            scale_output(run.out, known, camera_height=height, group=7, cache=None, console=Console())


@pytest.mark.parametrize("preset", ["colmap_dense", "mesh", "quality", "quickstart"])
def test_what_reads_planes_after_the_cloud_gets_scaled_ones(run: pano_mvs.RunOutput, preset: str) -> None:
    workflow = run.summary.workflow.model_copy(update={"path": f"workflows/{preset}.yaml", "overrides": ()})
    moved = pano_mvs.RunOutput(run.out, run.summary.model_copy(update={"workflow": workflow}), run.values)
    session = scaled_session(moved, measured_between(run, "000", "001", metres=5.0))
    made = {name: entry.spec.output for name, entry in session.workflow.stages.items()}
    readers = [name for name, edges in session.graph.edges.items() for edge in edges.values()
               if edge.producer == "metres_scene_planes"]  # fmt: skip
    # A plugin brings export.floor_plan.
    expected = ["textured", "floor_plan"] if "export.floor_plan" in session.registry.stages else ["textured"]
    assert readers == (expected if preset == "mesh" else [])
    assert ("metres_scene_planes" in made) == bool(readers)


def test_a_run_whose_workflow_is_gone_names_it(run: pano_mvs.RunOutput) -> None:
    gone = run.summary.workflow.model_copy(update={"path": "gone/tiny.yaml"})
    moved = pano_mvs.RunOutput(run.out, run.summary.model_copy(update={"workflow": gone}), run.values)
    with pytest.raises(UsageError, match=r"tiny\.yaml is not there"):
        scaled(moved, "000.png", "001.png", 1.0)


@pytest.mark.parametrize(
    ("text", "metres"),
    [("3.42m", 3.42), ("342 cm", 3.42), ("3420mm", 3.42), ("2", 2), ("10ft", 3.048), ("10 IN", 0.254)],
)
def test_lengths_have_units(text: str, metres: float) -> None:
    assert metres_from_text(text) == pytest.approx(metres)


@pytest.mark.parametrize("text", ["", "0", "-1m", "1 km", "nan", "1e3", "m"])
def test_what_is_no_length_is_refused(text: str) -> None:
    with pytest.raises(UsageError, match="is not a length"):
        metres_from_text(text)


def test_a_comma_is_refused_with_a_point() -> None:
    with pytest.raises(UsageError, match=r"write a point, not a comma: 3\.42m"):
        metres_from_text("3,42m")


def test_a_run_that_loses_its_scale_is_noted(run: pano_mvs.RunOutput, made: Path) -> None:
    session = open_session(made / "tiny.yaml", cache=made / "cache", out=run.out)
    assert lost_scale(session) == ""
    (run.out / "metres.yaml").write_text("pano_mvs: 1\n")
    assert "repeat the measurement" in lost_scale(session)
    scaled = replace(session.workflow, path=run.out / "metres.yaml")
    assert lost_scale(replace(session, workflow=scaled)) == ""


def test_the_height_of_the_cameras_is_found_and_offered_but_not_applied() -> None:
    cloud, poses = the_cloud(room_cloud()), the_poses((2, 2, 1.28), (3, 2, 1.28), metric=False)
    height = camera_height(poses, cloud)
    assert height == pytest.approx(1.28, abs=0.02)
    assert "If that was 1.6 m, one unit is 1.25 m" in height_note(1.28)
    group = PoseGroup(camera_height=1.28)
    assert _scale_notes(PosesSummary(groups=(group,))) == (height_note(1.28),)
    assert _scale_notes(PosesSummary(groups=(group,), metric=True)) == ()
    assert _scale_notes(PosesSummary()) == ()
    assert camera_height(poses, PointCloud(*(value[:10] for value in list(vars(cloud).values())[:4]))) is None


@pytest.mark.slow
def test_the_height_does_not_depend_on_the_size_of_the_cloud() -> None:
    """Of a large cloud, only some blocks are read."""
    cloud, poses = the_cloud(room_cloud(density=9000)), the_poses((2, 2, 1.28), metric=False)
    assert len(cloud) > 600_000
    mixed = np.random.default_rng(0).permutation(len(cloud))
    shuffled = PointCloud(*(value[mixed] for value in list(vars(cloud).values())[:4]))
    assert camera_height(poses, shuffled) == pytest.approx(1.28, abs=0.02)


def test_a_measured_height_gives_the_factor(run: pano_mvs.RunOutput) -> None:
    groups = (PoseGroup(camera_height=0.8),)
    poses = run.summary.poses.model_copy(update={"groups": groups})
    known = pano_mvs.RunOutput(run.out, run.summary.model_copy(update={"poses": poses}), run.values)
    assert measured_camera_height(known, metres=1.6).factor == pytest.approx(2)


def test_only_the_chosen_group_is_scaled(tmp_path: Path) -> None:
    ctx = Context(np.random.default_rng(0), tmp_path)
    ranges = RangeMap(np.full((4, 8), 2.0, np.float32), np.full((4, 8), 200, np.uint8))
    settings = ScaleRangesParams(factor=3, group=1)
    assert scale_ranges(ranges, Pose(Rigid3.identity(), 0), settings, ctx).range.max() == 2
    assert scale_ranges(ranges, Pose(Rigid3.identity(), 1), settings, ctx).range.min() == 6
    planes = Structure(np.eye(3)[:2], np.array([1.0, 2.0]), np.full(2, 0.1), np.array([0, 1], np.int32),
                       np.ones((2, 4, 3)), np.array([1, 0], np.int32))  # fmt: skip
    changed = scale_planes(planes, settings, ctx)
    changed.check()
    assert changed.offsets.tolist() == [1, 6]
    assert changed.mirror_corners[:, 0, 0].tolist() == [3, 1]
    one = the_cloud(room_cloud(density=20))
    one = replace(one, uncertainty=np.full(len(one), 0.1, np.float32))
    first, second = scale_cloud(PointCloud.of_groups([one, one]), ScaleCloudParams(factor=3, group=1), ctx).groups()
    np.testing.assert_array_equal(first.points_in_world, one.points_in_world)
    np.testing.assert_array_equal(second.points_in_world, one.points_in_world * np.float32(3))
    assert first.uncertainty is not None
    assert second.uncertainty is not None
    assert second.uncertainty.max() == pytest.approx(0.3)
    assert first.uncertainty.max() == pytest.approx(0.1)
    cameras = [{f"{prefix}{idx}": Rigid3(np.eye(3), np.array([idx, 0.0, 0])) for idx in range(2)} for prefix in "ab"]
    poses = join_groups([Poses.without_points(each, frame="", scale="one", metric=False) for each in cameras])
    metric = scale(poses, {}, ScaleParams(factor=3, group=1, origin="a tape"), ctx)
    assert [world.metric for world in metric.worlds] == [False, True]
    assert metric.worlds[1].scale == "metres, by a tape"
    with pytest.raises(InputError, match="numbered from 0"):
        scale(poses, {}, ScaleParams(factor=3, group=2), ctx)
