"""A window opens the plan: nobody can walk through it, and what lies behind it is seen."""

from __future__ import annotations

import numpy as np
from pano_mvs_floor_plan.evidence import range_view

from pano_mvs.algorithms.structure.lay import lay_structure
from pano_mvs.scene import RangeMap
from pano_mvs.scene.range_map import WEAK_CONFIDENCE, WINDOW_CONFIDENCE
from tests.synthetic.window_room import PANE, POSE, range_map, room, structure


def test_a_window_opens_the_plan() -> None:
    own = range_map(WEAK_CONFIDENCE[0])
    far = RangeMap(np.where(PANE, 4 * own.range, own.range).astype(np.float32), own.confidence)
    laid, _ = lay_structure(far, room(235.0), structure(), cam_from_world=POSE, sources=[])
    window = laid.confidence == WINDOW_CONFIDENCE
    assert window.any()
    view = range_view(laid, POSE)
    assert (view.panes == window).all()
    assert np.isfinite(view.seen[window]).all()
    assert np.isnan(view.free[window]).all()
