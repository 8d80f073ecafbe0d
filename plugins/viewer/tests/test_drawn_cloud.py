"""The cloud of a file is drawn in the world, whatever the axes of the file are."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pano_mvs_viewer.cloud_colors import drawn_cloud

from pano_mvs.api import Poses, WorldAxes
from pano_mvs.geometry import rotation_from_rotvec
from pano_mvs.io.ply import open_ply_points
from tests.synthetic.exported_clouds import exported, the_cloud, the_poses


@pytest.mark.parametrize("poses", [None, the_poses(), the_poses(WorldAxes.UNKNOWN, rotation_from_rotvec([0.7, 0, 0]))])
def test_the_drawn_cloud_returns_to_the_world(tmp_path: Path, poses: Poses | None) -> None:
    cloud = the_cloud()
    drawn = drawn_cloud(open_ply_points(exported(tmp_path, poses)))
    assert drawn.normals is not None
    np.testing.assert_allclose(drawn.points, cloud.points_in_world, rtol=0, atol=2e-6)
    np.testing.assert_allclose(drawn.normals, cloud.normals_in_world, rtol=0, atol=1e-6)
