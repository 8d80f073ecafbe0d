"""The presets go from images to what they promise; a second run computes nothing."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
import trimesh

from pano_mvs.io.ply import read_ply
from pano_mvs.io.poses.files import read_poses
from pano_mvs.io.ranges import read_confidence_png, read_range_tiff
from pano_mvs.session.session import open_session
from tests.cli.conftest import SIZE_HW, SMALL, Command, run_json
from tests.stored import read_picture
from tools.benchmarks.colmap_dense import fused_points


@pytest.mark.slow
def test_fast_runs_from_pictures_to_cloud(pano_mvs: Command, rendered: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    result = pano_mvs(
        *f"run fast --images {rendered / 'images'} --out {out} --set scores.truth={rendered / 'truth'}".split(),
        *["--set", "features.max_keypoints=1500"],
    )
    assert result.code == 0, result.text
    assert {stage["name"]: stage["run"] for stage in run_json(out)["stages"]}["depth"] == 4
    ranges = [read_range_tiff(out / f"range/00{view}.tiff") for view in range(4)]
    assert all(np.isfinite(found).mean() > 0.8 for found in ranges)
    assert len(read_ply(out / "cloud.ply")) > 5000


def test_exchanged_ranges_are_checked_against_those_before_the_exchange() -> None:
    """Otherwise the view that a range comes from confirms it."""
    edges = open_session("quality").graph.edges["checked"]
    assert edges["range_map"].producer == "exchanged"
    assert edges["sources"].producer == "plain"


@pytest.mark.slow
def test_quality_is_more_precise_than_the_quickstart_on_the_same_pictures(
    pano_mvs: Command, rendered: Path, quickstart: tuple[Path, str], tmp_path: Path
) -> None:
    out, cache = tmp_path / "quality", shutil.copytree(quickstart[0].parent / "cache", tmp_path / "cache")
    result = pano_mvs(
        *f"run quality --images {rendered / 'images'} --out {out} --cache {cache}".split(),
        *f"--set scores.truth={rendered / 'truth'}".split(),
        *SMALL,
    )
    assert result.code == 0, result.text
    errors = []
    for folder in (quickstart[0], out):
        views = run_json(folder)["scores"]["views"].values()
        errors.append(np.mean([view["median_relative_error"] for view in views]))
        assert all(np.isfinite(read_range_tiff(folder / f"range/00{view}.tiff")).mean() > 0.95 for view in range(4))
    assert errors[1] < 0.6 * errors[0]
    assert len(read_ply(out / "cloud.ply")) > 5000


# What makes quality slow is tested with it.
PLAIN_RANGES = (
    *("--set", "slanted=null", "--set", "filled=null", "--set", "planes=null", "--set", "smooth=null"),
    *("--set", "first_check=null", "--set", "first_smooth=null", "--set", "first_planes=null", "--set", "plain=null"),
    *("--set", "exchanged=null", "--set", "checked.in={}"),
    *("--set", "previews=null", "--set", "views.sources=2", "--set", "depth.cost=census", "--set", "depth.planes=16"),
)


@pytest.mark.slow
def test_splat_writes_panoramas_faces_and_seeds_that_agree(pano_mvs: Command, rendered: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    arguments = (
        *f"splat --images {rendered / 'images'} --out {out} --executor serial".split(),
        *SMALL,
        *PLAIN_RANGES,
        *f"--set scores.truth={rendered / 'truth'} --set images.nadir_deg=20".split(),
        *["--set", "scene_planes=null", "--set", "structure=null"],
    )
    result = pano_mvs("run", *arguments)
    assert result.code == 0, result.text
    solved = read_poses(out / "colmap/sparse/0")
    document = json.loads((out / "splat_bundle/equirectangular/transforms.json").read_text())
    assert [frame["file_path"] for frame in document["frames"]] == [f"images/{name}.jpg" for name in solved.names]
    read = read_poses(out / "splat_bundle/equirectangular/transforms.json")
    assert read.names == solved.names  # though the pictures are written anew, under other names
    np.testing.assert_allclose(read.translations, solved.translations, atol=1e-9)
    for name, frame in zip(solved.names, document["frames"], strict=True):
        stem = Path(name).stem
        ranges, confidence = (
            read_range_tiff(out / f"range/{stem}.tiff"),
            read_confidence_png(out / f"confidence/{stem}.png"),
        )
        depth = read_picture(out / "splat_bundle/equirectangular" / frame["depth_file_path"], cv2.IMREAD_UNCHANGED)
        np.testing.assert_allclose(depth[confidence >= 64] / 1000, ranges[confidence >= 64], atol=0.000501)
        assert not depth[confidence < 64].any()
        mask = read_picture(out / "splat_bundle/equirectangular" / frame["mask_path"], cv2.IMREAD_UNCHANGED)
        assert not mask[-15:].any()
        assert not depth[mask == 0].any()
    faces = json.loads((out / "splat_bundle/faces/transforms.json").read_text())
    assert len(faces["frames"]) == 6 * len(document["frames"])
    assert all(
        (out / "splat_bundle/faces" / frame[key]).is_file()
        for frame in faces["frames"]
        for key in ("file_path", "mask_path", "depth_file_path")
    )
    assert len(read_ply(out / "splat_bundle/faces/seed.ply")) > 5000
    assert len(pycolmap.Reconstruction(str(out / "colmap_dense_init/sparse/0")).points3D) > 1000
    assert len(pycolmap.Reconstruction(str(out / "splat_bundle/faces/sparse/0")).points3D) > 1000
    manifest = json.loads((out / "splat_bundle/manifest.json").read_text())
    assert len(manifest["views"]) == 7 * len(document["frames"])
    layers = ("image", "mask", "depth", "normal", "confidence")
    assert all((out / "splat_bundle" / view[layer]).is_file() for view in manifest["views"] for layer in layers)
    (out / "splat_bundle/faces/images/000.png.front.jpg").unlink()
    again = pano_mvs("run", *arguments)
    assert "0 units computed" in again.flat
    assert (out / "splat_bundle/faces/images/000.png.front.jpg").is_file()


@pytest.mark.slow
def test_mesh_writes_a_textured_mesh_around_the_cameras(pano_mvs: Command, rendered: Path, tmp_path: Path) -> None:
    """The room is 6 × 2.8 × 5 units of the truth, and the mesh is in units of the first baseline."""
    out = tmp_path / "out"
    settings = ("textured.triangles=30000", "textured.texture_px=1024", "images.nadir_deg=20")
    arguments = (
        *("mesh", "--images", rendered / "images", "--out", out, "--executor", "serial", *SMALL, *PLAIN_RANGES),
        *("--set", f"scores.truth={rendered / 'truth'}"),
        *(part for setting in settings for part in ("--set", setting)),
    )
    result = pano_mvs("run", *arguments)
    assert result.code == 0, result.text
    read = trimesh.load(out / "mesh_textured.glb", force="mesh")
    assert isinstance(read, trimesh.Trimesh)
    assert 500 < len(read.faces) <= 30000
    extent = read.vertices.max(axis=0) - read.vertices.min(axis=0)
    assert int(np.argmin(extent)) == 1  # y is up, and rooms are wider than high
    metrics = next(stage["metrics"] for stage in run_json(out)["stages"] if stage["name"] == "textured")
    assert metrics["seen"] > 0.3
    assert read_picture(out / "mesh_textured_seen.png").any()
    for name in ("mesh_textured.obj", "mesh_textured.mtl", "mesh_textured.jpg"):
        assert (out / name).is_file()
    again = pano_mvs("run", *arguments)
    assert "0 units computed" in again.flat


NAMES = ["000", "001", "002", "003"]


@pytest.mark.slow
def test_colmap_dense_writes_models_masks_and_a_workspace_that_fuses(pano_mvs: Command, rendered: Path) -> None:
    out = Path("out")
    arguments = (
        *f"run colmap_dense --images {rendered / 'images'} --out {out}".split(),
        *SMALL,
        *[word for name in ("scores", "previews", "cloud", "ply", "smooth") for word in ("--set", f"{name}=null")],
        *["--set", "views.sources=2", "--set", "tracked.count=2000"],
    )
    result = pano_mvs(*arguments)
    assert result.code == 0, result.text
    sparse = pycolmap.Reconstruction(out / "colmap/sparse/0")
    seeds = pycolmap.Reconstruction(out / "colmap_dense_init/sparse/0")
    faces = pycolmap.Reconstruction(out / "colmap_dense/sparse")
    assert (out / "colmap/sparse/0/images.txt").is_file()
    assert sorted(image.name for image in sparse.images.values()) == [f"{name}.png" for name in NAMES]
    assert seeds.num_points3D() == sparse.num_points3D() + 2000
    assert (faces.num_reg_images(), faces.num_rigs(), faces.num_frames()) == (24, 1, 4)
    assert faces.num_points3D() == seeds.num_points3D()
    for name in NAMES:
        assert read_picture(out / f"colmap/masks/{name}.png.png", cv2.IMREAD_UNCHANGED).shape == SIZE_HW
    assert len(fused_points(out / "colmap_dense")) > 3000
    metrics = {stage["name"]: stage["metrics"] for stage in run_json(out)["stages"]}
    assert metrics["dense"]["faces_without_points"] == 0
    again = pano_mvs(*arguments)
    assert "0 units computed" in again.text
