"""`pano-mvs merge` prints how well blocks agree, and what it wrote."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pano_mvs.geometry import ray_grid, similarity_from_points
from pano_mvs.io.ply import read_ply
from pano_mvs.io.poses.files import read_poses
from pano_mvs.io.ranges import read_range_tiff
from pano_mvs.results.records import FailedUnit
from pano_mvs.results.summary import RunSummary
from pano_mvs.testing.room import capture_poses, default_room, range_along
from tests.algorithms.blocks.walked_blocks import some_world
from tests.cli.conftest import SIZE_HW, SMALL, Command
from tests.session.merging.written_blocks import write_block
from tests.synthetic.capture_files import write_capture


def test_merge_prints_the_agreement_and_what_it_wrote(pano_mvs: Command, tmp_path: Path) -> None:
    write_block(tmp_path / "one", list(range(12)), some_world(1))
    write_block(tmp_path / "two", list(range(7, 20)), some_world(2))
    result = pano_mvs("merge", tmp_path / "one", tmp_path / "two", "--out", tmp_path / "both")
    assert result.code == 0, result.text
    words = result.text.split()
    assert "20 cameras," in result.text
    assert "20 range maps, cloud of 3,000 points" in " ".join(words)
    assert str(tmp_path / "both" / "report.html") in "".join(words)


def test_merge_names_an_image_that_it_lacks(pano_mvs: Command, tmp_path: Path) -> None:
    write_block(tmp_path / "one", list(range(12)), some_world(1))
    write_block(tmp_path / "two", list(range(7, 20)), some_world(2))
    lost = FailedUnit(stage="images", item="020.png", cause="it is damaged")
    RunSummary.read(tmp_path / "two").model_copy(update={"failures": (lost,)}).write(tmp_path / "two")
    result = pano_mvs("merge", tmp_path / "one", tmp_path / "two", "--out", tmp_path / "both")
    assert result.code == 3
    assert "1 image without a pose, such as 020.png: it is damaged" in result.flat
    assert "1 of 21 panoramas has no pose" in (tmp_path / "both/report.html").read_text(encoding="utf-8")


@pytest.fixture
def merged(pano_mvs: Command, tmp_path: Path) -> Path:
    """Two merged blocks."""
    write_block(tmp_path / "one", list(range(12)), some_world(1))
    write_block(tmp_path / "two", list(range(7, 20)), some_world(2))
    assert pano_mvs("merge", tmp_path / "one", tmp_path / "two", "--out", tmp_path / "both").code == 0
    return tmp_path / "both"


def test_the_report_of_a_merge_is_written_again_without_a_cache(pano_mvs: Command, merged: Path) -> None:
    before = (merged / "report.html").read_text(encoding="utf-8")
    (merged / "report.html").unlink()
    result = pano_mvs("report", merged)
    assert result.code == 0, result.text
    assert (merged / "report.html").read_text(encoding="utf-8") == before


def test_a_merge_is_put_into_metres_by_a_block(pano_mvs: Command, merged: Path) -> None:
    for measured in ((), ("000.png", "005.png", "3m"), ("--camera-height", "1.6m")):
        result = pano_mvs("scale", merged, *measured)
        assert result.code == 2
        block = merged.parent
        assert f"pano-mvs scale {block / 'one'} A B 3.42m" in result.flat
        assert f"pano-mvs merge {block / 'one'} {block / 'two'} --out {merged}" in result.flat


def test_a_merge_in_metres_is_corrected_by_its_blocks(pano_mvs: Command, merged: Path) -> None:
    summary = RunSummary.read(merged)
    metric = summary.poses.model_copy(update={"metric": True, "scale": "metres, by GPS"})
    summary.model_copy(update={"poses": metric}).write(merged)
    result = pano_mvs("scale", merged)
    assert result.code == 2
    assert "is in metres (metres, by GPS). To correct the lengths, correct each block" in result.flat


def test_the_status_of_merged_blocks_is_that_of_each(pano_mvs: Command, merged: Path) -> None:
    result = pano_mvs("status", merged)
    assert result.code == 0, result.text
    assert result.flat.startswith("merged ")
    assert "from 2 blocks: exit code 0" in result.flat
    for name in ("one", "two"):
        assert f"block {merged.parent / name}: latest run" in result.flat


def test_a_command_that_needs_a_workflow_names_the_blocks(pano_mvs: Command, merged: Path) -> None:
    result = pano_mvs("inspect", merged, "000.png", "1", "1")
    assert result.code == 2
    assert f"is merged from blocks, each of which is a run of its own. Give a block: {merged.parent}" in result.flat


def test_split_prints_the_commands_that_follow(pano_mvs: Command, tmp_path: Path) -> None:
    (tmp_path / "walk").mkdir()
    for number in range(20):
        (tmp_path / f"walk/{number}.png").write_bytes(b"x")
    folder = tmp_path / "my blocks"
    result = pano_mvs("split", tmp_path / "walk", "--out", folder, "--size", "12", "--overlap", "4")
    assert result.code == 0, result.text
    assert f"--images '{folder}/block_2' --out out/block_2" in result.text
    assert "--out out/block_2" in result.text
    assert "then: pano-mvs merge out/block_1 out/block_2 --out out/merged" in " ".join(result.text.split())
    assert (folder / "block_2/19.png").read_bytes() == b"x"


@pytest.mark.slow
def test_blocks_of_a_rendered_room_become_one_model_of_it(pano_mvs: Command, tmp_path: Path) -> None:
    room, cameras = default_room(), capture_poses(8, spread=0.4)
    write_capture(tmp_path / "capture", room, cameras, size_hw=SIZE_HW)
    result = pano_mvs(
        "split", tmp_path / "capture/images", "--out", tmp_path / "blocks", "--size", "7", "--overlap", "3"
    )
    assert result.code == 0, result.text
    for number in (1, 2):
        block = pano_mvs(
            "run", "quickstart", "--images", tmp_path / f"blocks/block_{number}", "--out", f"out/{number}",
            "--cache", tmp_path / "cache", *SMALL,
        )  # fmt: skip
        assert block.code in (0, 3), block.text
    result = pano_mvs("merge", "out/1", "out/2", "--out", "out/merged")
    assert result.code == 0, result.text
    poses = read_poses(Path("out/merged"))
    assert len(poses.names) == 8
    centers = np.array([camera.center for camera in cameras])
    room_from_merged = similarity_from_points(poses.centers, centers)
    offsets = np.linalg.norm(room_from_merged.apply(poses.centers) - centers, axis=1)
    assert offsets.max() < 0.01
    ranges = read_range_tiff(Path("out/merged/range/007.tiff")) * room_from_merged.scale
    rays = cameras[7].rotation.T @ ray_grid(ranges.shape).reshape(-1, 3).T
    errors = np.abs(ranges.ravel() / range_along(room, cameras[7].center, rays.T) - 1)
    assert np.nanmedian(errors) < 0.025
    cloud = read_ply(Path("out/merged/cloud.ply"))
    parts = [len(read_ply(Path(f"out/{number}/cloud.ply"))) for number in (1, 2)]
    assert max(parts) / 2 < len(cloud) < sum(parts)
    assert pano_mvs("view", "out/merged", "--screenshot", "merged.png").code == 0
