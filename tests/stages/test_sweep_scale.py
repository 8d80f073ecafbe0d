"""The resolution of depth.sweep: that at which the panorama is sharp, up to twice that, or its own."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from pano_mvs.engine.stages.context import Context
from pano_mvs.geometry import Rigid3
from pano_mvs.scene import FilePart, Panorama, Pose, RangeMap
from pano_mvs.stages import depth

SIZE = (128, 256)


@pytest.mark.parametrize(
    ("scale", "halvings", "rows"),
    [
        ("nominal", 2, 128),
        ("finer", 2, 64),
        ("sharp", 2, 32),
        ("finer", 1, 128),
        ("sharp", 1, 64),
        ("finer", 0, 128),
        ("sharp", 0, 128),
    ],
)
def test_a_blurred_panorama_is_swept_at_a_lower_resolution(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, scale: Any, halvings: int, rows: int
) -> None:
    swept: list[tuple[int, ...]] = []

    def sweep_range(reference: Any, *_: Any, **__: Any) -> RangeMap:
        swept.append(reference.shape)
        size = reference.shape[:2]
        return RangeMap(np.full(size, 2.0, np.float32), np.full(size, 100, np.uint8))

    monkeypatch.setattr(depth, "sharp_halvings", lambda picture: halvings)
    monkeypatch.setattr(depth, "sweep_range", sweep_range)
    path = tmp_path / "a.png"
    cv2.imwrite(str(path), np.full((*SIZE, 3), 128, np.uint8))
    panorama = Panorama(FilePart(path), SIZE, SIZE)
    found = depth.sweep(
        ref=panorama,
        pose=Pose(Rigid3.identity()),
        sources=[panorama],
        source_poses=[Pose(Rigid3(np.eye(3), np.ones(3)))],
        params=depth.SweepParams(scale=scale, near=1.0, far=9.0),
        ctx=Context(np.random.default_rng(0), tmp_path),
    )
    assert swept == [(rows, 2 * rows, 3)]
    assert found.range.shape == SIZE, "the result has the size of the panorama"


@pytest.mark.parametrize(
    ("settings", "rows"), [({}, [32, 64, 128]), ({"multiscale": False}, [128]), ({"scale": "nominal"}, [128])]
)
def test_a_large_panorama_is_swept_at_coarser_resolutions_as_well(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, settings: Any, rows: list[int]
) -> None:
    swept: list[int] = []

    def sweep_range(reference: Any, sources: Any, *_: Any, source_masks: Any, **__: Any) -> RangeMap:
        size = reference.shape[:2]
        assert sources[0].shape[:2] == source_masks[0].shape == size
        swept.append(size[0])
        return RangeMap(np.full(size, float(size[0]), np.float32), np.full(size, 100, np.uint8))

    monkeypatch.setattr(depth, "sharp_halvings", lambda picture: 0)
    monkeypatch.setattr(depth, "coarser_levels", lambda size_hw: 2)
    monkeypatch.setattr(depth, "sweep_range", sweep_range)
    path = tmp_path / "a.png"
    cv2.imwrite(str(path), np.full((*SIZE, 3), 128, np.uint8))
    panorama = Panorama(FilePart(path), SIZE, SIZE)
    found = depth.sweep(
        ref=panorama,
        pose=Pose(Rigid3.identity()),
        sources=[panorama],
        source_poses=[Pose(Rigid3(np.eye(3), np.ones(3)))],
        params=depth.SweepParams(near=1.0, far=9.0, **settings),
        ctx=Context(np.random.default_rng(0), tmp_path),
    )
    assert swept == rows
    # Without any detail, the coarsest ranges are left.
    np.testing.assert_allclose(found.range, rows[0])
