"""colmap_dense.yaml: one command from pictures to all that COLMAP, OpenMVS and splat trainers open."""

from __future__ import annotations

from pathlib import Path

import cv2
import pycolmap
import pytest

from tests.cli.conftest import SIZE_HW, SMALL, Command, run_json
from tests.stored import read_picture
from tools.benchmarks.colmap_dense import fused_points

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
