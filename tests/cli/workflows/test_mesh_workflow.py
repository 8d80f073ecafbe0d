"""mesh.yaml goes from images to a textured mesh; a second run computes nothing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from tests.cli.conftest import SMALL, Command
from tests.cli.workflows.test_splat_workflow import PLAIN_RANGES
from tests.stored import read_picture


@pytest.mark.slow
def test_mesh_writes_a_textured_mesh_around_the_cameras(pano_mvs: Command, rendered: Path, tmp_path: Path) -> None:
    """The room is 6 × 2.8 × 5 units of the truth, and the mesh is in units of the first baseline."""
    out = tmp_path / "out"
    settings = ("textured.triangles=3000", "textured.texture_px=512", "images.nadir_deg=20")
    arguments = (
        *("mesh", "--images", rendered / "images", "--out", out, "--executor", "serial", *SMALL, *PLAIN_RANGES),
        *("--set", f"scores.truth={rendered / 'truth'}"),
        *(part for setting in settings for part in ("--set", setting)),
    )
    result = pano_mvs("run", *arguments)
    assert result.code == 0, result.text
    read = trimesh.load(out / "mesh_textured.glb", force="mesh")
    assert isinstance(read, trimesh.Trimesh)
    assert 500 < len(read.faces) <= 3000
    extent = read.vertices.max(axis=0) - read.vertices.min(axis=0)
    assert int(np.argmin(extent)) == 1  # y is up, and rooms are wider than high
    seen = read_picture(out / "mesh_textured_seen.png")
    assert (seen > 0).mean() > 0.2
    for name in ("mesh_textured.obj", "mesh_textured.mtl", "mesh_textured.jpg"):
        assert (out / name).is_file()
    again = pano_mvs("run", *arguments)
    assert "0 units computed" in again.flat
