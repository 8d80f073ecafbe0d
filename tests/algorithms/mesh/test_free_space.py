"""Parts of a surface that panoramas look through are removed, others stay."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.mesh.surface import FreeSpace, decimated
from pano_mvs.core.errors import UsageError
from pano_mvs.scene import RangeMap
from tests.algorithms.mesh.box import BOARD, Capture, box, capture, poses


def free(shown: Capture, maps: list[RangeMap]) -> NDArray[np.bool_]:
    """Which vertices of the box with the board are free, by panoramas of the box without it."""
    vertices, _, _ = box(4, board=True)
    space = FreeSpace(vertices)
    for view, range_map in zip(shown.views, maps, strict=True):
        space.add(range_map, view.cam_from_world, view.valid)
    return space.free()


def given_maps(shown: Capture) -> list[RangeMap]:
    return [view.range_map for view in shown.views if view.range_map is not None]


def on_board() -> NDArray[np.bool_]:
    vertices, faces, wall = box(4, board=True)
    on = np.zeros(len(vertices), np.bool_)
    on[faces[wall == BOARD]] = True
    return on


def test_a_board_that_is_not_there_is_removed_and_walls_stay() -> None:
    shown = capture(poses(3))
    found = free(shown, given_maps(shown))
    assert found[on_board()].all()
    assert not found[~on_board()].any()


def test_one_panorama_or_weak_ranges_remove_nothing() -> None:
    shown = capture(poses(3))
    maps = given_maps(shown)
    weak = [replace(one, confidence=np.full_like(one.confidence, 90)) for one in maps]
    assert not free(shown, weak).any()
    assert not free(shown, [maps[0], *weak[1:]]).any()


def test_one_panorama_that_sees_the_sky_is_enough() -> None:
    """The board is between the camera and the sky."""
    shown = capture(poses(1))
    size_hw = shown.views[0].valid.shape
    sky = RangeMap(np.full(size_hw, np.nan, np.float32), np.zeros(size_hw, np.uint8), sky=np.ones(size_hw, np.bool_))
    assert free(shown, [sky]).all()


def test_what_a_panorama_confirms_stays() -> None:
    """Two panoramas look through the board, a third one sees it."""
    shown = capture(poses(3))
    with_board = capture(poses(3), board=True)
    maps = [*given_maps(shown)[:2], given_maps(with_board)[2]]
    assert free(shown, maps)[on_board()].mean() < 0.5


def test_masks_must_fit() -> None:
    shown = capture(poses(1))
    with pytest.raises(UsageError, match="a mask of"):
        FreeSpace(box(1)[0]).add(given_maps(shown)[0], shown.views[0].cam_from_world, np.ones((4, 8), np.bool_))


def test_decimation_keeps_the_shape_and_reaches_its_number() -> None:
    vertices, faces, _ = box(16)
    fewer, triangles = decimated(vertices, faces, triangles=100)
    assert 12 <= len(triangles) <= 100
    np.testing.assert_allclose(np.abs(fewer).max(axis=0), np.abs(vertices).max(axis=0), atol=1e-4)
    assert triangles.max() == len(fewer) - 1
    same, unchanged = decimated(vertices, faces, triangles=10**6)
    np.testing.assert_array_equal(same[unchanged], vertices[faces])
