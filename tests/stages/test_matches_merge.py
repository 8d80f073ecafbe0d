"""matches.merge: of a pair in both stages the added geometry counts; so do the links of a tour."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pano_mvs.api import Context
from pano_mvs.scene import Panorama, SceneLink, TwoView
from pano_mvs.scene.record import FilePart
from pano_mvs.stages.matches import merge
from pano_mvs.testing.tiny_capture import tiny_capture
from tests.algorithms.two_view.test_linked_pairs import FIRST, SECOND, azimuth_deg, pair


@pytest.fixture
def ctx(tmp_path: Path) -> Context:
    return Context(np.random.default_rng(0), tmp_path)


def test_an_added_geometry_replaces_another_one(ctx: Context) -> None:
    (one, first), (other, second), *_ = tiny_capture().each(TwoView).items()
    failed = TwoView.failed("chance")
    merged = merge({one: first, other: failed}, {one: failed, other: second, ("x", "y"): failed}, None, None, ctx)
    assert merged.views == {one: failed, other: second, ("x", "y"): failed}
    assert merge({one: first}, {one: second}, None, None, ctx).views == {one: second}
    assert merge({one: first}, None, None, None, ctx).views == {one: first}
    assert ctx.notes == []


def test_links_of_a_tour_that_confirm_or_contradict_matches_are_reported(ctx: Context) -> None:
    features, refused, accepted = pair()
    plain = Panorama(FilePart(Path("a.jpg")), (512, 1024), (512, 1024))

    def linked(off_deg: float) -> dict[str, Panorama]:
        there, back = (azimuth_deg(end) + off_deg for end in (FIRST, SECOND))
        return {
            "a": replace(plain, links=(SceneLink("b", (there, -20.0)),)),
            "b": replace(plain, links=(SceneLink("a", (back, 0.0)), SceneLink("c"))),
        }

    assert merge({}, {("a", "b"): refused}, features, linked(3.0), ctx).views["a", "b"]
    assert ctx.notes == ["links of the tour confirm the matches of 1 pair: a and b"]
    assert ctx.metrics["by_links"] == 1
    ctx.notes.clear()
    assert not merge({}, {("a", "b"): accepted}, features, linked(120.0), ctx).views["a", "b"]
    assert ctx.notes == ["links of the tour contradict the matches of 1 pair: a and b"]
