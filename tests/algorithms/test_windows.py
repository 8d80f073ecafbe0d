"""A window is a bright rectangle with sharp edges in a wall, on which nothing is confirmed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.structure.lay import lay_structure
from pano_mvs.algorithms.structure.view import plane_view
from pano_mvs.algorithms.structure.windows import window_labels
from pano_mvs.core.arrays import Mask, Picture
from pano_mvs.scene import RangeMap
from pano_mvs.scene.range_map import CONSISTENT_CONFIDENCE, WEAK_CONFIDENCE, WINDOW_CONFIDENCE, confidence_name
from tests.synthetic.window_room import LABEL, PANE, PLACES, PLANES, POSE, RANGES, range_map, room, structure


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


def test_a_window_has_the_range_of_its_wall() -> None:
    own = range_map(WEAK_CONFIDENCE[0])
    far = RangeMap(np.where(PANE, 4 * own.range, own.range).astype(np.float32), own.confidence)
    laid, _ = lay_structure(far, room(235.0), structure(), cam_from_world=POSE, sources=[])
    laid.check()
    window = laid.confidence == WINDOW_CONFIDENCE
    assert confidence_name(WINDOW_CONFIDENCE) == "window"
    assert overlap(window, PANE) > 0.9
    np.testing.assert_allclose(laid.range[window], RANGES[0][window], rtol=1e-5)
