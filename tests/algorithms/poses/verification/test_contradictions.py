"""Pairs that contradict a part of a model, weighed against those that hold it."""

from __future__ import annotations

import numpy as np
import pytest

from pano_mvs.algorithms.poses.placement.placed_model import Pairs, PlacedModel
from pano_mvs.algorithms.poses.verification.contradictions import contradicted_parts
from pano_mvs.algorithms.poses.verification.correct_cameras import CameraChecks, check_cameras
from pano_mvs.geometry import Rigid3, rotation_from_rotvec
from pano_mvs.scene import TwoView

TURN = rotation_from_rotvec((0.0, np.pi / 2, 0.0))
CAMERAS = {
    image: Rigid3.from_center(rotation_from_rotvec((0.0, 0.7 * image, 0.0)), np.array([2.0 * image, 0.0, image % 2]))
    for image in range(6)
}


def seen(first: Rigid3, second: Rigid3, *, matches: int = 40, exponent: float = -100.0) -> TwoView:
    """The two-view geometry of two cameras."""
    relative = second @ first.inverse()
    return TwoView(
        matches_idx=np.zeros((matches, 2), np.int32),
        rotation=relative.rotation,
        direction=relative.translation / np.linalg.norm(relative.translation),
        residuals_rad=np.zeros(matches, np.float32),
        geometry="general",
        log10_false_alarms=exponent,
    )


def placed(views: dict[tuple[int, int], TwoView]) -> PlacedModel:
    """A model with the cameras, and with pairs as a matcher has found them."""
    pairs = Pairs.without([f"{image}.png" for image in CAMERAS])
    object.__setattr__(pairs, "compared", views)
    return PlacedModel(pairs, dict(CAMERAS))


def wrong(first: int, second: int, *, matches: int = 40, exponent: float = -100.0) -> TwoView:
    """A pair that would have the second camera elsewhere."""
    other = CAMERAS[second]
    there = Rigid3.from_center(other.rotation @ TURN, TURN @ other.center + np.array([0.0, 0.0, 7.0]))
    return seen(CAMERAS[first], there, matches=matches, exponent=exponent)


def consecutive() -> dict[tuple[int, int], TwoView]:
    return {(a, b): seen(CAMERAS[a], CAMERAS[b]) for a in CAMERAS for b in range(a + 1, a + 4) if b in CAMERAS}


def test_a_right_model_has_no_contradicted_part() -> None:
    assert contradicted_parts(placed(consecutive()), {}) == []


@pytest.mark.parametrize(
    ("elsewhere", "part"),
    [
        ([(2, 5), (3, 5), (4, 5)], (5,)),
        ([(1, 4), (2, 4), (3, 4), (2, 5), (3, 5)], (4, 5)),
        ([(2, 3)], ()),
    ],
)
def test_the_part_is_found_that_pairs_have_elsewhere(elsewhere: list[tuple[int, int]], part: tuple[int, ...]) -> None:
    """One false pair among several true ones makes no part; all that cross a cut make one, of one camera or a room."""
    parts = contradicted_parts(placed(consecutive() | {pair: wrong(*pair) for pair in elsewhere}), {})
    assert [one.images for one in parts] == ([part] if part else [])
    if part:
        assert parts[0].share == pytest.approx(1.0)
        assert parts[0].pair in elsewhere


def test_a_pair_counts_by_how_clearly_it_decides() -> None:
    """A false geometry with nearly as many matches leaves a pair undecided, so that a weaker pair can contradict it."""
    undecided = seen(CAMERAS[4], CAMERAS[5]).with_alternatives([wrong(4, 5, matches=38)])
    views = {pair: view for pair, view in consecutive().items() if 5 not in pair}
    against = {(3, 5): wrong(3, 5, exponent=-30.0)}
    held = contradicted_parts(placed(views | against | {(4, 5): seen(CAMERAS[4], CAMERAS[5])}), {})
    assert held == []
    (part,) = contradicted_parts(placed(views | against | {(4, 5): undecided}), {})
    assert part.images == (5,)
    assert part.share == pytest.approx(30 / 35)


def test_both_sides_are_named_if_they_are_equally_large() -> None:
    views = {pair: view for pair, view in consecutive().items() if (pair[0] < 3) == (pair[1] < 3)}
    (part,) = contradicted_parts(placed(views | {(2, 3): wrong(2, 3)}), {})
    assert part.images == tuple(CAMERAS)


def test_cameras_of_a_contradicted_part_are_doubtful_with_the_pair_that_speaks_against_them() -> None:
    model = placed(consecutive() | {pair: wrong(*pair) for pair in ((2, 5), (3, 5), (4, 5))})
    checks: CameraChecks = check_cameras(model)
    assert [image for image, why in checks.doubts.items() if "evidence of pairs" in why] == [5]
    assert "2.png and 5.png" in checks.doubts[5]


def test_a_part_that_the_images_confirm_or_that_little_contradicts_is_left_out() -> None:
    contradicted = placed(consecutive() | {pair: wrong(*pair) for pair in ((2, 5), (3, 5), (4, 5))})
    assert [len(contradicted_parts(contradicted, {5: share})) for share in (np.nan, 0.4, 0.6)] == [1, 1, 0]
    one_of_five = placed(consecutive() | {(2, 3): wrong(2, 3)})
    assert contradicted_parts(one_of_five, {}) == []
    (part,) = contradicted_parts(one_of_five, {}, more_than=0.1)
    assert part.images == (2,)
    assert part.share == pytest.approx(0.2)
