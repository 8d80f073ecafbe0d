"""matches.merge: of a pair in both stages the added geometry counts, even if it is not verified."""

from __future__ import annotations

from pano_mvs.scene import TwoView
from pano_mvs.stages.matches import merge
from pano_mvs.testing.tiny_capture import tiny_capture


def test_an_added_geometry_replaces_another_one() -> None:
    (one, first), (other, second), *_ = tiny_capture().each(TwoView).items()
    failed = TwoView.failed("chance")
    merged = merge({one: first, other: failed}, {one: failed, other: second, ("x", "y"): failed})
    assert merged.views == {one: failed, other: second, ("x", "y"): failed}
    assert merge({one: first}, {one: second}).views == {one: second}
    assert merge({one: first}, None).views == {one: first}
