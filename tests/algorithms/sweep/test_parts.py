"""The swappable parts of the sweep: costs, weights of sources, fits between planes, confidences."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import Any, get_args, get_type_hints

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.sweep.costs import BUILTIN, census_weight
from pano_mvs.algorithms.sweep.kernels_constants import (
    GREY_WEIGHT,
    MAX_COLOR_COST,
    MAX_GRADIENT_COST,
    ZNCC_NOISE_VARIANCE,
)
from pano_mvs.algorithms.sweep.numba.kernels_cost import census_gradient_row, sad_gradient_row, zncc_rows
from pano_mvs.algorithms.sweep.preparation import parallax_weights
from pano_mvs.algorithms.sweep.sweep import SweepSettings, sweep_range
from pano_mvs.algorithms.sweep.windows import column_offsets
from pano_mvs.algorithms.sweep.winner import Winners, confidence, subplane_offset
from pano_mvs.geometry import Rigid3, pad_panorama, ray_grid, rotate_panorama, rotation_from_rotvec
from pano_mvs.scene import RangeMap
from pano_mvs.testing.room import capture_poses, default_room, render
from tests.oracles import sweep as oracle

Capture = tuple[list[NDArray[np.uint8]], list[Rigid3], NDArray[np.float32]]

SIZE = 16, 32
NAMES = {"cost": tuple(BUILTIN)} | {
    name: get_args(hint) for name, hint in get_type_hints(SweepSettings).items() if get_args(hint)
}


@pytest.fixture(scope="module")
def capture() -> Capture:
    poses = capture_poses(4, seed=11)
    views = [render(default_room(4), pose, (64, 128)) for pose in poses]
    pictures = [
        np.clip(picture + np.random.default_rng(3).normal(0, 1, picture.shape), 0, 255).astype(np.uint8)
        for picture, _ in views
    ]
    return pictures, [pose @ poses[0].inverse() for pose in poses[1:]], views[0][1]


def swept(
    capture: tuple[list[NDArray[np.uint8]], list[Rigid3], Any],
    sources: Sequence[NDArray[np.uint8]] | None = None,
    poses: Sequence[Rigid3] | None = None,
    **settings: Any,
) -> RangeMap:
    pictures, own_poses, _ = capture
    return sweep_range(
        pictures[0],
        sources or pictures[1:],
        poses or own_poses,
        near=0.6,
        far=6.0,
        settings=SweepSettings(**{"planes": 32} | settings),
    )


def good_share(result: RangeMap, truth: NDArray[np.float32], ratio: float = 1.07) -> float:
    return float((np.maximum(result.range / truth, truth / result.range) < ratio).mean())


@pytest.mark.kernel("sweep.numba.kernels_cost")
@pytest.mark.parametrize("first", [0, 6, 13])
def test_correlation_by_running_sums_equals_the_definition(first: int) -> None:
    rng = np.random.default_rng(first)
    reference, warped = rng.integers(0, 256, (2, *SIZE), dtype=np.uint8)
    warped[4:9] = reference[4:9] // 2 + 40
    reference[:, 20:] = 77
    reach = column_offsets(SIZE, 2, spherical=True)[:, -1].copy()
    pad, rows = int(reach.max()) + 1, 3
    means = np.zeros((rows, SIZE[1]), np.float32)
    zncc_rows(
        first,
        pad_panorama(reference, pad),
        np.ascontiguousarray(pad_panorama(warped, pad)[first + pad - 2 : first + pad + rows + 2]),
        reach[first : first + rows],
        2,
        pad,
        np.zeros((rows + 4, SIZE[1] + 2 * pad), np.uint16),
        np.zeros((2, SIZE[1] + 2 * pad), np.int32),
        means,
    )
    expected = [
        [
            oracle.zncc_cost(reference, warped, row, column, radius=2, reach=int(reach[row]), noise=ZNCC_NOISE_VARIANCE)
            for column in range(SIZE[1])
        ]
        for row in range(first, first + rows)
    ]
    np.testing.assert_allclose(means, expected, atol=2e-4)


@pytest.mark.kernel("sweep.numba.kernels_cost")
@pytest.mark.parametrize("row", [0, 7, 15])
def test_differences_of_colours_and_gradients_equal_the_definition(row: int) -> None:
    rng = np.random.default_rng(row)
    reference = rng.integers(0, 256, (*SIZE, 3), dtype=np.uint8)
    warped = np.clip(reference + rng.integers(-9, 10, reference.shape), 0, 255).astype(np.uint8)
    pad, total = 4, np.zeros(SIZE[1], np.uint16)
    padded = [np.stack([pad_panorama(plane, pad) for plane in np.moveaxis(p, -1, 0)]) for p in (reference, warped)]
    sad_gradient_row(padded[0], row + pad, padded[1], row + pad, 2, pad, total)
    limits = MAX_COLOR_COST, MAX_GRADIENT_COST
    expected = [
        oracle.sad_gradient_cost(reference, warped, row, column, reach=2, limits=limits) for column in range(SIZE[1])
    ]
    assert total.tolist() == expected
    assert len(set(expected)) > 5


@pytest.mark.kernel("sweep.numba.kernels_cost")
def test_census_beside_grey_levels_equals_the_definition() -> None:
    rng = np.random.default_rng(5)
    reference = rng.integers(0, 256, SIZE, dtype=np.uint8)
    warped = np.clip(reference + rng.integers(-9, 10, SIZE), 0, 255).astype(np.uint8)
    offsets, row, pad = column_offsets(SIZE, 2, spherical=True), 3, 16
    disagree, total = np.zeros(SIZE[1], np.uint8), np.zeros(SIZE[1], np.uint16)
    padded = [pad_panorama(picture, pad) for picture in (reference, warped)]
    census_gradient_row(padded[0], row + pad, padded[1], row + pad, offsets[row], 10, pad, disagree, total)
    limits = MAX_COLOR_COST // 3, MAX_GRADIENT_COST // 3
    expected = []
    for column in range(SIZE[1]):
        census = oracle.census_cost(reference, warped, row, column, offsets[row])
        grey = oracle.sad_gradient_cost(
            reference[..., None], warped[..., None], row, column, reach=int(offsets[row, 3]), limits=limits
        )
        expected.append(10 * census + GREY_WEIGHT * grey)
    assert total.tolist() == expected


@pytest.mark.parametrize("window", [3, 5, 7, 9, 15])
def test_census_counts_four_times_as_much_as_grey_levels_at_their_worst(window: int) -> None:
    settings = SweepSettings(cost="census_gradient", window=window)
    census = census_weight(window // 2) * (window**2 - 1)
    assert census == pytest.approx(0.8 * settings.worst_cost, rel=0.1)


@pytest.mark.parametrize("cost", NAMES["cost"])
@pytest.mark.parametrize("aggregation", NAMES["aggregation"])
def test_every_cost_recovers_the_room(capture: Capture, cost: str, aggregation: str) -> None:
    assert good_share(swept(capture, cost=cost, aggregation=aggregation), capture[2]) > 0.75


@pytest.mark.parametrize(
    ("cost", "exposure"), [("census", False), ("zncc", False), ("sad_gradient", True), ("census_gradient", True)]
)
def test_no_cost_minds_another_exposure(capture: Capture, cost: str, exposure: bool) -> None:
    pictures, _, truth = capture
    others = [np.clip(np.rint(0.8 * picture + 10), 0, 255).astype(np.uint8) for picture in pictures[1:]]
    usual, changed = swept(capture, cost=cost), swept(capture, sources=others, cost=cost, exposure=exposure)
    assert good_share(changed, truth) > good_share(usual, truth) - 0.03
    assert good_share(changed, usual.range) > 0.93


@pytest.mark.slow
def test_all_names_go_together(capture: Capture) -> None:
    tiny = [picture[::4, ::4] for picture in capture[0]], capture[1], None
    for names in itertools.islice(itertools.product(*NAMES.values()), 0, None, 317):  # has every pair of names
        swept(tiny, planes=5, **dict(zip(NAMES, names, strict=True))).check()


def test_a_source_weighs_by_the_parallax_it_sees() -> None:
    centers = np.array([[1.0, 0, 0], [0, 0, 2.0], [0.3, -0.4, 0]])
    turns = [rotation_from_rotvec(axis) for axis in ((0.2, 1.5, 0), (2.0, 0, -1), (0, 0, 0))]
    poses = [Rigid3.from_center(turn, center) for turn, center in zip(turns, centers, strict=True)]
    weights = parallax_weights(SIZE, poses)
    np.testing.assert_allclose(weights.sum(axis=0), 1, rtol=1e-6)
    rays = ray_grid(SIZE)
    step, at = 1e-4, 1e3
    seen = []
    for center in centers:
        directions = [rays * r - center for r in (at, 1 / (1 / at + step))]
        directions = [d / np.linalg.norm(d, axis=-1, keepdims=True) for d in directions]
        seen.append(np.linalg.norm(directions[1] - directions[0], axis=-1))
    np.testing.assert_allclose(weights, np.array(seen) / np.sum(seen, axis=0), atol=0.02)


def test_sources_turned_first_give_the_same_but_for_resampling(capture: Capture) -> None:
    plain, turned = swept(capture), swept(capture, derotate=True)
    assert good_share(turned, plain.range) > 0.8
    assert good_share(turned, capture[2]) > good_share(plain, capture[2]) - 0.05
    assert np.median(np.abs(turned.range / plain.range - 1)) < 0.015


def test_sources_that_are_not_turned_give_the_very_same_either_way(capture: Capture) -> None:
    pictures, poses, _ = capture
    upright = [rotate_panorama(picture, pose.rotation.T) for picture, pose in zip(pictures[1:], poses, strict=True)]
    shifts = [Rigid3(np.eye(3), pose.rotation.T @ pose.translation) for pose in poses]
    given = swept(capture, upright, shifts)
    assert given.range.tobytes() == swept(capture, derotate=True).range.tobytes()


def _winners_of_curve(
    curve: Callable[[NDArray[np.float64]], NDArray[np.float64]], planes: int = 41
) -> tuple[Winners, NDArray[np.float64]]:
    """Return the winners of one row of pixels with a minimum at 20 plus each offset."""
    offsets = np.linspace(-0.49, 0.49, 15)
    volume = curve(np.arange(planes)[None, :] - 20 - offsets[:, None])
    plane = volume.argmin(axis=1)
    at = [np.take_along_axis(volume, (plane + step)[:, None], 1).T.astype(np.float32) for step in (0, -1, 1)]
    rival = np.full((1, 15), np.inf, np.float32)
    return Winners(plane[None].astype(np.int32), at[0], at[1], at[2], rival), offsets


@pytest.mark.parametrize(("shape", "curve"), [("parabola", np.square), ("vfit", np.abs)])
def test_a_fit_finds_the_minimum_of_its_own_curve(shape: Any, curve: Callable[..., Any]) -> None:
    winners, offsets = _winners_of_curve(lambda x: 3 + 5 * curve(x))
    np.testing.assert_allclose(
        winners.plane[0] - 20 + subplane_offset(winners, planes=41, shape=shape)[0], offsets, atol=1e-5
    )


@pytest.mark.parametrize("measure", NAMES["confidence"])
def test_a_sharp_and_lonely_minimum_is_surer(measure: Any) -> None:
    def one(cost: float, beside: float, rival: float) -> int:
        values = [np.full((1, 1), value, np.float32) for value in (cost, beside, beside, rival)]
        return int(confidence(Winners(np.ones((1, 1), np.int32), *values), measure=measure)[0, 0])

    assert one(100, 100, 100) == 64
    assert one(60, 100, 100) > one(80, 100, 100) > one(95, 100, 100) > 64
    assert one(0, 100, 100) == 127
    assert (one(60, 70, 100) < one(60, 90, 100)) == (measure != "peak_ratio")
    assert (one(60, 90, 70) < one(60, 90, 100)) == (measure != "curvature")
