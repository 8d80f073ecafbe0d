"""Agreement between views: true ranges are confirmed, doubtful views are found, and uncertainty follows the scatter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from pano_mvs.algorithms.filters.consistency import (
    Agreement,
    _step_around,
    check_consistency,
    checked_with_agreement,
    evidence_of_views,
    nearest_views,
)
from pano_mvs.algorithms.filters.uncertainty import (
    EXPONENTS,
    FACTOR,
    UNCONFIRMED_UNCERTAINTY,
    confirmed_uncertainty,
    probability_within,
    with_ranges,
)
from pano_mvs.algorithms.ranges.agreement import Comparison, agreeing_sources, compare_with_sources, seen_ranges
from pano_mvs.algorithms.ranges.kernels_agreement import compare_rows, count_agreeing
from pano_mvs.core.errors import ContractError, UsageError
from pano_mvs.geometry import Rigid3, ray_grid, roll_panorama, sines_of_grid
from pano_mvs.scene import RangeMap
from pano_mvs.testing.room import capture_poses, default_room
from tests.algorithms.range_scenes import as_map, random_map, rolled, room_range
from tests.oracles import range_filters as oracle

SIZE = (128, 256)
POSES = capture_poses(4, seed=1, spread=0.4)
# At this size true ranges, too, are seen at less parallax than is asked for by default.
LIMITS: dict[str, Any] = {"max_relative_error": 0.02, "max_reprojection_px": 1.0, "min_motion_px": 0.01}


@pytest.fixture(scope="module")
def true_maps() -> list[RangeMap]:
    room = default_room()
    return [as_map(room_range(room, pose, SIZE)) for pose in POSES]


def checked(maps: Sequence[RangeMap], **settings: Any) -> RangeMap:
    return check_consistency(maps[0], POSES[0], maps[1:], source_poses=POSES[1:], **LIMITS | settings)


@pytest.mark.kernel("ranges.kernels_agreement")
@pytest.mark.parametrize("size", [(12, 24), (13, 20)])
def test_compiled_verdicts_equal_the_plain_ones(size: tuple[int, int]) -> None:
    """On maps without any order, seen from all over: every branch, the seam and the poles."""
    rng = np.random.default_rng(0)
    pose = capture_poses(2, seed=3, tilt_deg=60)[1]
    reference, source = random_map(rng, size), random_map(rng, (16, 32))
    smooth = as_map(2 + 0.02 * rng.random((16, 32)))
    for ranges in (source.range, smooth.range):
        limits = (0.2, 3 * 2 * np.pi / size[1], 0.3)
        view = pose.rotation, pose.translation
        counts = np.zeros(size, np.uint16), np.zeros(size, np.uint16), np.zeros(size, np.uint16)
        sums = np.zeros(size), np.zeros(size), np.zeros(size)
        for rows in ((0, 5), (5, size[0])):
            compare_rows(rows, reference.range, sines_of_grid(size), view, ranges, limits, counts, sums)
        expected, supports, motions = oracle.judge(reference.range, pose, ranges, 0.2, 3, 0.3)
        assert len(np.unique(expected)) == 4
        for verdict, count in enumerate(counts, start=1):
            np.testing.assert_array_equal(count, expected == verdict)
        squared_errors = supports * limits[1] ** 2 * (1 - np.sqrt(supports))
        for found, plain in zip(sums, (supports, supports * motions, squared_errors), strict=True):
            np.testing.assert_allclose(found, plain, rtol=1e-3, atol=1e-6)
        agreeing = np.zeros(size, np.uint8)
        rays = ray_grid(size).reshape(-1, 3)
        points = rays * reference.range.reshape(-1, 1)
        count_agreeing(points, view, ranges, limits, 1, agreeing.ravel())
        np.testing.assert_array_equal(agreeing, expected == 1)


def test_sources_that_agree_are_counted_alone_or_with_all_figures(true_maps: list[RangeMap]) -> None:
    moved = [pose @ POSES[0].inverse() for pose in POSES[1:]]
    limits: dict[str, Any] = {"max_relative_error": 0.02, "max_angle": 0.03}
    points = (ray_grid(SIZE) * true_maps[0].range[..., None]).reshape(-1, 3)
    known = [seen_ranges(true, min_confidence=64) for true in true_maps[1:]]
    found = agreeing_sources(points, known, moved, **limits)
    expected = compare_with_sources(true_maps[0].range, true_maps[1:], moved, **limits).agreeing.ravel()
    assert found.max() == len(moved)
    np.testing.assert_array_equal(found, expected)
    enough = agreeing_sources(points, known, moved, **limits, most=2)
    np.testing.assert_array_equal(enough, np.minimum(expected, 2))


def test_true_ranges_confirm_each_other(true_maps: list[RangeMap]) -> None:
    result = checked(true_maps, remove_inconsistent=True)
    result.check()
    assert (result.confidence >= 128).mean() > 0.96
    assert result.valid.mean() > 0.995


def test_wrong_ranges_are_not_confirmed_and_go_when_seen_through(true_maps: list[RangeMap]) -> None:
    rng = np.random.default_rng(1)
    wrong = rng.random(SIZE) < 0.2
    factor = np.where(wrong, rng.choice([0.6, 0.7, 1.4, 1.7], SIZE), 1)
    maps = [as_map(true_maps[0].range * factor), *true_maps[1:]]
    result = checked(maps)
    assert (result.confidence[wrong] >= 128).mean() < 0.03
    assert (result.confidence[~wrong] >= 128).mean() > 0.96
    assert result.valid.all()
    removed = ~checked(maps, remove_inconsistent=True).valid
    near = wrong & (factor < 1)
    assert removed[near].mean() > 0.9
    assert removed[~wrong].mean() < 0.005
    # A range too large lies behind what the others see: they cannot tell it from something hidden.
    assert removed[factor > 1].mean() < 0.1


def test_confidence_grows_with_the_number_of_views_and_falls_with_the_error(true_maps: list[RangeMap]) -> None:
    few, many = checked(true_maps[:2] + [as_map(np.full(SIZE, np.nan))] * 2), checked(true_maps)
    both = few.confidence >= 128
    assert np.median(many.confidence[both]) > np.median(few.confidence[both])
    off = checked([as_map(true_maps[0].range * 1.01), *true_maps[1:]])
    both = (off.confidence >= 128) & (many.confidence >= 128)
    assert np.median(off.confidence[both]) < np.median(many.confidence[both])


def test_along_the_baseline_nothing_is_consistent_however_well_it_agrees(true_maps: list[RangeMap]) -> None:
    """Forward and backward meet at the epipoles whatever the range is."""
    result = check_consistency(true_maps[0], POSES[0], true_maps[1:2], source_poses=POSES[1:2], min_motion_px=0.1)
    rays = ray_grid(SIZE)
    baseline = (POSES[1] @ POSES[0].inverse()).center
    sine = np.linalg.norm(np.cross(rays, baseline / np.linalg.norm(baseline)), axis=-1)
    assert (result.confidence[sine < 0.1] < 128).all()
    assert (result.confidence[sine > 0.9] >= 128).mean() > 0.6
    even = checked(true_maps[:2] + [as_map(np.full(SIZE, np.nan))] * 2)
    both = even.confidence >= 128
    assert np.median(even.confidence[both & (sine > 0.9)]) > np.median(even.confidence[both & (sine < 0.3)]) + 10


def test_agreement_by_a_hair_is_not_enough(true_maps: list[RangeMap]) -> None:
    """A range that misses the sources by nearly what is allowed has little support, one that misses by little much."""
    shares = {}
    for factor in (1.0, 1.012):
        for support in (0.0, 0.9):
            maps = [as_map(true_maps[0].range * factor), *true_maps[1:]]
            result = checked(maps, max_reprojection_px=0.15, max_reprojection_deg=0, min_support=support)
            shares[factor, support] = (result.confidence >= 128).mean()
    assert min(shares[1.0, 0.0], shares[1.0, 0.9], shares[1.012, 0.0]) > 0.98
    assert shares[1.012, 0.9] < 0.8


@pytest.mark.parametrize(("angle_deg", "is_kept"), [(0.0, False), (0.28125, True)])
def test_more_pixels_confirm_no_less_if_the_limit_is_an_angle(angle_deg: float, is_kept: bool) -> None:
    """Ranges that were off by the same at any resolution were confirmed less the more pixels there were."""
    shares = []
    for size in [(64, 128), (128, 256)]:
        rng, rays = np.random.default_rng(5), ray_grid(size)
        waves = [np.sin(rays @ rng.normal(0, 4, 3)) for _ in POSES]
        ranges = [room_range(default_room(), pose, size) for pose in POSES]
        maps = [as_map(one * (1 + 0.01 * wave)) for one, wave in zip(ranges, waves, strict=True)]
        limits = {"max_relative_error": 0.05, "max_reprojection_px": 0.1, "max_reprojection_deg": angle_deg}
        shares.append((checked(maps, **limits).confidence >= 128).mean())
    assert (shares[1] > shares[0] - 0.02) == is_kept


def test_beside_a_step_sides_are_doubtful_and_normals_are_kept(true_maps: list[RangeMap]) -> None:
    edge = np.where(np.arange(SIZE[1]) < 100, 2.0, 4.0) * np.ones(SIZE)
    step = _step_around(as_map(edge).range)
    np.testing.assert_allclose(step[:, 98:102], np.log(2), rtol=1e-6)
    np.testing.assert_allclose(step[2:-2, [97, 102, 30]], 0, atol=1e-6)
    np.testing.assert_allclose(step[2:-2, [254, 255, 0, 1]], np.log(2), rtol=1e-6)  # over the seam
    hole = as_map(np.where(np.arange(SIZE[1]) < 100, np.nan, edge))
    assert np.isfinite(_step_around(hole.range)).all()
    normals = np.broadcast_to(np.array([0, 0, -1], np.float16), (*SIZE, 3)).copy()
    with_normals = RangeMap(true_maps[0].range, true_maps[0].confidence, normals)
    np.testing.assert_array_equal(checked([with_normals, *true_maps[1:]]).normals_in_cam, normals)


def test_min_views_is_the_number_that_must_confirm(true_maps: list[RangeMap]) -> None:
    shares = [(checked(true_maps, min_views=views).confidence >= 128).mean() for views in (1, 2, 3, 4)]
    assert shares == sorted(shares, reverse=True)
    assert shares[2] > 0.5
    assert shares[3] == 0


def test_the_order_of_the_sources_does_not_matter(true_maps: list[RangeMap]) -> None:
    order = [2, 0, 1]
    turned = check_consistency(
        true_maps[0], POSES[0], [true_maps[1:][i] for i in order], source_poses=[POSES[1:][i] for i in order], **LIMITS
    )
    np.testing.assert_array_equal(turned.confidence, checked(true_maps).confidence)


@pytest.mark.parametrize("columns", [1, 100, 255])
def test_rolling_the_reference_rolls_the_result(true_maps: list[RangeMap], columns: int) -> None:
    _, new_from_old = roll_panorama(true_maps[0].range, columns)
    pose = Rigid3(new_from_old, np.zeros(3)) @ POSES[0]
    result = check_consistency(rolled(true_maps[0], columns), pose, true_maps[1:], source_poses=POSES[1:], **LIMITS)
    expected = rolled(checked(true_maps), columns).confidence
    # Rays of a rolled picture differ by rounding, which tips pixels that lie between two surfaces.
    assert (np.abs(result.confidence.astype(int) - expected) > 1).mean() < 1e-3


def test_filled_pixels_neither_vote_nor_are_promoted(true_maps: list[RangeMap]) -> None:
    filled = [RangeMap(m.range, np.full(SIZE, 40, np.uint8)) for m in true_maps]
    assert (checked([true_maps[0], *filled[1:]]).confidence < 128).all()
    np.testing.assert_array_equal(checked([filled[0], *true_maps[1:]]).confidence, 40)
    assert np.isnan(seen_ranges(filled[0], min_confidence=64)).all()


def test_what_was_consistent_before_is_weak_when_nobody_confirms_it(true_maps: list[RangeMap]) -> None:
    alone = check_consistency(RangeMap(true_maps[0].range, np.full(SIZE, 250, np.uint8)), POSES[0], [], source_poses=[])
    np.testing.assert_array_equal(alone.confidence, 127)


def test_any_number_of_threads_gives_the_same_bytes(true_maps: list[RangeMap]) -> None:
    numba = pytest.importorskip("numba")
    before = numba.get_num_threads()
    results = []
    for threads in {1, before}:
        numba.set_num_threads(threads)
        results.append(checked(true_maps).confidence.tobytes())
    numba.set_num_threads(before)
    assert len(set(results)) == 1


def test_impossible_calls_are_named(true_maps: list[RangeMap]) -> None:
    with pytest.raises(UsageError, match="one pose per source"):
        check_consistency(true_maps[0], POSES[0], true_maps[1:], source_poses=POSES[2:])
    with pytest.raises(UsageError, match="min_views must be at least 1"):
        checked(true_maps, min_views=0)


SMALL = (32, 64)
VIEW_LIMITS: dict[str, Any] = {
    "max_relative_error": 0.02,
    "max_reprojection_px": 1.0,
    "min_support": 0.85,
    "min_motion_px": 0.01,
    "min_views": 1,
    "remove_inconsistent": False,
    "min_contradictions": 2,
}
FIVE_POSES = capture_poses(5, seed=2, spread=0.5)
GOOD = Agreement(compared=0.9, agreed=0.5, seen_through=0.1, hidden=0.1)
WRONG = Agreement(compared=0.9, agreed=0.2, seen_through=0.5, hidden=0.1)


@pytest.fixture(scope="module")
def five_maps() -> list[RangeMap]:
    room = default_room()
    return [as_map(room_range(room, pose, SMALL)) for pose in FIVE_POSES]


def agreement_of(maps: list[RangeMap], poses: list[Rigid3], view: int) -> Agreement:
    others = [idx for idx in range(len(poses)) if idx != view]
    return checked_with_agreement(
        maps[view],
        poses[view],
        [maps[idx] for idx in others],
        source_poses=[poses[idx] for idx in others],
        **VIEW_LIMITS,
    )[1]


def line(agreements: list[Agreement]) -> tuple[dict[str, Agreement], dict[str, np.ndarray]]:
    names = [f"{idx}.jpg" for idx in range(len(agreements))]
    return dict(zip(names, agreements, strict=True)), {
        name: np.array([idx, 0.0, 0.0]) for idx, name in enumerate(names)
    }


@pytest.mark.parametrize(("factor", "figure"), [(0.7, "seen_through"), (1.4, "hidden")])
def test_ranges_that_are_too_short_are_seen_through_and_too_long_ones_hidden(
    five_maps: list[RangeMap], factor: float, figure: str
) -> None:
    wrong = [as_map(five_maps[0].range * factor), *five_maps[1:]]
    found = agreement_of(wrong, FIVE_POSES, 0)
    assert getattr(found, figure) > 0.8
    assert found.agreed + found.one_way <= 1 + 1e-9


def test_filled_ranges_and_ranges_that_nobody_sees_are_not_compared(five_maps: list[RangeMap]) -> None:
    half = five_maps[0].confidence.copy()
    half[: SMALL[0] // 2] = 10
    found = agreement_of([RangeMap(five_maps[0].range, half), *five_maps[1:]], FIVE_POSES, 0)
    assert found.compared == pytest.approx(0.5, abs=0.01)
    assert agreement_of(five_maps[:1], FIVE_POSES[:1], 0) == Agreement(0.0, 0.0, 0.0, 0.0)


def test_one_source_alone_contradicts_nothing(five_maps: list[RangeMap]) -> None:
    wrong = [as_map(five_maps[0].range * 0.7), five_maps[1]]
    assert agreement_of(wrong, FIVE_POSES[:2], 0).one_way == 0


def test_a_moved_camera_is_doubted_alone(five_maps: list[RangeMap]) -> None:
    """A camera with good ranges in the wrong place; its neighbours' ranges are right."""
    moved = list(FIVE_POSES)
    moved[1] = Rigid3(FIVE_POSES[1].rotation, FIVE_POSES[1].translation + np.array([0.9, 0.0, 0.4]))
    for poses, expected in ((FIVE_POSES, set()), (moved, {"1"})):
        agreements = {str(idx): agreement_of(five_maps, poses, idx) for idx in range(len(poses))}
        centers = {str(idx): pose.center for idx, pose in enumerate(poses)}
        assert set(evidence_of_views(agreements, centers)) == expected


def test_the_reason_names_the_figures() -> None:
    ((_, reason),) = evidence_of_views(*line([GOOD, GOOD, WRONG, GOOD])).values()
    assert reason == (
        "other views agree with 20 % of its ranges (usual around it: 50 %) and contradict 60 % in one direction"
    )


@pytest.mark.parametrize(
    "view",
    [
        pytest.param(replace(WRONG, agreed=0.3), id="an edge of the capture"),
        pytest.param(replace(WRONG, seen_through=0.3), id="errors that scatter"),
        pytest.param(replace(WRONG, compared=0.1), id="hardly anything to compare"),
    ],
)
def test_views_are_not_doubted_for_less(view: Agreement) -> None:
    assert evidence_of_views(*line([GOOD, GOOD, view, GOOD])) == {}


def test_nothing_is_said_where_nobody_agrees_or_nobody_is_there_to_compare_with() -> None:
    poor = replace(GOOD, agreed=0.09)
    assert evidence_of_views(*line([poor, poor, replace(WRONG, agreed=0.01), poor])) == {}
    assert evidence_of_views(*line([GOOD, WRONG])) == {}
    agreements, centers = line([GOOD, GOOD, WRONG, GOOD])
    assert evidence_of_views(agreements, {name: place for name, place in centers.items() if name != "2.jpg"}) == {}


def test_only_the_nearest_views_count() -> None:
    """At the far end of a long capture of a plain corridor everybody agrees little."""
    poor = replace(WRONG, agreed=0.22)
    assert evidence_of_views(*line([GOOD] * 6 + [poor] * 2 + [WRONG] + [poor] * 2)) == {}
    assert set(evidence_of_views(*line([GOOD] * 8 + [WRONG] + [GOOD] * 2))) == {"8.jpg"}


@pytest.mark.parametrize("case", ["random", "grid", "few", "coincident"])
def test_nearest_views_are_those_of_a_plain_search(case: str) -> None:
    rng = np.random.default_rng(0)
    places = {
        "random": rng.normal(size=(60, 3)),
        "grid": np.argwhere(np.ones((5, 5, 2))).astype(float),
        "few": rng.normal(size=(3, 3)),
        "coincident": np.repeat(rng.normal(size=(4, 3)), 9, axis=0),
    }[case]
    for idx, around in enumerate(nearest_views(places)):
        distances = np.linalg.norm(places - places[idx], axis=1)
        distances[idx] = np.inf
        assert around.tolist() == np.argsort(distances, kind="stable")[: min(4, len(places) - 1)].tolist()


def noisy_maps(noise: float) -> list[RangeMap]:
    rng = np.random.default_rng(0)
    room = default_room()
    return [as_map(room_range(room, pose, SIZE) * np.exp(rng.normal(0, noise, SIZE))) for pose in POSES]


@pytest.fixture(scope="module")
def noisy_checked() -> RangeMap:
    return checked_of(noisy_maps(0.002))


def checked_of(maps: list[RangeMap]) -> RangeMap:
    result = check_consistency(maps[0], POSES[0], maps[1:], source_poses=POSES[1:], min_motion_px=0.01)
    result.check()
    return result


def uncertainty_of(range_map: RangeMap) -> np.ndarray:
    assert range_map.uncertainty is not None
    return range_map.uncertainty.astype(np.float64)


def test_every_range_has_one_and_unconfirmed_ones_have_the_same(noisy_checked: RangeMap) -> None:
    sigma = uncertainty_of(noisy_checked)
    confirmed = noisy_checked.confidence >= 128
    np.testing.assert_array_equal(np.isfinite(sigma), noisy_checked.valid)
    np.testing.assert_allclose(sigma[noisy_checked.valid & ~confirmed], UNCONFIRMED_UNCERTAINTY, rtol=1e-3)
    assert np.median(sigma[confirmed]) < 0.03


def test_it_is_a_product_of_powers() -> None:
    """Each factor on its own."""
    size = (64, 128)
    whole, flat, steep = np.ones(size, np.bool_), np.zeros(size, np.float32), np.full(size, 0.2, np.float32)
    checks = np.where(np.add.outer(np.arange(64), np.arange(128)) % 2 == 0, 1.0, -1.0)
    pixel = 2 * np.pi / size[1]

    def middle(
        *,
        consistent: np.ndarray = whole,
        rough: float = 0.01,
        step: np.ndarray = flat,
        error_px: float = 0.1,
        motion: float = 20,
        opposed: int = 0,
    ) -> float:
        agreeing, contradicting, hiding = (np.full(size, count, np.uint16) for count in (2, opposed, 0))
        support, moved = np.full(size, 2.0), np.full(size, (motion * pixel) ** 2)
        squares = support * (error_px * pixel) ** 2
        comparison = Comparison(agreeing, contradicting, hiding, support, moved, squares)
        ranges = (2 / (1 + rough * checks)).astype(np.float32)
        return float(confirmed_uncertainty(consistent, ranges, comparison, step=step)[32, 64])

    def ratio(name: str, factor: float) -> object:
        return pytest.approx(factor ** EXPONENTS[name], rel=0.02)

    expected = {"motion": 20, "error": 0.1, "roughness": 0.01 * 20}
    assert middle() == pytest.approx(
        FACTOR * np.prod([value ** EXPONENTS[name] for name, value in expected.items()]), rel=0.02
    )
    assert middle(motion=40, rough=0.005) / middle() == ratio("motion", 2)
    assert middle(error_px=0.2) / middle() == ratio("error", 2)
    assert middle(step=steep) / middle() == ratio("steps", 6)
    assert middle(rough=0.04) / middle() == ratio("roughness", 4)
    assert middle(rough=0) / middle() == ratio("roughness", 0.01 / 0.2)
    assert middle(opposed=2) / middle() == ratio("opposed", 3)
    # Ranges that no other view confirms say nothing about the surface, but their number counts.
    assert middle(consistent=checks > 0) / middle(rough=0) == ratio("confirmed", 0.5)


def test_confidence_is_the_probability_that_a_range_is_right(noisy_checked: RangeMap) -> None:
    sigma, confirmed = uncertainty_of(noisy_checked), noisy_checked.confidence >= 128
    probability = probability_within(sigma[confirmed], 0.02)
    np.testing.assert_array_equal(noisy_checked.confidence[confirmed], np.floor(128 + 127 * probability))
    assert probability_within(np.array([0.0]), 0.02) == 1
    assert probability_within(np.array([0.02 / 0.3]), 0.02) == pytest.approx(0.5)


def test_changes_add_to_it(noisy_checked: RangeMap) -> None:
    before, valid = uncertainty_of(noisy_checked), noisy_checked.valid
    moved = np.where(np.arange(SIZE[1]) < 100, noisy_checked.range * np.float32(1.05), noisy_checked.range)
    after = with_ranges(noisy_checked, moved)
    after.check()
    sigma, confirmed = uncertainty_of(after), noisy_checked.confidence >= 128
    left = np.broadcast_to(np.arange(SIZE[1]) < 100, SIZE)
    np.testing.assert_array_equal(sigma[~left & valid], before[~left & valid])
    np.testing.assert_allclose(sigma[left & confirmed], np.hypot(before, 0.05)[left & confirmed], rtol=2e-3)
    assert (sigma[left & valid & ~confirmed] >= 0.149).all()


def test_filled_pixels_get_a_large_one_and_removed_ones_none(noisy_checked: RangeMap) -> None:
    hole = np.zeros(SIZE, np.bool_)
    hole[40:60, 100:120] = True
    open_map = with_ranges(
        noisy_checked,
        np.where(hole, np.float32(np.nan), noisy_checked.range),
        np.where(hole, 0, noisy_checked.confidence),
    )
    open_map.check()
    filled = with_ranges(
        open_map, np.where(hole, np.float32(2), open_map.range), np.where(hole, 30, open_map.confidence)
    )
    filled.check()
    np.testing.assert_allclose(uncertainty_of(filled)[hole], UNCONFIRMED_UNCERTAINTY, rtol=1e-3)
    assert with_ranges(replace(noisy_checked, uncertainty=None), noisy_checked.range).uncertainty is None


def test_wrong_uncertainties_are_refused(noisy_checked: RangeMap) -> None:
    zero = np.zeros(SIZE, np.float16)
    with pytest.raises(ContractError, match="an uncertainty is not positive or infinite"):
        replace(noisy_checked, uncertainty=zero).check()
    with pytest.raises(ContractError, match="uncertainty must be float16"):
        replace(noisy_checked, uncertainty=zero.astype(np.float32)).check()
    replace(noisy_checked, uncertainty=np.full(SIZE, np.nan, np.float16)).check()
