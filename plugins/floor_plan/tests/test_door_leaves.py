"""Leaves of doors that stand open."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import ArrayLike
from pano_mvs_floor_plan.door_leaves import DoorLeaf, door_leaves
from pano_mvs_floor_plan.evidence import Evidence, PlanView, range_view
from pano_mvs_floor_plan.wall_lines import Line
from pano_mvs_floor_plan.walls_and_openings import plan_storey

from pano_mvs.algorithms.points.plan_grid import Extent, Storey
from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import Rigid3
from tests.synthetic.floor_plan_rooms import HEIGHT, Panel, flat_ranges

STOREY = Storey(0.0, 2.5, (0,))
DOOR = np.array([[1.0, 0.0], [1.9, 0.0]])
THICKNESS = 0.1


def surface(start: ArrayLike, end: ArrayLike, *, top: float = 2.5) -> FloatArray:
    """Return points of an upright surface, and their normals, (N, 6)."""
    first, last = np.array(start, np.float64), np.array(end, np.float64)
    along = (last - first) / np.linalg.norm(last - first)
    share, height = np.meshgrid(np.linspace(0, 1, 60), np.arange(0.02, top, 0.04))
    xy = first + share.reshape(-1, 1) * (last - first)
    normal = np.array([-along[1], along[0], 0.0])
    return np.column_stack([xy, height.reshape(-1), np.tile(normal, (len(xy), 1))])


LINES = [Line(np.array([0.0, 1.0]), 0.05)]
WALL = [surface((-2.0, 0.05), (1.0, 0.05)), surface((1.9, 0.05), (5.0, 0.05))]


def seen(*surfaces: FloatArray) -> PlanView:
    every = np.concatenate(surfaces)
    far = np.full((32, 64), np.inf)  # as if it saw through everything
    return PlanView(np.zeros(3), np.eye(3), far, far, far, np.zeros((32, 64), np.bool_), every[:, :3],
                    every[:, 3:], np.zeros(len(every)))  # fmt: skip


def leaf_of(*surfaces: FloatArray, lines: Sequence[Line] = LINES) -> DoorLeaf | None:
    (leaf,) = door_leaves(
        [(DOOR, THICKNESS)], views=lambda: [seen(*WALL, *surfaces)], lines=lines, storey=STOREY, cell=0.03
    )
    return leaf


@pytest.mark.parametrize("turn_deg", [40.0, 70.0, 100.0, 130.0])
@pytest.mark.parametrize(("side", "at_start"), [(1, True), (1, False), (-1, True), (-1, False)])
def test_a_leaf_is_found_where_it_is_hinged(turn_deg: float, side: int, at_start: bool) -> None:
    hinge = np.array([1.0 if at_start else 1.9, side * THICKNESS / 2])
    turn = np.deg2rad(turn_deg)
    way = np.array([np.cos(turn) if at_start else -np.cos(turn), side * np.sin(turn)])
    leaf = leaf_of(surface(hinge, hinge + 0.85 * way, top=2.0))
    assert leaf is not None
    np.testing.assert_allclose(leaf.hinge, hinge, atol=1e-9)
    assert np.linalg.norm(leaf.open_end - (hinge + 0.9 * way)) < 0.06
    np.testing.assert_allclose(leaf.closed_end, [1.9 if at_start else 1.0, side * THICKNESS / 2], atol=1e-9)


def test_what_is_no_leaf_is_none() -> None:
    assert leaf_of() is None
    assert leaf_of(surface((1.0, 0.05), (1.0, 2.5))) is None  # a wall, as it goes on
    corner = Line(np.array([-1.0, 0.0]), -1.0)
    assert leaf_of(surface((1.0, 0.05), (1.0, 0.95)), lines=[*LINES, corner]) is None  # a short wall that is known
    assert leaf_of(surface((1.0, 0.05), (1.0, 0.9), top=0.8)) is None  # a low cupboard
    assert leaf_of(surface((1.0, 0.05), (1.0, 0.4), top=2.0)) is None  # a shallow cupboard
    assert leaf_of(surface((1.45, 0.4), (1.45, 1.2), top=2.0)) is None  # in the middle of the passage


def test_without_views_there_is_none() -> None:
    assert door_leaves([(DOOR, 0.0)], views=list, lines=[], storey=STOREY, cell=0.03) == [None]


def leaf_in_flat(*panels: Panel) -> DoorLeaf | None:
    """Return the leaf of the door between two rooms, from exact ranges of what stands in the second one."""
    cams = [
        Rigid3.from_center(np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]), np.array([x, y, 1.5]))
        for x, y in ((1.0, 1.5), (3.0, 2.2), (5.5, 1.0), (5.8, 2.4))
    ]
    views = [range_view(flat_ranges(cam, turn=np.eye(2), size_hw=(256, 512), more=panels), cam) for cam in cams]
    evidence = Evidence(Storey(0.0, HEIGHT, (0,)), Extent(-0.3, 3.3, 0.03, (120, 260)))
    for view in views:
        evidence.add(view)
    cameras = np.array([cam.center[:2] for cam in cams])
    plan = plan_storey(evidence, [], views=lambda: views, cameras=cameras, min_share=0.4)
    (door,) = [one for one in plan.openings if one.kind == "door"]
    return door.leaf


@pytest.mark.slow
def test_a_leaf_is_found_in_ranges_and_a_wardrobe_is_none() -> None:
    hinge, free = np.array([4.2, 1.8]), np.array([5.05, 1.8])
    leaf = leaf_in_flat((hinge, free, 0.0, 1.98))
    assert leaf is not None
    np.testing.assert_allclose(leaf.hinge, hinge, atol=0.06)
    np.testing.assert_allclose(leaf.open_end, free, atol=0.12)
    back, front = np.array([4.2, 1.2]), np.array([5.05, 1.2])
    assert leaf_in_flat((hinge, free, 0.0, 1.98), (free, front, 0.0, 1.98), (back, front, 0.0, 1.98)) is None
    assert leaf_in_flat() is None
