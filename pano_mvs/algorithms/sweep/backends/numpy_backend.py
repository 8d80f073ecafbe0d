"""The readable sweep: the whole cost volume in memory, exact projection, one statement per step.

The reference against which compiled backends are held. Memory: about 20 bytes for each pixel and plane.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.sweep.costs import BUILTIN, checked_cost
from pano_mvs.algorithms.sweep.edge_support import averaged
from pano_mvs.algorithms.sweep.penalties import DIRECTIONS, step_penalties, warm_up
from pano_mvs.algorithms.sweep.preparation import SweepInput, source_weights
from pano_mvs.algorithms.sweep.settings import SweepSettings
from pano_mvs.algorithms.sweep.windows import CostWindow, box_mean
from pano_mvs.algorithms.sweep.winner import Winners
from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import pixel_from_ray, ray_grid, sample_panorama


def find_winners(work: SweepInput) -> Winners:
    """Return the winning plane of every pixel and the costs around it."""
    settings = work.settings
    volume = np.stack([combined_cost(work, virtual_range) for virtual_range in work.ranges], axis=1)
    if settings.aggregation == "sgm":
        stored = np.floor(np.minimum(volume * settings.cost_scale + 0.5, 255))
        volume = _aggregate(averaged(stored.astype(np.int64), work), work).astype(np.float64)
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


def combined_cost(work: SweepInput, virtual_range: float) -> FloatArray:
    """Return the mean cost of one plane over the sources that count, (H, W)."""
    return combine_costs(np.stack([_source_cost(work, idx, virtual_range) for idx in range(len(work.sources))]), work)


def combine_costs(costs: NDArray[np.floating], work: SweepInput) -> FloatArray:
    """Return the mean cost of the sources that count, (S, H, W) to (H, W); infinite where a source is not valid."""
    votes = np.isfinite(costs)
    weights = source_weights(costs.shape[1:], work.source_from_reference, work.settings)
    weights = np.where(votes, weights if len(weights) else 1.0, 0.0)
    order = np.argsort(costs, axis=0, kind="stable")
    ranked = np.take_along_axis(weights, order, axis=0)
    held_before = np.cumsum(ranked, axis=0) - ranked
    wanted = work.settings.weight_share * (1 - 1e-5) * ranked.sum(axis=0)
    place = np.arange(len(costs))[:, None, None]
    taken = np.where((held_before < wanted) & (place < work.settings.max_sources(len(costs))), ranked, 0.0)
    total = np.sum(taken * np.where(taken > 0, np.take_along_axis(costs, order, axis=0), 0.0), axis=0)
    seen = votes.any(axis=0)
    return np.where(seen, total / np.where(seen, taken.sum(axis=0), 1.0), work.settings.neutral_cost)


def _source_cost(work: SweepInput, idx: int, virtual_range: float) -> FloatArray:
    """Return the cost of one plane in one source, (H, W), infinite where the source is not valid."""
    size_hw = work.reference.shape[0], work.reference.shape[1]
    settings, source = work.settings, work.sources[idx]
    points = work.source_from_reference[idx].apply(ray_grid(size_hw) * virtual_range)
    pixels = pixel_from_ray(points, (source.shape[0], source.shape[1]))
    warped = np.floor(sample_panorama(source, pixels) + 0.5)
    window = CostWindow.of(size_hw, settings.box_radius, spherical=settings.spherical_window)
    cost = pixel_cost(work.reference, warped, settings)
    if not settings.matching_cost.averages_itself:
        cost = box_mean(cost, window)
    if work.source_valid is not None:
        cost[sample_panorama(work.source_valid[idx], pixels) < 1 - 1e-9] = np.inf
    return cost


def pixel_cost(reference: NDArray[np.uint8], warped: FloatArray, settings: SweepSettings) -> FloatArray:
    """Return the cost of each pixel before it is averaged, (H, W), by one of our costs or a plugin's."""
    size_hw, cost = (reference.shape[0], reference.shape[1]), settings.matching_cost
    radius = settings.box_radius if cost.averages_itself else settings.compare_radius
    found = cost.function(reference, warped, CostWindow.of(size_hw, radius, spherical=settings.spherical_window))
    return np.asarray(found, np.float64) if cost.name in BUILTIN else checked_cost(found, size_hw, cost.name)


def _aggregate(volume: NDArray[np.int64], work: SweepInput) -> NDArray[np.int64]:
    """Return the sum of eight paths' costs, (H, D, W)."""
    height, _, width = volume.shape
    settings = work.settings
    p1, _ = settings.penalties(height)
    before_pole, before_seam = warm_up((height, width))
    total = np.zeros_like(volume)
    for rows, columns in DIRECTIONS:
        penalties = step_penalties(work.contrast_picture, (rows, columns), settings).astype(np.int64)
        path = np.zeros(volume.shape[1:], np.int64)
        for i in range(-before_pole, height):
            row = i if i >= 0 else -1 - i
            row = row if rows > 0 else height - 1 - row
            beyond = 0 if i >= 0 else width // 2
            here = np.roll(volume[row], beyond, axis=-1)
            path = path_step(here, np.roll(path, columns, axis=-1), np.roll(penalties[row], beyond), p1=p1)
            if i >= 0:
                total[row] += path
    for step in (1, -1):
        penalties = step_penalties(work.contrast_picture, (0, step), settings).astype(np.int64)
        path = np.zeros((volume.shape[1], height), np.int64)
        for i in range(-before_seam, width):
            column = i % width if step > 0 else width - 1 - i % width
            path = path_step(volume[:, :, column].T, path, penalties[:, column], p1=p1)
            if i >= 0:
                total[:, :, column] += path.T
    return total


def path_step(
    costs: NDArray[np.int64], before: NDArray[np.int64], penalty: NDArray[np.int64], *, p1: int
) -> NDArray[np.int64]:
    """Return L(p, ·) from C(p, ·) and L(q, ·), (D, N) each, for N paths at once; `penalty` is (N,) P2."""
    floor = before.min(axis=0)
    outside = np.full_like(before[:1], np.iinfo(np.int32).max)
    down = np.concatenate([outside, before[:-1]]) + p1
    up = np.concatenate([before[1:], outside]) + p1
    advanced: NDArray[np.int64] = costs + np.minimum(np.minimum(before, floor + penalty), np.minimum(down, up)) - floor
    return advanced
