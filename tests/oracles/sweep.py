"""The parts of the sweep, one pixel at a time: slow and obvious."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def pixel_at(picture: NDArray[Any], row: int, column: int) -> Any:
    """Return the value at any row and column: the seam wraps, a pole reflects with half a turn."""
    height, width = picture.shape[:2]
    if row < 0:
        row, column = -1 - row, column + width // 2
    elif row >= height:
        row, column = 2 * height - 1 - row, column + width // 2
    return picture[row, column % width]


def census_cost(
    reference: NDArray[np.uint8], warped: NDArray[np.uint8], row: int, column: int, offsets: NDArray[np.int64]
) -> int:
    """Return how many neighbours are brighter than the centre in one picture but not in the other."""
    radius = len(offsets) // 2
    count = 0
    for rows in range(-radius, radius + 1):
        for columns in offsets:
            in_reference = pixel_at(reference, row + rows, column + columns) > pixel_at(reference, row, column)
            in_warped = pixel_at(warped, row + rows, column + columns) > pixel_at(warped, row, column)
            count += bool(in_reference != in_warped)
    return count


def box_mean(cost: NDArray[np.generic], row: int, column: int, *, radius: int, reach: int) -> float:
    """Return the mean over the window of 2 radius + 1 rows and 2 reach + 1 columns."""
    window = [
        float(pixel_at(cost, row + rows, column + columns))
        for rows in range(-radius, radius + 1)
        for columns in range(-reach, reach + 1)
    ]
    return float(np.mean(window))


def zncc_cost(
    reference: NDArray[np.uint8],
    warped: NDArray[np.uint8],
    row: int,
    column: int,
    *,
    radius: int,
    reach: int,
    noise: float,
) -> float:
    """Return 1 − ρ over the window of 2 radius + 1 rows and 2 reach + 1 columns."""
    places = [(row + j, column + i) for j in range(-radius, radius + 1) for i in range(-reach, reach + 1)]
    r, w = (np.array([float(pixel_at(picture, *place)) for place in places]) for picture in (reference, warped))
    return float(1 - np.mean((r - r.mean()) * (w - w.mean())) / np.sqrt((r.var() + noise) * (w.var() + noise)))


def sad_gradient_cost(
    reference: NDArray[np.uint8],
    warped: NDArray[np.uint8],
    row: int,
    column: int,
    *,
    reach: int,
    limits: tuple[int, int],
) -> int:
    """Return the absolute differences of colours and of gradients across and down, each sum cut off."""
    difference = reference.astype(int) - warped
    across = np.array(pixel_at(difference, row, column + reach)) - pixel_at(difference, row, column - reach)
    down = np.array(pixel_at(difference, row + 1, column)) - pixel_at(difference, row - 1, column)
    color = int(np.abs(difference[row, column]).sum())
    return min(color, limits[0]) + min(int(np.abs(across).sum() + np.abs(down).sum()), limits[1])


def combined_cost(voting: list[tuple[float, float]], *, share: float, most: int, neutral: float) -> float:
    """Return the weighted mean of the cheapest (cost, weight) that together hold a share of all weight."""
    wanted = share * sum(weight for _, weight in voting)
    taken: list[tuple[float, float]] = []
    for cost, weight in voting:
        if len(taken) < most and sum(held for _, held in taken) < wanted * (1 - 1e-5):
            taken.append((cost, weight))
    return sum(cost * weight for cost, weight in taken) / sum(weight for _, weight in taken) if taken else neutral


def path_pixels(
    size_hw: tuple[int, int], direction: tuple[int, int], line: int, *, warm: tuple[int, int]
) -> list[tuple[int, int]]:
    """Return the pixels of one path of semi-global matching, with those before the pole or the seam."""
    height, width = size_hw
    rows, columns = direction
    if rows == 0:
        order = [i % width if columns > 0 else width - 1 - i % width for i in range(-warm[1], width)]
        return [(line, column) for column in order]
    path = []
    for i in range(-warm[0], height):
        row, column = i, line + columns * i
        if row < 0:
            row, column = -1 - row, column + width // 2
        path.append((row if rows > 0 else height - 1 - row, column % width))
    return path


def path_costs(
    volume: NDArray[np.uint8], penalties: NDArray[np.uint16], path: list[tuple[int, int]], p1: int
) -> list[NDArray[np.int64]]:
    """Return L(p, ·) along a path through a volume (H, D, W), Hirschmüller's equation 13 term by term."""
    depth = volume.shape[1]
    before = [0] * depth
    result = []
    for row, column in path:
        p2 = int(penalties[row, column])
        now = []
        for d in range(depth):
            options = [before[d], min(before) + p2]
            options += [before[other] + p1 for other in (d - 1, d + 1) if 0 <= other < depth]
            now.append(int(volume[row, d, column]) + min(options) - min(before))
        result.append(np.array(now))
        before = now
    return result


def follow(
    costs: NDArray[Any], guides: NDArray[Any], penalties: NDArray[Any], p1: float, one_surface: float
) -> NDArray[np.float64]:
    """Return L along one path: costs (N, 2, K), guides (N, 2), penalties (N,)."""
    result = np.zeros(costs.shape)
    before = np.zeros(costs.shape[1:])
    last = np.zeros(2)
    for i in range(len(costs)):
        floor = before.min()
        for a in range(2):
            for k in range(costs.shape[2]):
                options = [floor + penalties[i]]
                for b in range(2):
                    if abs(guides[i, a] - last[b]) > one_surface:
                        continue
                    options.append(before[b, k])
                    options += [before[b, other] + p1 for other in (k - 1, k + 1) if 0 <= other < costs.shape[2]]
                result[i, a, k] = costs[i, a, k] + min(options) - floor
        before, last = result[i], guides[i]
    return result
