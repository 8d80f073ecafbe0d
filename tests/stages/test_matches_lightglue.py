"""matches.lightglue compares only as many pairs of views as tell whether two images show the same."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.learned.lightglue import LightGlue, Side, few_and_all_matches, match_learned
from pano_mvs.algorithms.learned.networks import DESCRIPTOR_NORM, Array
from pano_mvs.algorithms.two_view.learned_pairs import Marks, is_settled
from pano_mvs.api import Context
from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import rotation_from_rotvec
from pano_mvs.scene import Features, TwoView
from pano_mvs.stages.matches import LightGlueParams, lightglue
from pano_mvs.testing.tiny_capture import tiny_capture
from tests.algorithms.poses.synthetic_capture import features_from_bearings


def seen(points: FloatArray, descriptors: NDArray[np.float32]) -> Features:
    """Learned key points of a level camera at the origin, whose scores fall from one to the next."""
    bearings = points / np.linalg.norm(points, axis=1, keepdims=True)
    count = len(points)
    features = replace(
        features_from_bearings(bearings),
        descriptors=np.rint(DESCRIPTOR_NORM * descriptors).astype(np.float32),
        scores=np.linspace(1, 0.1, count, dtype=np.float32),
        learned=count,
        ups=((0.0, -1.0, 0.0),),
        per_up=(count,),
    )
    features.check()
    return features


def pair(true: int, false: int) -> tuple[Features, Features]:
    """Two images with some points in common and others that are in one image only."""
    rng = np.random.default_rng(3)
    azimuth, height, distance = (rng.uniform(*ends, true + false) for ends in ((-3.0, 3.0), (-0.5, 0.4), (2.0, 8.0)))
    points = np.stack([np.sin(azimuth), height, np.cos(azimuth)], axis=1) * distance[:, None]
    descriptors = rng.normal(size=(len(points), 128)).astype(np.float32)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    moved = (points - [0.6, 0.0, 0.3]) @ rotation_from_rotvec([0.0, 0.2, 0.0]).T
    moved[true:] = rng.permutation(moved[true:])
    return seen(points, descriptors), seen(moved, descriptors)


@pytest.fixture
def compared(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, int]]:
    """The numbers of key points of the views that are compared: equal descriptors match."""
    found: list[tuple[int, int]] = []

    def match(
        self: LightGlue, first: Sequence[Array], second: Sequence[Array], *, min_score: float
    ) -> tuple[NDArray[np.intp], Array]:
        found.append((len(first[0]), len(second[0])))
        matched = np.argwhere(first[0] @ second[0].T > 0.99)
        return matched, np.ones(len(matched), np.float32)

    monkeypatch.setattr(LightGlue, "match", match)
    return found


@pytest.mark.parametrize(
    ("true", "false", "views"),
    [(900, 0, 3), (90, 300, 11), (0, 900, 3), (0, 0, 0)],
    ids=["clear", "unsure", "nothing in common", "no key points"],
)
def test_all_views_are_compared_only_if_the_first_do_not_settle_the_pair(
    compared: list[tuple[int, int]], tmp_path: Path, true: int, false: int, views: int
) -> None:
    found = lightglue(pair(true, false), LightGlueParams(), Context(np.random.default_rng(0), tmp_path))
    assert len(compared) == views
    assert bool(found) == (true == 900)


def test_the_first_views_are_compared_by_their_strongest_key_points(compared: list[tuple[int, int]]) -> None:
    first, second = pair(6000, 0)
    few, everything = few_and_all_matches(first, second, min_score=0.1, max_views=8)
    assert {*compared[:3]} == {(512, 512)}
    assert len(compared) == 3 + 8
    assert min(min(counts) for counts in compared[3:]) > 512
    assert 512 < len(few) < len(everything)
    assert np.array_equal(everything, match_learned(first, second))
    strongest, *_ = Side.of(first).inside(2, 40)
    inside, *_ = Side.of(first).inside(2)
    assert strongest.tolist() == inside[:40].tolist(), "scores fall from one key point to the next"


def test_a_pair_is_settled_if_it_is_clear_or_shows_no_sign_of_a_geometry() -> None:
    failed = TwoView.failed("chance")
    assert is_settled(failed, None)
    assert is_settled(replace(failed, log10_false_alarms=-4.0), None)
    assert not is_settled(replace(failed, log10_false_alarms=-12.0), None)
    assert not is_settled(replace(failed, geometry="rotation"), None), "other views may show a parallax"
    verified = next(iter(tiny_capture().each(TwoView).values()))
    marks = Marks(tilt=0.1, floor=1.0, near=0.0, parallax=4.0, open=-3.0)
    assert is_settled(replace(verified, log10_false_alarms=-120.0), marks)
    assert not is_settled(replace(verified, log10_false_alarms=-80.0), marks)
    # With walls, odds have to be clear as well: by the most similar views, copies of a room look like one.
    for walls, is_clear in ((-2.0, True), (1.5, False)):
        with_walls = marks._replace(walls=walls, level=-1.0)
        assert is_settled(replace(verified, log10_false_alarms=-120.0), with_walls) == is_clear
