"""A window is a bright rectangle with sharp edges in a wall, on which nothing is confirmed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pano_mvs_floor_plan.evidence import range_view

from pano_mvs.algorithms.structure.lay import lay_structure
from pano_mvs.algorithms.structure.view import ScenePlane, plane_ranges, plane_view
from pano_mvs.algorithms.structure.windows import window_labels
from pano_mvs.core.arrays import Mask, Picture
from pano_mvs.geometry import Rigid3, ray_grid
from pano_mvs.scene import RangeMap
from pano_mvs.scene.range_map import CONSISTENT_CONFIDENCE, WEAK_CONFIDENCE, WINDOW_CONFIDENCE, confidence_name
from pano_mvs.scene.surfaces import Structure

SIZE = 256, 512
POSE = Rigid3(np.eye(3), np.zeros(3))
NORMALS = np.array([(0, 0, -1), (0, 0, 1), (-1, 0, 0), (1, 0, 0), (0, -1, 0), (0, 1, 0)], np.float64)
OFFSETS = np.array([-3.0, -2.0, -2.5, -2.5, -1.5, -1.2])
PLANES = [
    ScenePlane(normal, float(offset), 1.0, 0.002, is_level=bool(normal[1]))
    for normal, offset in zip(NORMALS, OFFSETS, strict=True)
]
RAYS = ray_grid(SIZE)
RANGES = np.array([plane_ranges(RAYS, np.zeros(3), normal=one.normal, offset=one.offset) for one in PLANES])
LABEL = np.nanargmin(RANGES, axis=0).astype(np.int16)
PLACES = RAYS * np.nanmin(RANGES, axis=0)[..., None]
PANE: Mask = (LABEL == 0) & (np.abs(PLACES[..., 0] - 0.3) < 0.7) & (np.abs(PLACES[..., 1] + 0.1) < 0.6)


def room(pane: NDArray[np.generic] | float) -> Picture:
    """Return a room with grey walls, and the grey level of a pane."""
    wall = 150 + 10 * NORMALS[LABEL, 0] - 20 * (LABEL > 3)
    bar = np.abs(PLACES[..., 0] - 0.3) < 0.03
    return np.repeat(np.where(PANE & ~bar, pane, wall)[..., None], 3, axis=2).astype(np.uint8)


def range_map(confidence: int) -> RangeMap:
    """Return the true ranges, with a confidence."""
    return RangeMap(np.nanmin(RANGES, axis=0).astype(np.float32), np.full(SIZE, confidence, np.uint8))


def found(picture: Picture, own: RangeMap) -> NDArray[np.int16]:
    """Return the labels of the windows that the view shows."""
    return window_labels(plane_view(own, lambda: picture, POSE), LABEL, PLANES)


def overlap(mask: Mask, pane: Mask) -> float:
    """Return the intersection of two areas as a share of their union."""
    return float((mask & pane).sum() / (mask | pane).sum())


def test_a_bright_rectangle_is_a_window() -> None:
    labels = found(room(235.0), range_map(WEAK_CONFIDENCE[0]))
    assert set(np.unique(labels)) == {-1, 0}
    assert overlap(labels == 0, PANE) > 0.9


def test_a_poster_that_is_confirmed_on_the_wall_is_none() -> None:
    assert (found(room(235.0), range_map(CONSISTENT_CONFIDENCE[1])) < 0).all()


def test_what_is_darker_than_other_surfaces_is_none() -> None:
    picture = room(190.0)
    picture[LABEL > 3] = 200
    assert (found(picture, range_map(WEAK_CONFIDENCE[0])) < 0).all()


def test_the_light_of_a_lamp_has_no_edges() -> None:
    away = np.linalg.norm(PLACES - np.array([0.3, -0.1, 3.0]), axis=-1)
    picture = np.repeat((140 + 110 * np.exp(-((away / 0.8) ** 2)))[..., None], 3, axis=2).astype(np.uint8)
    assert (found(picture, range_map(WEAK_CONFIDENCE[0])) < 0).all()


def test_a_window_has_the_range_of_its_wall_and_opens_the_plan() -> None:
    own = range_map(WEAK_CONFIDENCE[0])
    far = RangeMap(np.where(PANE, 4 * own.range, own.range).astype(np.float32), own.confidence)
    group = np.zeros(len(PLANES), np.int32)
    structure = Structure(NORMALS, OFFSETS, np.full(len(PLANES), 0.002), group)
    laid, _ = lay_structure(far, room(235.0), structure, cam_from_world=POSE, sources=[])
    laid.check()
    window = laid.confidence == WINDOW_CONFIDENCE
    assert confidence_name(WINDOW_CONFIDENCE) == "window"
    assert overlap(window, PANE) > 0.9
    np.testing.assert_allclose(laid.range[window], RANGES[0][window], rtol=1e-5)
    view = range_view(laid, POSE)
    assert (view.panes == window).all()
    assert np.isfinite(view.seen[window]).all()
    assert np.isnan(view.free[window]).all()
