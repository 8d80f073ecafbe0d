"""The sky and what ran to a limit by chance come out invalid; surfaces stay."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.sweep.limits import limits_by_sweeping
from pano_mvs.algorithms.sweep.preparation import is_bare
from pano_mvs.algorithms.sweep.sweep import SweepSettings, sweep_range
from pano_mvs.geometry import Rigid3
from pano_mvs.scene import RangeMap
from pano_mvs.testing.room import capture_poses, default_room, render
from pano_mvs.testing.scenes import courtyard

SIZE = 96, 192


@pytest.fixture(scope="module")
def outdoors() -> tuple[list[NDArray[np.uint8]], tuple[Rigid3, ...], NDArray[np.float32]]:
    scene = courtyard(seed=3, views=3)
    views = [scene.view(idx, SIZE) for idx in range(3)]
    return [picture for picture, _ in views], scene.poses, views[0][1]


def swept(
    pictures: Sequence[NDArray[np.uint8]], poses: Sequence[Rigid3], limits: tuple[float, float], **settings: Any
) -> RangeMap:
    relative = [pose @ poses[0].inverse() for pose in poses[1:]]
    return sweep_range(
        pictures[0],
        pictures[1:],
        relative,
        near=limits[0],
        far=limits[1],
        settings=SweepSettings(planes=64).replace(**settings),
    )


def test_limits_outdoors_reach_as_far_as_the_pictures_can_tell(
    outdoors: tuple[list[NDArray[np.uint8]], list[Rigid3], NDArray[np.float32]],
) -> None:
    pictures, poses, truth = outdoors
    near, far = limits_by_sweeping(pictures, poses, masks=[np.ones(SIZE, np.bool_)] * 3)
    assert 0.1 * np.nanmin(truth) < near < np.nanquantile(truth, 0.02)
    assert far > np.nanmax(truth)


def test_the_sky_is_invalid_and_the_court_is_not(
    outdoors: tuple[list[NDArray[np.uint8]], list[Rigid3], NDArray[np.float32]],
) -> None:
    pictures, poses, truth = outdoors
    limits = limits_by_sweeping(pictures, poses, masks=[np.ones(SIZE, np.bool_)] * 3)
    found, kept = swept(pictures, poses, limits), swept(pictures, poses, limits, no_match="keep")
    found.check()
    sky = np.isnan(truth)
    assert sky.mean() > 0.15
    assert np.isnan(found.range[sky]).mean() > 0.8
    assert np.isfinite(kept.range).all()
    right = ~sky & (np.abs(kept.range / truth - 1) < 0.1)
    assert right.sum() > 0.7 * (~sky).sum()
    assert np.isfinite(found.range[right]).mean() > 0.995


def test_no_wall_is_lost_indoors() -> None:
    poses = capture_poses(3, seed=2)
    views = [render(default_room(2, "weak"), pose, SIZE) for pose in poses]
    pictures = [picture for picture, _ in views]
    found = swept(pictures, poses, (0.5, 8.0))
    assert found.valid.mean() > 0.999


def test_bare_pixels_at_a_limit_are_invalid_and_textured_ones_are_not() -> None:
    """All planes cost the same on what is bare: the first of equals wins, by nothing but its place."""
    plain, pictures = np.full((32, 64, 3), 90, np.uint8), np.full((2, 32, 64, 3), 90, np.uint8)
    pictures[0, :, :20] = np.random.default_rng(0).integers(0, 256, (32, 20, 3))
    bare = is_bare(pictures[0])
    assert bare[3:-3, 24:60].all()
    assert not bare[:, 1:19].any()
    found = swept([pictures[0], plain], capture_poses(2, seed=1), (0.5, 8.0), aggregation="box")
    assert (found.valid == ~bare).all()


def test_a_plane_that_can_be_told_from_infinity_keeps_what_has_texture(
    outdoors: tuple[list[NDArray[np.uint8]], list[Rigid3], NDArray[np.float32]],
) -> None:
    pictures, poses, truth = outdoors
    near = swept(pictures, poses, (1.0, 20.0))
    beyond = truth > 30
    assert np.isfinite(near.range[beyond & ~is_bare(pictures[0])]).mean() > 0.95
