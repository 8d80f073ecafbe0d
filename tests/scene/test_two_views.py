"""A collection of two-view geometries is stored and read without loss, and gives its pairs one by one."""

from __future__ import annotations

import numpy as np

from pano_mvs.scene import TwoView, TwoViews
from pano_mvs.testing.stage_calls import digest_of
from pano_mvs.testing.tiny_capture import tiny_capture


def test_stores_pairs_with_and_without_runners_up() -> None:
    views = tiny_capture().each(TwoView)
    first = next(iter(views))
    views[first] = views[first].with_alternatives([views[first]])
    views[("x", "y")] = TwoView.failed("no overlap", candidates=3)
    record = TwoViews(views)
    record.check()
    again = TwoViews.from_parts(record.to_parts())
    assert list(again.views) == list(views)
    for pair, view in views.items():
        assert digest_of(again.views[pair]) == digest_of(view)
    assert [*record.explode().values()] == [*views.values()]
    assert len(again.views[first].alternatives) == 1
    assert not again.views["x", "y"]
    assert np.array_equal(again.views[first].matches_idx, views[first].matches_idx)
