"""matches.merge: of a pair in both stages the added geometry counts, unless only the other one is verified."""

from __future__ import annotations

from pano_mvs.scene import TwoView
from pano_mvs.stages.matches import merge
from pano_mvs.testing.tiny_capture import tiny_capture


def test_an_added_geometry_replaces_another_one_unless_only_that_is_verified() -> None:
    (one, first), (other, second), *_ = tiny_capture().each(TwoView).items()
    failed = TwoView.failed("chance")
    merged = merge({one: first, other: failed}, {one: failed, other: second, ("x", "y"): failed})
    assert merged.views == {one: first, other: second, ("x", "y"): failed}
    assert merge({one: failed}, {one: (again := TwoView.failed("again"))}).views == {one: again}
    assert merge({one: first}, {one: second}).views == {one: second}
    assert merge({one: first}, None).views == {one: first}
