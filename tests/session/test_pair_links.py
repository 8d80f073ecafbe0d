"""The report shows all pairs of the stages that were used, also those that a stage which judges all pairs added."""

from __future__ import annotations

import numpy as np

from pano_mvs.results.records import PairLink
from pano_mvs.scene import TwoView
from pano_mvs.session.summarise import pair_links


def _view(matches: int, candidates: int) -> TwoView:
    matches_idx = np.tile(np.arange(matches, dtype=np.int32)[:, None], (1, 2))
    residuals = np.full(matches, np.deg2rad(0.1), np.float32)
    return TwoView(matches_idx, np.eye(3), np.array([1.0, 0, 0]), residuals, "general", candidates=candidates)


def test_pairs_of_a_later_stage_replace_rejected_ones_and_are_added() -> None:
    matched: dict[tuple[str, ...], dict[str, float]] = {
        ("a", "b"): {"candidates": 80.0, "inliers": 60.0, "residual_deg": 0.05},
        ("b", "c"): {"candidates": 30.0, "inliers": 0.0},
        ("a", "c"): {"candidates": 20.0},
    }
    later: dict[tuple[str, str], TwoView] = {
        ("a", "b"): _view(50, 70),
        ("b", "c"): _view(12, 33),
        ("a", "c"): TwoView.failed("too few"),
        ("c", "d"): _view(9, 15),
    }
    assert pair_links(matched, later) == (
        PairLink("a", "b", 60, 80, 0.05),
        PairLink("b", "c", 12, 33, 0.1),
        PairLink("a", "c", 0, 20, None),
        PairLink("c", "d", 9, 15, 0.1),
    )
    assert pair_links(matched, {})[1] == PairLink("b", "c", 0, 30, None)
