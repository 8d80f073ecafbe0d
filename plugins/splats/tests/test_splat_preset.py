"""The preset splat, from pictures to what trainers read."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from pano_mvs.io.ply import read_ply
from pano_mvs.io.poses.files import read_poses
from pano_mvs.io.ranges import read_confidence_png, read_range_tiff
from tests.cli.conftest import SMALL, Command
from tests.stored import read_picture

# What makes quality slow is tested with it.
PLAIN_RANGES = (
    *("--set", "slanted=null", "--set", "filled=null", "--set", "planes=null", "--set", "smooth=null"),
    *("--set", "first_check=null", "--set", "first_smooth=null", "--set", "first_planes=null", "--set", "plain=null"),
    *("--set", "exchanged=null", "--set", "checked.in={}", "--set", "scene_planes=null", "--set", "structure=null"),
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
