"""The sweep, readable: the whole volume in memory, exact projection, one statement for each step.

The reference against which compiled backends are held. Memory: about 20 bytes for each pixel and plane.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.sweep.combination import source_weights
from pano_mvs.algorithms.sweep.costs.registry import CostWindow, checked_cost, plugin_cost
from pano_mvs.algorithms.sweep.penalties import DIRECTIONS, step_penalties, warm_up
from pano_mvs.algorithms.sweep.preparation import SweepInput
from pano_mvs.algorithms.sweep.settings import (
    GREY_WEIGHT,
    LARGEST_COLOR_COST,
    LARGEST_GRADIENT_COST,
    ZNCC_NOISE_VARIANCE,
)
from pano_mvs.algorithms.sweep.windows import column_offsets, neighbours
from pano_mvs.algorithms.sweep.winner import Winners
from pano_mvs.geometry import pixel_from_ray, ray_grid, sample_panorama

FloatArray = NDArray[np.float64]


def find_winners(work: SweepInput) -> Winners:
    """Return the winning plane of every pixel and the costs around it."""
    settings = work.settings
    volume = np.stack([_combined_cost(work, virtual_range) for virtual_range in work.ranges], axis=1)
    if settings.aggregation == "sgm":
        stored = np.floor(np.minimum(volume * settings.cost_scale + 0.5, 255))
        volume = _aggregate(stored.astype(np.int64), work).astype(np.float64)
    return winners_of(volume)


def winners_of(volume: FloatArray) -> Winners:
    """Return the winners of a volume of costs, (H, D, W)."""
    planes = np.arange(volume.shape[1])[:, None]
    plane = np.argmin(volume, axis=1)
    near_winner = np.abs(planes - plane[:, None]) <= 1

    def cost_at(idx: NDArray[np.intp]) -> NDArray[np.float32]:
        inside = np.clip(idx, 0, volume.shape[1] - 1)
        return np.take_along_axis(volume, inside[:, None], axis=1)[:, 0].astype(np.float32)

    rival = np.where(near_winner, np.inf, volume).min(axis=1).astype(np.float32)
    return Winners(plane.astype(np.int32), cost_at(plane), cost_at(plane - 1), cost_at(plane + 1), rival)


def _combined_cost(work: SweepInput, virtual_range: float) -> FloatArray:
    """Return the mean cost of one plane over the sources that count, (H, W)."""
    return combine_costs(np.stack([_source_cost(work, idx, virtual_range) for idx in range(len(work.sources))]), work)


def combine_costs(costs: NDArray[np.floating], work: SweepInput) -> FloatArray:
    """Return the mean cost of the sources that count, (S, H, W) to (H, W); infinite stands for no vote."""
    votes = np.isfinite(costs)
    weights = source_weights(costs.shape[1:], work.source_from_reference, work.settings)
    weights = np.where(votes, weights if len(weights) else 1.0, 0.0)
    order = np.argsort(costs, axis=0, kind="stable")
    ranked = np.take_along_axis(weights, order, axis=0)
    held_before = np.cumsum(ranked, axis=0) - ranked
    wanted = work.settings.weight_share * (1 - 1e-5) * ranked.sum(axis=0)
    place = np.arange(len(costs))[:, None, None]
    taken = np.where((held_before < wanted) & (place < work.settings.most_sources(len(costs))), ranked, 0.0)
    total = np.sum(taken * np.where(taken > 0, np.take_along_axis(costs, order, axis=0), 0.0), axis=0)
    seen = votes.any(axis=0)
    return np.where(seen, total / np.where(seen, taken.sum(axis=0), 1.0), work.settings.neutral_cost)


def _source_cost(work: SweepInput, idx: int, virtual_range: float) -> FloatArray:
    """Return the cost of one plane in one source, (H, W), infinite where the source has no vote."""
    size_hw = work.reference.shape[0], work.reference.shape[1]
    settings, source = work.settings, work.sources[idx]
    points = work.source_from_reference[idx].apply(ray_grid(size_hw) * virtual_range)
    pixels = pixel_from_ray(points, (source.shape[0], source.shape[1]))
    warped = np.floor(sample_panorama(source, pixels) + 0.5)
    if settings.cost == "zncc":
        cost = _zncc(work.reference[..., 0], warped[..., 0], work)
    else:
        per_pixel = pixel_cost(work.reference, warped, work)
        cost = _box_mean(per_pixel, settings.box_radius, spherical=settings.spherical_window)
    if work.source_valid is not None:
        cost[sample_panorama(work.source_valid[idx], pixels) < 1 - 1e-9] = np.inf
    return cost


def pixel_cost(reference: NDArray[np.uint8], warped: FloatArray, work: SweepInput) -> FloatArray:
    """Return what each pixel costs by itself, (H, W), by one of our costs or a plugin's."""
    settings = work.settings
    own = plugin_cost(settings.cost)
    if own is None:
        return _PIXEL_COSTS[settings.cost](reference, warped, work)
    size_hw = reference.shape[0], reference.shape[1]
    window = CostWindow.of(size_hw, settings.window // 2, spherical=settings.spherical_window)
    return checked_cost(own.function(reference, warped, window), size_hw, settings.cost)


def _differences(reference: NDArray[np.uint8], warped: FloatArray, _: SweepInput) -> FloatArray:
    """Return the sum of absolute differences of all colours, (H, W)."""
    difference: FloatArray = np.abs(reference.astype(np.float64) - warped).sum(axis=-1)
    return difference


def _sad_gradient(reference: NDArray[np.uint8], warped: FloatArray, work: SweepInput) -> FloatArray:
    """Return the differences of colours and those of their gradients, each cut off, (H, W)."""
    columns = column_offsets((reference.shape[0], reference.shape[1]), 1, spherical=work.settings.spherical_window)[
        :, 2
    ]
    difference = np.moveaxis(reference.astype(np.float64) - warped, -1, 0)
    gradient = np.zeros(reference.shape[:2])
    for color in difference:
        gradient += np.abs(neighbours(color, 0, columns) - neighbours(color, 0, -columns))
        gradient += np.abs(neighbours(color, 1, np.zeros_like(columns)) - neighbours(color, -1, np.zeros_like(columns)))
    colors = np.minimum(_differences(reference, warped, work), LARGEST_COLOR_COST)
    return np.asarray(colors + np.minimum(gradient, LARGEST_GRADIENT_COST))


def _census_gradient(reference: NDArray[np.uint8], warped: FloatArray, work: SweepInput) -> FloatArray:
    """Return the census cost plus the differences of grey levels and of their gradients, each cut off, (H, W)."""
    # Of one colour instead of three, everything is a third.
    grey = _sad_gradient(np.repeat(reference, 3, axis=-1), np.repeat(warped, 3, axis=-1), work) / 3
    return np.asarray(work.settings.census_weight * _census(reference, warped, work) + GREY_WEIGHT * grey)


def _zncc(reference: NDArray[np.uint8], warped: FloatArray, work: SweepInput) -> FloatArray:
    """Return 1 − ρ, ρ the correlation over each pixel's window with some noise in both variances, (H, W)."""
    ours = reference.astype(np.float64)

    def mean(values: FloatArray) -> FloatArray:
        return _box_mean(values, work.settings.box_radius, spherical=work.settings.spherical_window)

    mean_r, mean_w = mean(ours), mean(warped)
    variance_r = np.maximum(mean(ours**2) - mean_r**2, 0) + ZNCC_NOISE_VARIANCE
    variance_w = np.maximum(mean(warped**2) - mean_w**2, 0) + ZNCC_NOISE_VARIANCE
    rho = (mean(ours * warped) - mean_r * mean_w) / np.sqrt(variance_r * variance_w)
    return np.asarray(1 - np.clip(rho, -1, 1))


def _census(picture: NDArray[np.uint8], source: FloatArray, work: SweepInput) -> FloatArray:
    """Return how many neighbours have another order against the centre in one picture than in the other, (H, W)."""
    reference, warped = picture[..., 0], source[..., 0]
    radius = work.settings.compare_radius
    offsets = column_offsets(reference.shape, radius, spherical=work.settings.spherical_window)
    differs = np.zeros(reference.shape)
    for rows in range(-radius, radius + 1):
        for k in range(2 * radius + 1):
            above = neighbours(reference, rows, offsets[:, k]) > reference
            differs += above != (neighbours(warped, rows, offsets[:, k]) > warped)
    return differs


_PIXEL_COSTS: dict[str, Callable[[NDArray[np.uint8], FloatArray, SweepInput], FloatArray]] = {
    "census": _census,
    "census_gradient": _census_gradient,
    "sad": _differences,
    "sad_gradient": _sad_gradient,
}


def _box_mean(cost: FloatArray, radius: int, *, spherical: bool) -> FloatArray:
    """Return the mean over windows of 2 radius + 1 rows, as wide as the centre's row asks for, (H, W)."""
    reach = column_offsets((cost.shape[0], cost.shape[1]), radius, spherical=spherical)[:, -1]
    rows = np.sum([neighbours(cost, row, np.zeros_like(reach)) for row in range(-radius, radius + 1)], axis=0)
    result = np.zeros_like(cost)
    for columns in np.unique(reach):
        here = reach == columns
        shifted = [np.roll(rows[here], shift, axis=1) for shift in range(-columns, columns + 1)]
        result[here] = np.sum(shifted, axis=0) / ((2 * radius + 1) * (2 * columns + 1))
    return result


def _aggregate(volume: NDArray[np.int64], work: SweepInput) -> NDArray[np.int64]:
    """Return the sum of eight paths' costs, (H, D, W)."""
    height, _, width = volume.shape
    settings = work.settings
    p1, _ = settings.penalties(height)
    before_pole, before_seam = warm_up((height, width))
    total = np.zeros_like(volume)
    for rows, columns in DIRECTIONS:
        penalties = step_penalties(work.reference, (rows, columns), settings).astype(np.int64)
        path = np.zeros(volume.shape[1:], np.int64)
        for i in range(-before_pole, height):
            row = i if i >= 0 else -1 - i
            row = row if rows > 0 else height - 1 - row
            beyond = 0 if i >= 0 else width // 2
            here = np.roll(volume[row], beyond, axis=-1)
            path = path_step(here, np.roll(path, columns, axis=-1), np.roll(penalties[row], beyond), p1)
            if i >= 0:
                total[row] += path
    for step in (1, -1):
        penalties = step_penalties(work.reference, (0, step), settings).astype(np.int64)
        path = np.zeros((volume.shape[1], height), np.int64)
        for i in range(-before_seam, width):
            column = i % width if step > 0 else width - 1 - i % width
            path = path_step(volume[:, :, column].T, path, penalties[:, column], p1)
            if i >= 0:
                total[:, :, column] += path.T
    return total


def path_step(
    costs: NDArray[np.int64], before: NDArray[np.int64], penalty: NDArray[np.int64], p1: int
) -> NDArray[np.int64]:
    """Return L(p, ·) from C(p, ·) and L(q, ·), (D, N) each, for N paths at once; `penalty` is (N,) P2."""
    floor = before.min(axis=0)
    outside = np.full_like(before[:1], np.iinfo(np.int32).max)
    down = np.concatenate([outside, before[:-1]]) + p1
    up = np.concatenate([before[1:], outside]) + p1
    advanced: NDArray[np.int64] = costs + np.minimum(np.minimum(before, floor + penalty), np.minimum(down, up)) - floor
    return advanced
