"""The curve of a pixel is what the sweep decided by, whatever the settings: the same winner, range and confidence."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.sweep.backends.numpy_backend import _aggregate, _source_cost, find_winners
from pano_mvs.algorithms.sweep.cost_curve import cost_curve
from pano_mvs.algorithms.sweep.costs import SWEEP_COSTS, register_sweep_cost
from pano_mvs.algorithms.sweep.edge_support import averaged
from pano_mvs.algorithms.sweep.numba.arguments import fresh_state, sweep_arguments
from pano_mvs.algorithms.sweep.numba.kernels_band import sweep_band
from pano_mvs.algorithms.sweep.preparation import SweepInput
from pano_mvs.algorithms.sweep.sweep import SweepSettings, sweep_input, sweep_range
from pano_mvs.algorithms.sweep.windows import CostWindow
from pano_mvs.core.errors import UsageError
from pano_mvs.testing.room import capture_poses, default_room, render
from pano_mvs.testing.sweep_backends import CASES, FAR, NEAR, SweepCase, sweep_case


def work_of(case: SweepCase) -> SweepInput:
    return sweep_input(
        case.pictures[0],
        case.pictures[1:],
        case.source_from_reference,
        near=NEAR,
        far=FAR,
        settings=case.settings,
        reference_mask=case.masks[0],
        source_masks=case.masks[1:],
    )


@pytest.mark.parametrize("number", range(0, CASES, 5))
def test_the_winner_of_the_curve_is_that_of_the_sweep(number: int) -> None:
    case = sweep_case(number)
    swept, work = case.swept("numba"), work_of(case)
    height, width = swept.range.shape
    rng = np.random.default_rng(number)
    pixels = [(0, 0), (height - 1, width - 1), (rng.integers(height), rng.integers(width))]
    for row, column in pixels:
        curve = cost_curve(work, column=column, row=row, masked=not case.masks[0][row, column])
        np.testing.assert_equal(np.float32(curve.range), swept.range[row, column])
        assert curve.confidence == swept.confidence[row, column]
        assert bool(curve.reason) == np.isnan(curve.range)


def test_costs_and_sums_are_those_of_the_whole_volume() -> None:
    case = sweep_case(4)
    work = work_of(case)
    assert work.settings.aggregation == "box"
    row, column = 5, 3
    curve = cost_curve(work, column=column, row=row)
    sources = [[_source_cost(work, s, r)[row, column] for r in work.ranges] for s in range(len(work.sources))]
    expected = np.array(sources) / work.settings.worst_cost
    expected[np.isinf(expected)] = np.nan
    np.testing.assert_allclose(curve.by_source, expected, atol=0.02)
    winners = find_winners(work)
    assert curve.raw[curve.winner] * work.settings.worst_cost == pytest.approx(winners.cost[row, column], rel=0.05)


def test_paths_end_in_the_pixel_with_the_sums_of_the_volume() -> None:
    poses = capture_poses(2, spread=0.4)
    pictures = [render(default_room(), pose, (24, 48), supersample=1)[0] for pose in poses]
    settings = SweepSettings(planes=9, support=1, window=3)
    work = sweep_input(
        pictures[0], pictures[1:], [poses[1] @ poses[0].inverse()], near=NEAR, far=FAR, settings=settings
    )
    volume = np.empty((24, 9, 48), np.int64)
    for row in range(24):
        for column in range(48):
            costs = cost_curve(work, column=column, row=row) if row in (0, 12, 23) and column % 16 == 3 else None
            if costs is not None:
                volume[row, :, column] = np.rint(costs.raw * 255)
    stored = np.empty((24, 9, 48), np.uint8)
    arguments = sweep_arguments(work)
    sweep_band(0, arguments, arguments.others, work.ranges, stored, *fresh_state(24, 48))
    total = _aggregate(averaged(stored.astype(np.int64), work), work)
    for row in (0, 12, 23):
        for column in (3, 19, 35):
            np.testing.assert_array_equal(volume[row, :, column], stored[row, :, column])
            found = cost_curve(work, column=column, row=row).aggregated
            assert found is not None
            np.testing.assert_array_equal(np.rint(found * 8 * 255), total[row, :, column])


def test_a_distinct_surface_has_a_sharp_curve_at_its_true_range() -> None:
    poses = capture_poses(3, spread=0.4)
    room = default_room()
    views = [render(room, pose, (96, 192), supersample=1) for pose in poses]
    work = sweep_input(
        views[0][0],
        [view[0] for view in views[1:]],
        [pose @ poses[0].inverse() for pose in poses[1:]],
        near=NEAR,
        far=FAR,
        settings=SweepSettings(planes=48),
    )
    errors, sharp = [], []
    for row, column in [(48, 30), (45, 96), (51, 150), (30, 60), (66, 120)]:
        curve = cost_curve(work, column=column, row=row)
        errors.append(abs(curve.range / views[0][1][row, column] - 1))
        sharp.append(curve.uniqueness)
        assert curve.decisive[curve.winner] == curve.decisive.min()
        assert curve.runner_up is not None
        assert abs(curve.runner_up - curve.winner) > 1
        around = curve.decisive[max(0, curve.runner_up - 1) : curve.runner_up + 2]
        assert curve.decisive[curve.runner_up] == around.min()
        apart = np.abs(np.arange(48) - curve.winner) > 1
        rival = curve.decisive[apart].min()
        assert curve.uniqueness == pytest.approx(1 - curve.decisive.min() / rival, rel=1e-5)
    assert np.median(errors) < 0.05
    assert np.median(sharp) > 0.2


def test_a_plugins_cost_has_a_curve_too() -> None:
    before = dict(SWEEP_COSTS._added)
    try:

        @register_sweep_cost("darker")
        def darker(reference: NDArray[Any], warped: NDArray[Any], window: CostWindow) -> NDArray[Any]:
            result: NDArray[Any] = np.abs(reference[..., 0] - warped[..., 0]) / 255
            return result

        case = sweep_case(0)
        settings = SweepSettings(planes=7, cost="darker", support=3, no_match="keep")
        pictures = case.pictures[0], case.pictures[1:], case.source_from_reference
        work = sweep_input(*pictures, near=NEAR, far=FAR, settings=settings)
        swept = sweep_range(*pictures, near=NEAR, far=FAR, settings=settings, backend="numpy")
        curve = cost_curve(work, column=7, row=9)
        assert curve.range == pytest.approx(swept.range[9, 7], rel=1e-5)
    finally:
        SWEEP_COSTS._added = before


def test_a_pixel_outside_is_refused() -> None:
    work = work_of(sweep_case(0))
    with pytest.raises(UsageError, match=r"pixel \(99, 2\) is not in a picture of"):
        cost_curve(work, column=99, row=2)
