"""Mirrors are found by what the room predicts in them, and have the range of their pane."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pano_mvs.algorithms.fusion.fuse import fuse_stream
from pano_mvs.algorithms.fusion.settings import FusionSettings
from pano_mvs.algorithms.fusion.view import FusionView
from pano_mvs.algorithms.structure.mirrors import find_mirrors, pane_ranges, with_mirrors
from pano_mvs.algorithms.structure.view import PlaneView, ScenePlane, plane_view
from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import Rigid3, ray_grid
from pano_mvs.scene import RangeMap
from pano_mvs.scene.range_map import MIRROR_CONFIDENCE, confidence_name
from pano_mvs.scene.surfaces import Structure
from tests.algorithms.range_scenes import TRUSTED, as_map
from tests.synthetic.mirrors import HIGH_XY, LOW_XY, WALL_Z, mirror_room, shows_mirror
from tests.synthetic.scenes import Scene, weak_room

SIZE, FINE_SIZE = (128, 256), (256, 512)
WALLS = [
    ScenePlane(np.array(normal), offset, 1.0, 0.002, is_level=False)
    for normal, offset in (((0.0, 0.0, -1.0), -2.5), ((0.0, 0.0, 1.0), -2.5), ((1.0, 0.0, 0.0), -3.0))
]
CORNERS = np.array([[(x, y, WALL_Z) for x, y in zip((-1.2, 0.4, 0.4, -1.2), (-0.9, -0.9, 0.5, 0.5), strict=True)]])


def views_of(scene: Scene, *, phantom: bool) -> list[PlaneView]:
    """Return the views of a scene with their true ranges; with `phantom`, with other ranges in the mirror."""
    views = []
    for idx, pose in enumerate(scene.poses):
        picture, ranges = scene.view(idx, FINE_SIZE, supersample=1)
        seen = np.where(shows_mirror(scene, idx, ranges), 2.2 * ranges, ranges) if phantom else ranges
        views.append(plane_view(as_map(seen, TRUSTED), lambda picture=picture: picture, pose))  # type: ignore[misc]
    return views


@pytest.mark.slow
def test_a_mirror_is_found_where_the_frame_ends() -> None:
    views = views_of(mirror_room(seed=0, exposure=0.1), phantom=True)
    (corners,) = find_mirrors(views, WALLS)
    # The frame is 8 cm wide; a cell is 2 cm.
    np.testing.assert_allclose(corners.min(axis=0), (*LOW_XY, 2.5), atol=0.15)
    np.testing.assert_allclose(corners.max(axis=0), (*HIGH_XY, 2.5), atol=0.15)


@pytest.mark.slow
def test_walls_and_what_is_seen_before_them_are_no_mirrors() -> None:
    views = views_of(weak_room(seed=0), phantom=False)
    assert not find_mirrors(views, WALLS)


def test_one_view_alone_shows_no_mirror() -> None:
    views = views_of(mirror_room(seed=0, views=1), phantom=True)
    assert not find_mirrors(views, WALLS)


def structure(corners: FloatArray = CORNERS, group: int = 0) -> Structure:
    none = np.zeros(0)
    return Structure(
        none.reshape(0, 3), none, none, none.astype(np.int32), corners, np.full(len(corners), group, np.int32)
    )


def test_the_range_in_a_mirror_is_that_of_its_pane() -> None:
    scene = mirror_room(seed=0)
    structure().check()
    ranges = scene.view(1, SIZE, supersample=1)[1]
    mirror = shows_mirror(scene, 1, ranges)
    own = as_map(np.where(mirror, 2.2 * ranges, ranges), TRUSTED)
    result = with_mirrors(own, structure(), scene.poses[1])
    result.check()
    # Rays that meet the frame's edge may pass it on either side.
    assert np.mean(np.isclose(result.range[mirror], ranges[mirror])) > 0.998
    assert np.mean((result.confidence == MIRROR_CONFIDENCE) == mirror) > 0.9998
    assert np.mean(result.range[~mirror] == own.range[~mirror]) > 0.9998
    assert confidence_name(MIRROR_CONFIDENCE) == "mirror"
    assert with_mirrors(own, structure(group=1), scene.poses[1]) is own
    masked = with_mirrors(own, structure(), scene.poses[1], valid=np.zeros(SIZE, np.bool_))
    np.testing.assert_array_equal(masked.range, own.range)


def test_things_before_a_mirror_keep_their_ranges() -> None:
    scene = mirror_room(seed=0)
    ranges = scene.view(1, SIZE, supersample=1)[1]
    mirror = shows_mirror(scene, 1, ranges)
    own = as_map(np.where(mirror, 0.8 * ranges, ranges), TRUSTED)
    np.testing.assert_array_equal(with_mirrors(own, structure(), scene.poses[1]).range[mirror], own.range[mirror])
    filled = replace(own, confidence=np.full(SIZE, 30, np.uint8))
    assert (with_mirrors(filled, structure(), scene.poses[1]).confidence == MIRROR_CONFIDENCE).any()
    # A wall of another room that no ranges but the planes of the place show is in front of it as well.
    wall = with_mirrors(filled, structure(), scene.poses[1], laid=np.ones(SIZE, np.bool_))
    np.testing.assert_array_equal(wall.range[mirror], own.range[mirror])


def test_the_sky_has_no_range_in_a_mirror() -> None:
    sky = np.ones((8, 16), np.bool_)
    own = replace(as_map(np.full((8, 16), np.nan)), sky=sky)
    assert np.isnan(with_mirrors(own, structure(), Rigid3.identity()).range).all()


def test_a_mirror_is_seen_from_its_front_alone() -> None:
    ahead, (corners,) = np.array([0.0, 0.0, 1.0]), CORNERS
    assert pane_ranges(ahead, np.array([0.0, 0.0, 0.5]), corners) == pytest.approx(WALL_Z - 0.5)
    assert np.isnan(pane_ranges(-ahead, np.array([0.0, 0.0, 4.0]), corners))
    assert np.isnan(pane_ranges(ahead, np.array([0.5, 0.0, 0.5]), corners))


@pytest.mark.parametrize("min_confidence", [64, 1])
def test_a_cloud_has_nothing_of_a_mirror_or_of_the_room_behind_it(min_confidence: int) -> None:
    scene = mirror_room(seed=0, views=2, turned=False)
    seen_by = [scene.view(idx, SIZE, supersample=1) for idx in range(2)]

    def fused(given: Structure) -> FloatArray:
        views = []
        for idx, pose in enumerate(scene.poses):
            picture, ranges = seen_by[idx]
            # As if a wall 1 behind the pane were seen in it.
            behind = pane_ranges(ray_grid(SIZE) @ pose.rotation, pose.center, CORNERS[0] + (0.0, 0.0, 1.0))
            seen = as_map(np.where(shows_mirror(scene, idx, ranges), behind, ranges), TRUSTED)
            views.append(FusionView(with_mirrors(seen, given, pose), pose, picture, np.ones(SIZE, np.bool_)))
        cloud = fuse_stream(scene.poses, views.__getitem__, FusionSettings(min_views=2, min_confidence=min_confidence))
        return np.asarray(cloud.points_in_world, np.float64)

    assert (fused(structure(CORNERS[:0]))[:, 2] > 3).any()
    without = fused(structure())
    assert not (without[:, 2] > 2.6).any()
    low, high = CORNERS[0].min(axis=0) + 0.1, CORNERS[0].max(axis=0) - 0.1
    assert not ((without > low) & (without < high))[:, :2].all(axis=1)[without[:, 2] > 2.4].any()


def test_range_maps_without_optional_parts_have_mirrors() -> None:
    own = RangeMap(np.ones((8, 16), np.float32), np.full((8, 16), 200, np.uint8))
    around = with_mirrors(own, structure(), Rigid3.identity())
    assert around.uncertainty is None
    around.check()
