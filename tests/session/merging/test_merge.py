"""Blocks become one capture: cameras, points, cloud and range maps in one world; what does not fit is refused."""

from __future__ import annotations

import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.blocks import MergedBlocks, nearest_cameras
from pano_mvs.core.errors import InputError, UsageError
from pano_mvs.engine.executors.threads import available_threads
from pano_mvs.engine.stages.context import Context
from pano_mvs.engine.stages.params import Params
from pano_mvs.engine.stages.registry import Registry
from pano_mvs.geometry import Rigid3, similarity_from_points
from pano_mvs.io.colmap.writer import write_colmap_model
from pano_mvs.io.ply import read_ply, write_ply
from pano_mvs.io.poses.files import read_poses
from pano_mvs.io.ranges import read_range_tiff
from pano_mvs.results.records import FailedUnit, StageOutcome
from pano_mvs.results.run_output import load
from pano_mvs.results.summary import RunSummary
from pano_mvs.scene import Files, Poses, WorldAxes
from pano_mvs.scene.upright import z_up_from_world
from pano_mvs.session.merging.files import MergeFiles, load_blocks
from pano_mvs.session.merging.merge import MergeResult, merge_outputs
from tests.algorithms.blocks.walked_blocks import bent, some_world, walk
from tests.session.merging.written_blocks import CLOUD, RANGE, SIZE_HW, write_block

RANGES = (range(14), range(8, 24), range(20, 34))
"""A closed walk of 30 cameras in three blocks; the last one meets the first."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three blocks and their merge."""
    root = tmp_path_factory.mktemp("blocks")
    for number, chosen in enumerate(RANGES):
        write_block(root / f"block_{number}", list(chosen), some_world(number))
    return root


@pytest.fixture(scope="module")
def merged(folder: Path) -> MergeResult:
    return merge_outputs([folder / f"block_{number}" for number in range(3)], folder / "merged")


def test_all_cameras_are_in_the_world_of_the_largest_block(folder: Path, merged: MergeResult) -> None:
    assert merged.alignment.reference == 1
    assert merged.summary.exit_code == 0
    poses = merged.merged.poses
    poses.check()
    truth = {name: some_world(1).move_camera(pose) for name, pose in walk(30).items()}
    assert poses.names == tuple(truth)
    for name, pose in poses.cameras.items():
        np.testing.assert_allclose(pose.center, truth[name].center, atol=1e-5 * some_world(1).scale)
    for file in ("", "transforms.json", "poses.json"):
        read = read_poses(folder / "merged" / file)
        np.testing.assert_allclose(read.centers, poses.centers, atol=1e-5)
        np.testing.assert_allclose(read.rotations, poses.rotations, atol=1e-6)


def test_each_camera_belongs_to_one_block_and_overlaps_are_halved(merged: MergeResult) -> None:
    owner = merged.merged.owner
    assert owner[:8].tolist() == [2, 2, 0, 0, 0, 0, 0, 0]
    assert set(owner[8:14].tolist()) == {0, 1}
    assert np.all(np.diff(owner[8:14]) >= 0)
    assert owner[24:30].tolist() == [2] * 6


def test_tracks_meet_at_common_images(folder: Path, merged: MergeResult) -> None:
    poses = merged.merged.poses
    assert np.degrees(poses.point_errors_rad).max() < 0.01
    positions = np.round(poses.points_in_world / some_world(1).scale, 4)
    assert len(np.unique(positions, axis=0)) == len(positions)
    pairs = np.stack([poses.track_point_idx, poses.track_image_idx], axis=1)
    assert len(np.unique(pairs, axis=0)) == len(pairs)
    images = [poses.track_image_idx[poses.track_point_idx == point] for point in range(len(positions))]
    assert any(min(seen) < 8 and max(seen) >= 14 for seen in images if max(seen) < 20), "no track spans two blocks"
    assert len(read_poses(folder / "merged").points_in_world) == len(positions)


def test_no_surface_is_duplicated_and_none_is_lost(folder: Path, merged: MergeResult) -> None:
    """Every block has all points, and each point is kept from one of them."""
    cloud = read_ply(folder / "merged/cloud.ply")
    assert len(cloud) == merged.summary.cloud.points == len(CLOUD)
    world = some_world(1)
    back = world.inverse().apply(cloud.points_in_world)
    order, expected = np.lexsort(back.round(3).T), np.lexsort(CLOUD.round(3).T)
    np.testing.assert_allclose(back[order], CLOUD[expected], atol=1e-3)
    np.testing.assert_allclose(cloud.normals_in_world, np.tile(world.rotation @ (0, 1, 0), (len(cloud), 1)), atol=1e-5)
    assert cloud.uncertainty is not None
    np.testing.assert_allclose(cloud.uncertainty, 0.5 * world.scale, rtol=1e-4)
    assert cloud.confidence is not None
    assert set(cloud.confidence.tolist()) == {200}


def test_range_maps_have_the_unit_of_the_merged_world(folder: Path, merged: MergeResult) -> None:
    assert [view.name for view in merged.summary.views] == list(walk(30))
    for idx in (0, 10, 29):
        ranges = read_range_tiff(folder / f"merged/range/{idx:03d}.tiff")
        np.testing.assert_allclose(ranges, RANGE * some_world(1).scale, rtol=1e-5)


def test_the_merged_folder_is_the_output_of_a_run(folder: Path, merged: MergeResult) -> None:
    run = load(folder / "merged")
    assert run.poses is not None
    assert len(run.poses.names) == 30
    assert len(run.views) == 30
    assert run.summary.verdict is not None
    assert run.summary.verdict.sentence == "Merged from 3 blocks."
    assert sum("common cameras; positions differ by" in note for note in run.summary.notes) == 3
    links = {(link.first, link.second) for link in run.summary.poses.links}
    assert len(links) == len(run.summary.poses.links) >= 29
    assert "<svg" in (folder / "merged/report.html").read_text(encoding="utf-8")
    again = merge_outputs([folder / f"block_{number}" for number in range(3)], folder / "merged")
    assert again.summary.poses == merged.summary.poses
    assert json.loads((folder / "merged/run.json").read_text())["workflow"]["name"] == "merge"


def test_blocks_without_common_cameras_are_refused(folder: Path, tmp_path: Path) -> None:
    write_block(tmp_path / "far", list(range(13, 22)), some_world(9))
    with pytest.raises(InputError, match=r"far: shares 1 registered camera with .*block_0.* 3 are needed"):
        merge_outputs([folder / "block_0", tmp_path / "far"], tmp_path / "merged")
    assert not (tmp_path / "merged").exists()


def test_blocks_that_disagree_are_refused(folder: Path, tmp_path: Path) -> None:
    crooked = bent(walk(30), turn_deg=500, stretch=4.0)
    write_block(tmp_path / "crooked", list(range(5, 20)), some_world(9), cameras=crooked)
    with pytest.raises(InputError, match=r"crooked disagree about their 9 common cameras: positions differ by"):
        merge_outputs([folder / "block_0", tmp_path / "crooked"], tmp_path / "merged")


def test_a_camera_that_two_blocks_place_differently_is_doubtful(folder: Path, tmp_path: Path) -> None:
    cameras = walk(30)
    wrong = cameras["010.png"]
    cameras["010.png"] = Rigid3.from_center(wrong.rotation, wrong.center + np.array((0.0, 1.5, 0.0)))
    write_block(tmp_path / "other", list(range(5, 20)), some_world(9), cameras=cameras)
    result = merge_outputs([folder / "block_0", tmp_path / "other"], tmp_path / "merged")
    assert list(result.summary.poses.doubts) == ["010.png"]
    assert "times the distance between neighbouring cameras apart" in result.summary.poses.doubts["010.png"]
    assert result.summary.exit_code == 3


def test_metres_and_doubts_of_a_block_are_kept_without_its_cache(folder: Path, tmp_path: Path) -> None:
    write_block(tmp_path / "metric", list(range(5, 14)), some_world(9))
    summary = RunSummary.read(tmp_path / "metric")
    stated = summary.poses.model_copy(
        update={
            "metric": True,
            "scale": "by GPS",
            "axes": WorldAxes.NORTH,
            "origin_lla": (47.5, 8.25, 410.0),
            "doubts": {"013.png": "hardly seen"},
        }
    )
    summary.model_copy(update={"poses": stated}).write(tmp_path / "metric")
    result = merge_outputs([folder / "block_0", tmp_path / "metric"], tmp_path / "merged")
    assert result.alignment.reference == 1
    merged = result.summary.poses
    assert (merged.metric, merged.scale, merged.axes, merged.origin_lla) == (
        True,
        "by GPS",
        WorldAxes.NORTH,
        (47.5, 8.25, 410.0),
    )
    assert set(result.summary.poses.doubts) <= {"013.png"}
    assert read_poses(tmp_path / "merged/poses.json").metric


def test_folders_that_cannot_be_used_are_named(folder: Path, tmp_path: Path) -> None:
    block = folder / "block_0"
    with pytest.raises(UsageError, match="two or more output folders"):
        merge_outputs([block], tmp_path / "merged")
    with pytest.raises(UsageError, match="the same folder"):
        merge_outputs([block, block], tmp_path / "merged")
    with pytest.raises(UsageError, match="one of the blocks"):
        merge_outputs([block, folder / "block_1"], block)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/notes.txt").write_text("x")
    with pytest.raises(UsageError, match="holds something else"):
        merge_outputs([block, folder / "block_1"], tmp_path / "mine")
    with pytest.raises(InputError, match=r"run\.json cannot be read"):
        merge_outputs([block, tmp_path / "mine"], tmp_path / "merged")


def _changed(out: Path, **fields: object) -> None:
    RunSummary.read(out).model_copy(update=fields).write(out)


def test_files_of_an_earlier_merge_do_not_stay_beside_those_of_another_world(tmp_path: Path) -> None:
    """A range map of an image that is gone, and a cloud that no block has, stayed in the merged folder."""
    for number, chosen in enumerate((range(12), range(7, 20))):
        write_block(tmp_path / f"block_{number}", list(chosen), some_world(number))
    outs, merged = [tmp_path / "block_0", tmp_path / "block_1"], tmp_path / "merged"
    merge_outputs(outs, merged)
    (merged / "range/mine.tiff").write_bytes(b"x")
    shutil.rmtree(outs[1])
    write_block(outs[1], list(range(7, 19)), some_world(5))
    for out in outs:
        _changed(out, left_over={"cloud.ply": "digest"})
    result = merge_outputs(outs, merged)
    assert result.summary.cloud.points is None
    assert not (merged / "cloud.ply").exists()
    assert "ply_file_path" not in json.loads((merged / "transforms.json").read_text())
    left = {f"{number:03d}.tiff" for number in range(19)}
    assert {path.name for path in (merged / "range").iterdir()} == left | {"mine.tiff"}
    assert len(list((merged / "confidence").iterdir())) == 19


def test_files_that_a_block_did_not_write_are_not_its_results(tmp_path: Path) -> None:
    """After `--until poses` with other settings, the cloud and the model of the earlier run are in another world."""
    for number, chosen in enumerate((range(12), range(7, 20))):
        write_block(tmp_path / f"block_{number}", list(chosen), some_world(number))
    _changed(tmp_path / "block_1", left_over={"cloud.ply": "digest", "range/019.tiff": "digest"})
    run = load(tmp_path / "block_1")
    assert run.poses is not None
    assert run.cloud is None
    assert run.views["019.png"].range_map is None
    assert run.views["018.png"].range_map is not None
    _changed(tmp_path / "block_1", left_over={"colmap/sparse/0/images.bin": "digest"})
    with pytest.raises(InputError, match=r"block_1: no poses: the cache of the run was deleted"):
        merge_outputs([tmp_path / "block_0", tmp_path / "block_1"], tmp_path / "merged")


def test_what_failed_in_a_block_is_in_the_merged_results(tmp_path: Path) -> None:
    """An image that could not be read was missing without a word."""
    for number, chosen in enumerate((range(12), range(7, 20))):
        write_block(tmp_path / f"block_{number}", list(chosen), some_world(number))
    outs = [tmp_path / "block_0", tmp_path / "block_1"]
    lost = FailedUnit(stage="images", item="003b.png", cause="it is damaged")
    elsewhere = FailedUnit(stage="matches", item="003.png | 011.png", cause="out of memory")
    _changed(outs[0], failures=(lost, elsewhere))
    _changed(outs[1], failures=(FailedUnit(stage="features", item="008.png", cause="not a JPEG"),))
    summary = merge_outputs(outs, tmp_path / "merged").summary
    assert {name: why.reason for name, why in summary.rejected.items()} == {"003b.png": "it is damaged"}
    assert summary.poses.rejected == {"003b.png": "it is damaged"}
    assert summary.warnings == (
        f"{outs[0]}: 1 unit failed, such as matches:003.png | 011.png: out of memory",
        f"{outs[1]}: 1 unit failed, such as features:008.png: not a JPEG",
    )
    assert summary.exit_code == 3


def test_cameras_in_a_smaller_group_of_a_block_are_left_out_with_the_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for number, chosen in enumerate((range(12), range(7, 20))):
        write_block(tmp_path / f"block_{number}", list(chosen), some_world(number))
    blocks = load_blocks([tmp_path / "block_0", tmp_path / "block_1"])
    apart = [replace(blocks[0], left_out=("000b.png", "008.png")), blocks[1]]
    monkeypatch.setattr("pano_mvs.session.merging.merge.load_blocks", lambda *_: apart)
    summary = merge_outputs([block.run.out for block in blocks], tmp_path / "merged").summary
    reason = f"it is in a smaller group of the poses of {tmp_path / 'block_0'}"
    assert {name: why.reason for name, why in summary.rejected.items()} == {"000b.png": reason}, "008.png is in block_1"
    assert summary.exit_code == 3


def test_a_merge_that_was_interrupted_is_repeated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The cloud that it had written looked like something else in the folder."""
    for number, chosen in enumerate((range(12), range(7, 20))):
        write_block(tmp_path / f"block_{number}", list(chosen), some_world(number))
    outs, merged = [tmp_path / "block_0", tmp_path / "block_1"], tmp_path / "merged"

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(MergeFiles, "write_ranges", interrupt)
        with pytest.raises(KeyboardInterrupt):
            merge_outputs(outs, merged)
    assert (merged / "cloud.ply").exists()
    merge_outputs(outs, merged)
    assert len(load(merged).views) == 20
    (merged / "run.json").unlink()
    (merged / "notes.txt").write_text("mine")
    with pytest.raises(UsageError, match="holds something else"):
        merge_outputs(outs, merged)


def test_the_images_are_found_through_the_links_of_the_blocks(tmp_path: Path) -> None:
    (tmp_path / "walk").mkdir()
    outs = []
    for number, chosen in enumerate((range(12), range(8, 20))):
        links, out = tmp_path / f"links_{number}", tmp_path / f"block_{number}"
        links.mkdir()
        for idx in chosen:
            (tmp_path / f"walk/{idx:03d}.png").touch()
            (links / f"{idx:03d}.png").symlink_to(tmp_path / f"walk/{idx:03d}.png")
        write_block(out, list(chosen), some_world(number))
        stage = StageOutcome(name="images", use="source.folder", params={"path": str(links)})
        RunSummary.read(out).model_copy(update={"stages": (stage,)}).write(out)
        outs.append(out)
    merged = merge_outputs(outs, tmp_path / "merged").summary
    assert merged.source_folder == tmp_path / "walk"
    assert merged.merged is not None
    assert merged.merged.blocks == tuple(map(str, outs))
    (tmp_path / "links_1/019.png").unlink()
    (tmp_path / "links_1/019.png").touch()
    assert merge_outputs(outs, tmp_path / "merged").summary.source_folder is None


@pytest.mark.parametrize("linked", [False, True])
def test_a_preview_outside_a_block_is_not_copied(folder: Path, tmp_path: Path, linked: bool) -> None:
    """The name of a preview in run.json could be that of any file, which was copied into the result."""
    (tmp_path / "secret.txt").write_text("secret")
    block = tmp_path / "block_0"
    shutil.copytree(folder / "block_0", block)
    run = json.loads((block / "run.json").read_bytes())
    for view in run["views"]:
        view["preview"] = "linked.txt" if linked else "../secret.txt"
    (block / "run.json").write_text(json.dumps(run))
    if linked:
        (block / "linked.txt").symlink_to(tmp_path / "secret.txt")
    assert all(view.preview is None for view in load(block).views.values())
    merge_outputs([block, folder / "block_1"], tmp_path / "merged")
    assert not list((tmp_path / "merged").rglob("*.txt"))


def test_a_run_of_a_newer_version_is_refused(folder: Path, tmp_path: Path) -> None:
    shutil.copytree(folder / "block_0", tmp_path / "block_0")
    run = json.loads((tmp_path / "block_0/run.json").read_bytes())
    (tmp_path / "block_0/run.json").write_text(json.dumps(run | {"schema": 99}))
    with pytest.raises(InputError, match=r"written by a newer version of pano_mvs \(schema 99"):
        merge_outputs([tmp_path / "block_0", folder / "block_1"], tmp_path / "merged")


def bent_blocks(folder: Path, use: str) -> list[Path]:
    """Write blocks that bend differently, although their observations are exact; they end with this stage."""
    for number, chosen in enumerate(RANGES):
        out = folder / f"block_{number}"
        poses = write_block(out, list(chosen), some_world(number))
        cameras = bent(poses.cameras, turn_deg=0.1 * (number + 1), stretch=0.001).values()
        centers = [camera.center for camera in cameras]
        rotations = np.array([camera.rotation for camera in cameras])
        found = replace(poses, rotations=rotations, translations=-np.einsum("nij,nj->ni", rotations, centers))
        write_colmap_model(out / "colmap/sparse/0", found, dict.fromkeys(poses.names, SIZE_HW))
        stage = StageOutcome(name="last", use=use)
        RunSummary.read(out).model_copy(update={"stages": (stage,)}).write(out)
    return [folder / f"block_{number}" for number in range(len(RANGES))]


@pytest.fixture(scope="module")
def adjusted(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, MergedBlocks]:
    """The merge of blocks that were adjusted."""
    folder = tmp_path_factory.mktemp("adjusted")
    return folder / "merged", merge_outputs(bent_blocks(folder, "poses.refine"), folder / "merged").merged


def test_blocks_that_were_adjusted_are_adjusted_together(adjusted: tuple[Path, MergedBlocks]) -> None:
    out, found = adjusted
    assert found.before is not None
    truth = np.array([camera.center for camera in walk(30).values()])

    def worst(poses: Poses) -> float:
        moved = similarity_from_points(poses.centers, truth).apply(poses.centers)
        return float(np.linalg.norm(moved - truth, axis=1).max())

    assert worst(found.poses) < 0.1 * worst(found.before)
    np.testing.assert_allclose(similarity_from_points(found.before.centers, found.poses.centers).scale, 1, atol=1e-6)
    summary = load(out).summary
    assert any("all 30 cameras were adjusted together" in note for note in summary.notes)
    np.testing.assert_allclose(read_poses(out).centers, found.poses.centers, atol=1e-5)


def test_the_cloud_moves_with_the_cameras(tmp_path: Path, adjusted: tuple[Path, MergedBlocks]) -> None:
    """A point stays where its camera sees it: the ranges of the camera do not change."""
    out, found = adjusted
    assert found.before is not None
    rng = np.random.default_rng(3)
    points, normals = rng.normal(0, 5, (40, 3)), rng.normal(size=(40, 3))
    idx = rng.integers(30, size=40)
    moved, turned = found.move(points, normals, idx)
    for camera, *vectors in zip(idx, points, normals, moved, turned, strict=True):
        before, after = found.before.cam_from_world(camera), found.poses.cam_from_world(camera)
        np.testing.assert_allclose(after.apply(vectors[2]), before.apply(vectors[0]), atol=1e-9)
        np.testing.assert_allclose(after.rotation @ vectors[3], before.rotation @ vectors[1], atol=1e-9)
    cloud = read_ply(out / "cloud.ply").points_in_world
    plain = merge_outputs(bent_blocks(tmp_path / "kept", "poses.from_model"), tmp_path / "plain").merged
    still = read_ply(tmp_path / "plain/cloud.ply").points_in_world
    assert plain.before is None, "known poses are kept"
    assert np.abs(cloud - still).max() > 0.01
    followed, _ = found.move(still, still, nearest_cameras(still, found.before.centers))
    np.testing.assert_allclose(cloud, followed, atol=1e-4)


def with_exports(folder: Path, *uses: StageOutcome) -> list[Path]:
    """Write the blocks, as if their workflow had these stages."""
    for number, chosen in enumerate(RANGES):
        out = folder / f"block_{number}"
        write_block(out, list(chosen), some_world(number))
        RunSummary.read(out).model_copy(update={"stages": uses}).write(out)
    return [folder / f"block_{number}" for number in range(len(RANGES))]


def test_exports_of_poses_and_cloud_are_made_of_the_whole_capture(tmp_path: Path) -> None:
    tiles = StageOutcome(name="tiles", use="export.tiles_3d", params={"tile_points": 1000})
    textured = StageOutcome(name="textured", use="export.mesh_textured")
    outs = with_exports(tmp_path, tiles, textured, StageOutcome(name="ply", use="export.ply"))
    merged = merge_outputs(outs, tmp_path / "merged")
    tileset = json.loads((tmp_path / "merged/tiles_3d/tileset.json").read_text())
    low, high = _corners(tileset["root"]["boundingVolume"]["box"])
    points = read_ply(tmp_path / "merged/cloud.ply").points_in_world
    turned = points @ np.array(tileset["extras"]["file_from_world"]).T
    np.testing.assert_allclose([low, high], [turned.min(axis=0), turned.max(axis=0)], atol=1e-3)
    assert "tiles_3d/tileset.json" in merged.summary.files
    assert "of each block, and not merged: the files of export.mesh_textured" in merged.summary.notes
    assert not list((tmp_path / "merged").glob(".tmp-*"))


def _corners(box: list[float]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    center, half = np.array(box[:3]), np.abs(np.array(box[3:]).reshape(3, 3)).sum(axis=0)
    return center - half, center + half


def test_an_export_that_fails_is_named_and_loses_nothing(tmp_path: Path) -> None:
    mesh = StageOutcome(name="mesh", use="export.mesh", params={"min_views": 200})
    gone = StageOutcome(name="tiles", use="export.tiles_3d", params={"no_such_setting": 1})
    merged = merge_outputs(with_exports(tmp_path, mesh, gone), tmp_path / "merged")
    for use in ("export.mesh", "export.tiles_3d"):
        assert any(f"{use} was not repeated for the merged capture" in note for note in merged.summary.notes)
    assert (tmp_path / "merged/cloud.ply").is_file()


@pytest.mark.slow
def test_exports_are_computed_as_units_of_a_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """They had one thread, and the same random numbers whatever their settings; sys.exit in one ended the merge."""
    registry = Registry.installed()
    spec = registry.stages["export.tiles_3d"]
    draws: list[tuple[int, float]] = []

    def probe(params: Params, ctx: Context, **_: object) -> Files:
        draws.append((ctx.threads, ctx.rng.random()))
        if len(draws) == 4:
            sys.exit("enough")
        ctx.note("as a unit")
        (ctx.scratch / "tile.txt").write_text("tile")
        return Files({f"tiles_3d/{len(draws)}.txt": ctx.scratch / "tile.txt"})

    registry.stages["export.tiles_3d"] = replace(spec, function=probe, extras={"params": "params", "ctx": "ctx"})
    monkeypatch.setattr(Registry, "installed", lambda: registry)
    monkeypatch.setattr("pano_mvs.session.merging.merge._is_repeated", lambda _: True)
    tiles = [StageOutcome(name=f"tiles_{n}", use=spec.name, params={"tile_points": 1000 * n}) for n in (3, 4)]
    outs = with_exports(tmp_path, *tiles)
    merged = merge_outputs(outs, tmp_path / "merged")
    assert {"tiles_3d/1.txt", "tiles_3d/2.txt"} == {*merged.summary.files}
    assert "export.tiles_3d: as a unit" in merged.summary.notes
    again = merge_outputs(outs, tmp_path / "again")
    assert any("was not repeated for the merged capture: " in note and "enough" in note for note in again.summary.notes)
    assert draws[:2] == draws[2:]
    assert draws[0][1] != draws[1][1] != np.random.default_rng(0).random() != draws[0][1]
    assert {threads for threads, _ in draws} == {available_threads()}


def test_exports_of_an_earlier_merge_do_not_stay(tmp_path: Path) -> None:
    tiles = StageOutcome(name="tiles", use="export.tiles_3d")
    merge_outputs(with_exports(tmp_path, tiles), tmp_path / "merged")
    assert (tmp_path / "merged/tiles_3d/tileset.json").is_file()
    for number in range(3):
        out = tmp_path / f"block_{number}"
        RunSummary.read(out).model_copy(update={"stages": ()}).write(out)
    merge_outputs([tmp_path / f"block_{number}" for number in range(3)], tmp_path / "merged")
    assert not (tmp_path / "merged/tiles_3d/tileset.json").exists()


def test_stages_of_a_block_cannot_lead_outside(tmp_path: Path) -> None:
    tiles = StageOutcome(name="../../outside", use="export.tiles_3d")
    merged = merge_outputs(with_exports(tmp_path, tiles), tmp_path / "merged")
    assert "tiles_3d/tileset.json" in merged.summary.files
    assert not list(tmp_path.rglob("outside*"))


@pytest.mark.slow
def test_exports_need_no_numbers_of_views_in_the_files_of_blocks(tmp_path: Path) -> None:
    """By default, export.ply writes none."""
    outs = with_exports(
        tmp_path,
        StageOutcome(name="tiles", use="export.tiles_3d"),
        StageOutcome(name="mesh", use="export.mesh", params={"depth": 5}),
    )
    for out in outs:
        write_ply(out / "cloud.ply", read_ply(out / "cloud.ply"), file_from_world=z_up_from_world())
    merged = merge_outputs(outs, tmp_path / "merged")
    assert {"tiles_3d/tileset.json", "mesh.ply"} <= merged.summary.files.keys()


def test_two_exports_of_the_same_files_are_not_mixed(tmp_path: Path) -> None:
    tiles = [StageOutcome(name=f"tiles_{n}", use="export.tiles_3d", params={"tile_points": n}) for n in (1000, 100000)]
    merged = merge_outputs(with_exports(tmp_path, *tiles), tmp_path / "merged")
    tileset = json.loads((tmp_path / "merged/tiles_3d/tileset.json").read_text())
    assert tileset["root"]["children"], "those of the first, for which the cloud is too large for one tile"
    assert any("another export has written tiles_3d/" in note for note in merged.summary.notes)


def test_what_lies_in_the_way_of_an_export_is_no_error_of_the_merge(tmp_path: Path) -> None:
    outs = with_exports(tmp_path, StageOutcome(name="tiles", use="export.tiles_3d"))
    (tmp_path / "merged").mkdir()
    (tmp_path / "merged/.pano-mvs-output").touch()
    (tmp_path / "merged/tiles_3d").write_text("mine")
    merged = merge_outputs(outs, tmp_path / "merged")
    assert any("export.tiles_3d was not repeated for the merged capture" in note for note in merged.summary.notes)
    assert (tmp_path / "merged/tiles_3d").read_text() == "mine"


def test_an_exported_file_that_somebody_changed_stays(tmp_path: Path) -> None:
    outs = with_exports(tmp_path, StageOutcome(name="tiles", use="export.tiles_3d"))
    merge_outputs(outs, tmp_path / "merged")
    (tmp_path / "merged/tiles_3d/tileset.json").write_text("mine")
    for out in outs:
        RunSummary.read(out).model_copy(update={"stages": ()}).write(out)
    merge_outputs(outs, tmp_path / "merged")
    assert [path.name for path in (tmp_path / "merged/tiles_3d").iterdir()] == ["tileset.json"]


def test_no_export_is_repeated_without_points(tmp_path: Path) -> None:
    outs = with_exports(tmp_path, StageOutcome(name="tiles", use="export.tiles_3d"))
    for out in outs:
        (out / "cloud.ply").unlink()
    assert merge_outputs(outs, tmp_path / "merged").summary.files == {}
