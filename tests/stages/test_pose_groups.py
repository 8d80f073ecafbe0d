"""Two rooms that nothing connects, through every stage that reads poses: each room is treated as if it were alone."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest

from pano_mvs.core.errors import InputError, UsageError
from pano_mvs.engine.stages.context import Context
from pano_mvs.engine.stages.registry import Registry
from pano_mvs.engine.stages.stage import Names
from pano_mvs.scene import PointCloud, Pose, Poses
from pano_mvs.scene.files import FaceFiles
from pano_mvs.scene.pose_groups import join_groups, split_groups
from pano_mvs.scene.surfaces import TrackedPoints
from pano_mvs.stages.depth import PatchMatchParams, SweepParams, exchange, patchmatch, sweep
from pano_mvs.stages.exports.colmap import (
    DenseInitParams,
    DenseParams,
    ModelParams,
    colmap,
    colmap_dense,
    colmap_dense_init,
)
from pano_mvs.stages.exports.mesh import MeshParams, mesh
from pano_mvs.stages.filters import ConsistencyParams, consistency
from pano_mvs.stages.fusion import vote
from pano_mvs.stages.points import tracked
from pano_mvs.stages.poses import known_groups, known_poses
from pano_mvs.stages.poses_frame import BaselineParams, ScaleParams, level, scale
from pano_mvs.testing.tiny_capture import tiny_capture
from tests.synthetic.two_rooms import LARGE, ORDER, SMALL, FusionParams, Rooms, context, fused, placed

TrackedParams = Registry.installed().stages["points.tracked"].params_type
LevelParams = Registry.installed().stages["poses.level"].params_type
ExchangeParams = Registry.installed().stages["depth.exchange"].params_type


@pytest.fixture(scope="module")
def rooms() -> Rooms:
    return Rooms(tiny_capture())


@pytest.fixture
def ctx(tmp_path: Path) -> Context:
    return context(tmp_path / "stage")


def test_each_image_knows_its_group(rooms: Rooms) -> None:
    assert {name: pose.group for name, pose in rooms.pose_items.items()} == {name: int(name in SMALL) for name in ORDER}
    pose = rooms.pose_items["b1.png"]
    assert Pose.from_parts(pose.to_parts()).group == 1
    meta = rooms.pose_items["000.png"].to_parts()["meta"]
    assert isinstance(meta, dict)
    assert "group" not in meta  # as it is stored where there is one group


def test_nothing_of_one_room_enters_the_cloud_of_the_other(rooms: Rooms) -> None:
    cloud = fused(rooms, min_views=3)
    cloud.check()
    assert PointCloud.from_parts(cloud.to_parts()).group_sizes == cloud.group_sizes
    for group, names in zip(cloud.groups(), (LARGE, tuple(SMALL)), strict=True):
        alone = fused(rooms, names, min_views=3)
        assert len(alone) > 100
        assert alone.group_sizes == ()
        np.testing.assert_array_equal(group.points_in_world, alone.points_in_world)
        np.testing.assert_array_equal(group.colors_rgb, alone.colors_rgb)
        np.testing.assert_array_equal(group.view_counts, alone.view_counts)


def test_a_room_without_ranges_keeps_its_number(rooms: Rooms, ctx: Context) -> None:
    ranges = {name: rooms.ranges[name] for name in LARGE}
    cloud = vote(ranges=ranges, poses=rooms.pose_items, images=rooms.images, params=FusionParams(), ctx=ctx)
    assert [len(group) > 0 for group in cloud.groups()] == [True, False]
    assert any(note.startswith("group 1: the cloud is empty") for note in ctx.notes)


def test_a_room_with_too_few_points_has_no_mesh_and_says_so(rooms: Rooms, ctx: Context) -> None:
    large = fused(rooms).groups()[0]
    shorter: dict[str, Any] = {name: value[:5] for name, value in vars(large).items() if isinstance(value, np.ndarray)}
    few = replace(large, **shorter)
    files = mesh(
        cloud=PointCloud.of_groups([large, few]), poses=None, params=MeshParams(depth=4, trim=0), ctx=ctx
    ).files
    assert list(files) == ["mesh.ply"]
    assert ctx.notes[0].startswith("no mesh_1.ply: 5 of 5 points are left")


def _model_images(folder: Path) -> dict[str, np.ndarray]:
    model = pycolmap.Reconstruction(folder)
    return {image.name: image.projection_center() for image in model.images.values()}


def test_known_poses_are_those_of_the_largest_room_and_say_where_the_others_are(
    rooms: Rooms, ctx: Context, tmp_path: Path
) -> None:
    out = placed(
        colmap(poses=rooms.poses, images=rooms.images, photographs=None, params=ModelParams(), ctx=ctx),
        tmp_path / "out",
    )
    known = known_poses(out, (*ORDER, "new.png"))
    assert set(known.names) == set(LARGE)
    assert known.rejected["b0.png"].startswith("out has it in another group, which has a different frame")
    assert known.rejected["new.png"] == "out has no pose for it"
    assert known_poses(out / "colmap" / "sparse" / "1", ORDER).names == tuple(SMALL)
    both = known_groups(out, (*ORDER, "new.png"), [])
    assert [set(group.names) for group in split_groups(both)] == [set(LARGE), set(SMALL)]
    assert both.rejected == {"new.png": "out has no pose for it"}


def test_groups_and_photographs_of_a_file_are_not_lost(tmp_path: Path) -> None:
    """Images of another reconstruction were rejected with "has no pose for it", and a photograph ended the run."""
    panorama, photograph = {"projection_type": "spherical"}, {"projection_type": "perspective"}

    def shot(x: float, camera: str = "p") -> dict[str, object]:
        return {"rotation": [0, 0, 0], "translation": [x, 0, 0], "camera": camera}

    cameras = {"p": panorama, "phone": photograph}
    first = {f"a{idx}.png": shot(idx) for idx in range(3)} | {"b1.png": shot(1, "phone"), "z.png": shot(2, "phone")}
    second = {"b0.png": shot(0), "b2.png": shot(2)}
    same = {"c0.png": shot(1), "c1.png": shot(1)}
    path = tmp_path / "reconstruction.json"
    path.write_text(json.dumps([{"cameras": cameras, "shots": shots} for shots in (second, first, same)]))
    notes: list[str] = []
    known = known_groups(path, ("a0.png", "a1.png", "a2.png", "b0.png", "b1.png", "b2.png", "c0.png"), notes)
    assert [group.names for group in split_groups(known)] == [("a0.png", "a1.png", "a2.png"), ("b0.png", "b2.png")]
    assert known.rejected["b1.png"] == "in reconstruction.json, its camera is perspective, expected spherical"
    (note,) = notes
    assert note.endswith("since only panoramas can be: z.png (its camera is perspective, expected spherical)")


def _tracked(rooms: Rooms, ctx: Context, count: int = 100) -> TrackedPoints:
    params = TrackedParams.model_validate({"count": count, "min_confidence": 1})
    return tracked(poses=rooms.poses, samples=rooms.samples, ranges=rooms.ranges, params=params, ctx=ctx)


def test_tracked_points_are_seen_from_one_room_each(rooms: Rooms, ctx: Context) -> None:
    points = _tracked(rooms, ctx)
    points.check()
    in_small = np.array([name in SMALL for name in points.names])[points.track_image_idx]
    share = np.bincount(points.track_point_idx, in_small) / np.bincount(points.track_point_idx)
    assert set(share) == {0.0, 1.0}
    assert 10 < share.sum() < len(points) - 10
    joined = points.joined_to(rooms.poses, keep_points=True)
    joined.check()
    towards = joined.points_in_world[joined.track_point_idx] - joined.centers[joined.track_image_idx]
    in_cam = np.einsum("nij,nj->ni", joined.rotations[joined.track_image_idx], towards)
    in_cam /= np.linalg.norm(in_cam, axis=1, keepdims=True)
    assert np.median(np.linalg.norm(in_cam - joined.track_bearings, axis=1)) < 0.02


def test_points_that_lose_their_room_are_left_out(rooms: Rooms, ctx: Context) -> None:
    points = _tracked(rooms, ctx)
    third = drawn_room(rooms)
    joined = points.joined_to(third, keep_points=False)
    joined.check()
    assert np.bincount(joined.track_point_idx, minlength=len(joined.points_in_world)).min() > 0


def drawn_room(rooms: Rooms) -> Poses:
    """Return the large room beside another one of which no point is known."""
    large, small = split_groups(rooms.poses)
    return join_groups([large, replace(small, names=("c0.png", "c1.png"))])


def test_splats_begin_with_a_model_of_each_room(rooms: Rooms, tmp_path: Path) -> None:
    points = _tracked(rooms, context(tmp_path / "points"))
    ctx = context(tmp_path / "init")
    files = colmap_dense_init(
        poses=rooms.poses, points=points, images=rooms.images, params=DenseInitParams(keep_sfm=False), ctx=ctx
    )
    out = placed(files, tmp_path)
    sizes = [pycolmap.Reconstruction(out / f"colmap_dense_init/sparse/{number}").num_points3D() for number in range(2)]
    assert sum(sizes) == len(points)
    assert min(sizes) > 10


def test_a_dense_workspace_is_of_the_largest_room(rooms: Rooms, ctx: Context, tmp_path: Path) -> None:
    faces = {name: FaceFiles({}, size_px=12) for name in ORDER}
    files = colmap_dense(
        poses=rooms.poses, faces=faces, images=Names(ORDER), points=None, params=DenseParams(format="bin"), ctx=ctx
    )
    out = placed(files, tmp_path) / "colmap_dense"
    for folder, names in (("sparse", LARGE), ("sparse/0", LARGE), ("sparse/1", SMALL)):
        assert {name.rpartition("_")[0] for name in _model_images(out / folder)} == {Path(name).stem for name in names}
    assert "b0" not in (out / "stereo" / "fusion.cfg").read_text()
    assert any("group 1 (b0.png, b1.png) has its own frame" in note for note in ctx.notes)


def test_each_room_is_levelled_on_its_own(rooms: Rooms, ctx: Context) -> None:
    levelled = level(
        poses=rooms.poses, images=rooms.images, params=LevelParams.model_validate({"evidence": "sensors"}), ctx=ctx
    )
    levelled.check()
    for number, group in enumerate(split_groups(levelled)):
        np.testing.assert_array_equal(group.translations[0], 0)
        ups = np.array([group.rotations[idx].T @ rooms.images[name].up_in_cam for idx, name in enumerate(group.names)])
        np.testing.assert_allclose(ups, np.tile([0, -1, 0], (len(ups), 1)), atol=1e-6)
        assert ctx.notes[number].startswith(f"group {number}: levelled by")


def test_a_camera_that_is_upside_down_unlike_the_others_is_named(rooms: Rooms, ctx: Context) -> None:
    over = np.diag([-1.0, -1.0, 1.0])
    name, images, poses = LARGE[-1], dict(rooms.images), split_groups(rooms.poses)[0]
    idx = poses.names.index(name)
    images[name] = replace(images[name], up_in_cam=tuple(over @ images[name].up_in_cam))
    turned = replace(poses, rotations=poses.rotations.copy(), translations=poses.translations.copy())
    turned.rotations[idx], turned.translations[idx] = over @ poses.rotations[idx], over @ poses.translations[idx]
    level(poses=turned, images=images, params=LevelParams.model_validate({"evidence": "sensors"}), ctx=ctx)
    assert ctx.notes[-1] == f"upside down unlike the others, which the poses allow for: {name}"


def _metres(poses: Poses, first: str, second: str) -> float:
    positions = dict(zip(poses.names, poses.centers, strict=True))
    return float(np.linalg.norm(positions[first] - positions[second]))


def _scaled(rooms: Rooms, ctx: Context, **settings: Any) -> Poses:
    poses = scale(poses=rooms.poses, images=rooms.images, params=ScaleParams(**settings), ctx=ctx)
    poses.check()
    return poses


def test_a_baseline_scales_the_room_that_holds_both_images(rooms: Rooms, ctx: Context) -> None:
    baseline = BaselineParams.model_validate({"from": "b0.png", "to": "b1.png", "metres": 7})
    poses = _scaled(rooms, ctx, baseline=baseline)
    assert [world.metric for world in poses.worlds] == [False, True]
    assert _metres(poses, "b0.png", "b1.png") == pytest.approx(7)
    assert _metres(poses, "000.png", "001.png") == pytest.approx(_metres(rooms.poses, "000.png", "001.png"))
    assert (
        "group 0: keeps its own unit of length (the first reference–neighbour baseline is 1): the length that"
        in ctx.notes[0]
    )
    assert ctx.notes[1].startswith("group 1: unit of length: metres, by the baseline of 7 m")


def test_a_baseline_across_rooms_is_refused(rooms: Rooms, ctx: Context) -> None:
    baseline = BaselineParams.model_validate({"from": "000.png", "to": "b1.png", "metres": 7})
    with pytest.raises(InputError, match=r"000\.png and b1\.png are in groups 0 and 1 .* Use two images of one group"):
        _scaled(rooms, ctx, baseline=baseline)


def test_a_factor_is_of_the_largest_room(rooms: Rooms, ctx: Context) -> None:
    poses = _scaled(rooms, ctx, factor=3)
    assert [world.metric for world in poses.worlds] == [True, False]
    assert _metres(poses, "000.png", "001.png") == pytest.approx(3 * _metres(rooms.poses, "000.png", "001.png"))


def test_gps_scales_every_room_with_positions_enough(rooms: Rooms, ctx: Context) -> None:
    """The small room has two positions, which are too few."""
    poses = _scaled(rooms, ctx, gps=True, gps_noise_m=0.001, vertical="sensors")
    assert [world.metric for world in poses.worlds] == [True, False]
    assert "group 1: keeps its own unit of length (its own): no scale by GPS: 2 of 2 registered" in ctx.notes[1]


def test_a_survey_scales_a_room_by_the_names_in_its_table(rooms: Rooms, ctx: Context, tmp_path: Path) -> None:
    centers = 3 * rooms.poses.centers
    rows = [
        f"{name},{x},{z},{-y}" for name, (x, y, z) in zip(rooms.poses.names, centers, strict=True) if "b" not in name
    ]
    path = tmp_path / "survey.csv"
    path.write_text("\n".join(["filename,easting,northing,height", *rows]))
    poses = _scaled(rooms, ctx, positions=path, gps_noise_m=0.001, vertical="sensors")
    assert [world.metric for world in poses.worlds] == [True, False]
    assert _metres(poses, "000.png", "001.png") == pytest.approx(
        3 * _metres(rooms.poses, "000.png", "001.png"), rel=0.05
    )
    assert "no scale by the positions in survey.csv: 0 of 2 registered panoramas have a position" in ctx.notes[1]


def test_where_no_room_can_be_scaled_the_largest_says_why(rooms: Rooms, ctx: Context) -> None:
    with pytest.raises(InputError, match="no scale by GPS: the positions by GPS lie within"):
        _scaled(rooms, ctx, gps=True, vertical="sensors")


def test_a_camera_height_scales_every_room_with_a_floor(rooms: Rooms, ctx: Context) -> None:
    poses = _scaled(rooms, ctx, camera_height_m=1.5, vertical="sensors")
    assert [world.metric for world in poses.worlds] == [True, True]
    assert _metres(poses, "b0.png", "b1.png") == pytest.approx(
        _metres(rooms.poses, "b0.png", "b1.png")
        * 2
        * _metres(poses, "000.png", "001.png")
        / _metres(rooms.poses, "000.png", "001.png"),
        rel=0.1,
    )


@pytest.mark.parametrize(
    ("function", "extras"),
    [
        (sweep, {"ref": None, "known": None, "params": SweepParams()}),
        (patchmatch, {"ref": None, "range_map": None, "params": PatchMatchParams()}),
        (exchange, {"ref": None, "range_map": None, "source_images": [None], "params": ExchangeParams()}),
        (consistency, {"range_map": None, "image": None, "params": ConsistencyParams()}),
    ],
)
def test_sources_of_another_room_are_refused(
    function: Callable[..., Any], extras: dict[str, Any], rooms: Rooms, ctx: Context
) -> None:
    """A view selector of somebody's own may not know of groups."""
    poses = {"pose": rooms.pose_items["000.png"], "source_poses": [rooms.pose_items["b0.png"]]}
    with pytest.raises(UsageError, match=r"in groups 0, 1 of the poses, .* view selector must choose"):
        function(sources=[None], ctx=ctx, **poses, **extras)
