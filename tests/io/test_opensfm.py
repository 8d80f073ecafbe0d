"""OpenSfM's reconstruction.json, in its own conventions."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pano_mvs.core.errors import InputError
from pano_mvs.geometry import pixel_from_ray, rotvec_from_rotation
from pano_mvs.io.poses.files import read_poses
from pano_mvs.testing.room import capture_poses

POSES = dict(zip(("1.jpg", "2.jpg", "10.jpg"), capture_poses(3, seed=5), strict=True))
SIZE_HW = (512, 1024)


def reconstruction(count: int = 3, **more: Any) -> dict[str, Any]:
    camera = {"projection_type": "spherical", "width": SIZE_HW[1], "height": SIZE_HW[0]}
    shots = {
        name: {
            "rotation": rotvec_from_rotation(pose.rotation).tolist(),
            "translation": pose.translation.tolist(),
            "camera": "v2",
            "gps_position": [0.0, 0.0, 0.0],
        }
        for name, pose in list(POSES.items())[:count]
    }
    reference = {"latitude": 52.5, "longitude": 13.4, "altitude": 30.0}
    return {"cameras": {"v2": camera}, "shots": shots, "points": {}, "reference_lla": reference} | more


def written(folder: Path, data: Any) -> Path:
    path = folder / "reconstruction.json"
    path.write_text(json.dumps(data))
    return path


def test_the_largest_reconstruction_is_read(tmp_path: Path) -> None:
    written(tmp_path, [reconstruction(1), reconstruction(3)])
    found = read_poses(tmp_path)
    found.check()
    assert found.names == tuple(POSES)
    assert found.metric
    assert "metres" in found.scale
    for idx, pose in enumerate(POSES.values()):
        assert found.rotations[idx] == pytest.approx(pose.rotation, abs=1e-9)
        assert found.translations[idx] == pytest.approx(pose.translation, abs=1e-12)


def test_without_gps_the_unit_means_nothing(tmp_path: Path) -> None:
    reference = {"latitude": 0.0, "longitude": 0.0, "altitude": 0.0}
    assert not read_poses(written(tmp_path, [reconstruction(reference_lla=reference)])).metric


def test_its_pixels_are_ours(tmp_path: Path) -> None:
    """OpenSfM: bearing (cos lat sin lon, −sin lat, cos lat cos lon), u = lon / 2π, v = −lat / 2π, in picture widths
    from the picture's middle."""
    pose = read_poses(written(tmp_path, [reconstruction()])).cam_from_world(1)
    x, y, z = pose.apply((0.3, -0.8, 1.7))
    longitude, latitude = np.arctan2(x, z), np.arctan2(-y, np.hypot(x, z))
    u, v = longitude / (2 * np.pi), -latitude / (2 * np.pi)
    height, width = SIZE_HW
    expected = (width / 2 + u * width, height / 2 + v * width)
    assert pixel_from_ray((x, y, z), SIZE_HW) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("part", "what"),
    [
        (reconstruction(cameras={"v2": {"projection_type": "perspective"}}), "shot '1.jpg'.*perspective, expected"),
        (reconstruction(cameras={}), "projection_type is None"),
        (reconstruction(cameras=[]), "must be objects"),
        (reconstruction(shots={}), "contains no poses"),
        (reconstruction(shots={"a": 1}), "shot 'a': expected an object"),
        (reconstruction(shots={"a": {"camera": "v2", "rotation": [0, 0]}}), "key 'rotation' must hold 3 numbers"),
        (
            reconstruction(shots={"a": {"camera": "v2", "rotation": [0, 0, float("nan")], "translation": [0, 0, 0]}}),
            "key 'rotation' holds NaN",
        ),
    ],
)
def test_what_cannot_be_used_is_named(tmp_path: Path, part: dict[str, Any], what: str) -> None:
    with pytest.raises(InputError, match=rf"reconstruction\.json: .*{what}"):
        read_poses(written(tmp_path, [part]))
