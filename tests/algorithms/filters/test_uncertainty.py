"""Uncertainty of ranges: larger where parallax is small or views disagree, and never smaller after a change."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pano_mvs.algorithms.filters.consistency import check_consistency
from pano_mvs.algorithms.filters.uncertainty import UNCONFIRMED_UNCERTAINTY, confirmed_uncertainty, with_ranges
from pano_mvs.core.errors import ContractError
from pano_mvs.scene import RangeMap
from pano_mvs.testing.room import capture_poses, default_room
from tests.algorithms.range_scenes import as_map, room_range

SIZE = (128, 256)
POSES = capture_poses(4, seed=1, spread=0.4)


def noisy_maps(noise: float) -> list[RangeMap]:
    rng = np.random.default_rng(0)
    room = default_room()
    return [as_map(room_range(room, pose, SIZE) * np.exp(rng.normal(0, noise, SIZE))) for pose in POSES]


@pytest.fixture(scope="module")
def checked() -> RangeMap:
    return checked_of(noisy_maps(0.002))


def checked_of(maps: list[RangeMap]) -> RangeMap:
    result = check_consistency(maps[0], POSES[0], maps[1:], source_poses=POSES[1:], min_motion_px=0.01)
    result.check()
    return result


def uncertainty_of(range_map: RangeMap) -> np.ndarray:
    assert range_map.uncertainty is not None
    return range_map.uncertainty.astype(np.float64)


def test_every_range_has_one_and_unconfirmed_ones_have_the_same(checked: RangeMap) -> None:
    sigma = uncertainty_of(checked)
    confirmed = checked.confidence >= 128
    np.testing.assert_array_equal(np.isfinite(sigma), checked.valid)
    np.testing.assert_allclose(sigma[checked.valid & ~confirmed], UNCONFIRMED_UNCERTAINTY, rtol=1e-3)
    assert np.median(sigma[confirmed]) < 0.03


def test_it_is_the_formula() -> None:
    """σ = 5.4 e (ρ M)^¼ (1 + 5 d)^⅓ / M, each factor on its own."""
    size = (64, 128)
    whole, flat, steep = np.ones(size, np.bool_), np.zeros(size, np.float32), np.full(size, 0.2, np.float32)
    checks = np.where(np.add.outer(np.arange(64), np.arange(128)) % 2 == 0, 1.0, -1.0)

    def middle(
        *,
        consistent: np.ndarray = whole,
        rough: float = 0.01,
        step: np.ndarray = flat,
        error_px: float = 0.1,
        motion: float = 20,
    ) -> float:
        support = np.full(size, 2.0)
        found = confirmed_uncertainty(
            consistent,
            (2 / (1 + rough * checks)).astype(np.float32),
            support=support,
            squared_error=support * error_px**2,
            motion=support * motion / 2,
            step=step,
        )
        return float(found[32, 64])

    assert middle() == pytest.approx(5.4 * 0.1 * (0.01 * 20) ** 0.25 / 20, rel=0.02)
    assert middle(motion=40) == pytest.approx(middle() / 2**0.75, rel=2e-3)
    assert middle(error_px=0.2) == pytest.approx(2 * middle(), rel=2e-3)
    assert middle(step=steep) == pytest.approx(6 ** (1 / 3) * middle(), rel=2e-3)
    assert middle(rough=0.04) == pytest.approx(4**0.25 * middle(), rel=0.02)
    assert middle(rough=0) == pytest.approx((0.01 / 0.2) ** 0.25 * middle(), rel=0.02)
    # Ranges that no other view confirms say nothing about the surface.
    assert middle(consistent=checks > 0) == pytest.approx(middle(rough=0), rel=0.02)


def test_changes_add_to_it(checked: RangeMap) -> None:
    before, valid = uncertainty_of(checked), checked.valid
    moved = np.where(np.arange(SIZE[1]) < 100, checked.range * np.float32(1.05), checked.range)
    after = with_ranges(checked, moved)
    after.check()
    sigma, confirmed = uncertainty_of(after), checked.confidence >= 128
    left = np.broadcast_to(np.arange(SIZE[1]) < 100, SIZE)
    np.testing.assert_array_equal(sigma[~left & valid], before[~left & valid])
    np.testing.assert_allclose(sigma[left & confirmed], np.hypot(before, 0.05)[left & confirmed], rtol=2e-3)
    assert (sigma[left & valid & ~confirmed] >= 0.149).all()


def test_filled_pixels_get_a_large_one_and_removed_ones_none(checked: RangeMap) -> None:
    hole = np.zeros(SIZE, np.bool_)
    hole[40:60, 100:120] = True
    open_map = with_ranges(
        checked, np.where(hole, np.float32(np.nan), checked.range), np.where(hole, 0, checked.confidence)
    )
    open_map.check()
    filled = with_ranges(
        open_map, np.where(hole, np.float32(2), open_map.range), np.where(hole, 30, open_map.confidence)
    )
    filled.check()
    np.testing.assert_allclose(uncertainty_of(filled)[hole], UNCONFIRMED_UNCERTAINTY, rtol=1e-3)
    assert with_ranges(replace(checked, uncertainty=None), checked.range).uncertainty is None


def test_wrong_uncertainties_are_refused(checked: RangeMap) -> None:
    zero = np.zeros(SIZE, np.float16)
    with pytest.raises(ContractError, match="an uncertainty is not positive or infinite"):
        replace(checked, uncertainty=zero).check()
    with pytest.raises(ContractError, match="uncertainty must be float16"):
        replace(checked, uncertainty=zero.astype(np.float32)).check()
    replace(checked, uncertainty=np.full(SIZE, np.nan, np.float16)).check()
