"""Slow, obvious versions of the filters on range maps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.filters.bilateral_solver import SphereCells
from pano_mvs.geometry import (
    Rigid3,
    angle_between,
    pad_panorama,
    pixel_from_ray,
    ray_from_pixel,
    ray_grid,
    sample_panorama,
)

UNKNOWN, AGREES, CONTRADICTS, HIDDEN = 0, 1, 2, 3


def wrap(row: int, column: int, height: int, width: int) -> tuple[int, int]:
    """The pixel in the picture that is meant by one outside of it."""
    if row < 0:
        row, column = -1 - row, column + width // 2
    elif row >= height:
        row, column = 2 * height - 1 - row, column + width // 2
    return row, column % width


def median(ranges: NDArray[np.float32], window: int) -> NDArray[np.float32]:
    pad = window // 2
    padded = pad_panorama(ranges, pad)
    result = np.full_like(ranges, np.nan)
    for row, column in np.argwhere(np.isfinite(ranges)):
        values = padded[row : row + window, column : column + window].ravel()
        values = np.sort(values[np.isfinite(values)])
        result[row, column] = values[(len(values) - 1) // 2]
    return result


def gaussian(ranges: NDArray[np.float32], window: int, sigma: float) -> NDArray[np.float64]:
    pad = window // 2
    offsets = np.arange(-pad, pad + 1)
    kernel = np.exp(-(offsets[:, None] ** 2 + offsets[None] ** 2) / (2 * sigma**2))
    padded = pad_panorama(ranges.astype(np.float64), pad)
    result = np.full(ranges.shape, np.nan)
    for row, column in np.argwhere(np.isfinite(ranges)):
        values = padded[row : row + window, column : column + window]
        weights = np.where(np.isfinite(values), kernel, 0)
        result[row, column] = np.sum(weights * np.nan_to_num(values)) / weights.sum()
    return result


def surfaces(ranges: NDArray[np.float32], max_step: float) -> NDArray[np.int64]:
    """Label of each pixel's connected surface, −1 where invalid; found by flooding."""
    height, width = ranges.shape
    labels = np.full(ranges.shape, -1)
    for start_row, start_column in np.argwhere(np.isfinite(ranges)):
        if labels[start_row, start_column] >= 0:
            continue
        label = start_row * width + start_column
        labels[start_row, start_column] = label
        stack = [(start_row, start_column)]
        while stack:
            row, column = stack.pop()
            for d_row, d_column in ((0, 1), (0, -1), (1, 0), (-1, 0)):
                other = wrap(row + d_row, column + d_column, height, width)
                near, far = sorted((ranges[row, column], ranges[other]))
                if labels[other] < 0 and far <= near * (1 + max_step):
                    labels[other] = label
                    stack.append(other)
    return labels


def sample_range(ranges: NDArray[np.float32], pixel: NDArray[np.float64], max_step: float) -> float:
    x, y = pixel - 0.5
    left, top = int(np.floor(x)), int(np.floor(y))
    weights = {}
    for d_row, w_row in ((0, 1 - (y - top)), (1, y - top)):
        for d_column, w_column in ((0, 1 - (x - left)), (1, x - left)):
            weights[top + d_row, left + d_column] = w_row * w_column
    values = {place: float(ranges[wrap(*place, *ranges.shape)]) for place in weights}
    if np.isfinite(list(values.values())).all() and max(values.values()) <= min(values.values()) * (1 + max_step):
        return float(1 / sum(weights[place] / values[place] for place in weights))
    return values[max(weights, key=lambda place: weights[place])]


def judge(
    ranges: NDArray[np.float32],
    source_from_reference: Rigid3,
    source_ranges: NDArray[np.float32],
    max_error: float,
    max_px: int,
    max_step: float,
) -> tuple[NDArray[np.uint8], NDArray[np.float64], NDArray[np.float64]]:
    """Verdict, support and squared motion of one source on every pixel, by points, pixels and back."""
    size, source_size = ranges.shape, source_ranges.shape
    rays = ray_grid(size)
    verdicts, supports, motions = np.zeros(size, np.uint8), np.zeros(size), np.zeros(size)
    for row, column in np.argwhere(np.isfinite(ranges)):
        point_in_source = source_from_reference.apply(float(ranges[row, column]) * rays[row, column])
        distance = np.linalg.norm(point_in_source)
        seen = sample_range(source_ranges, pixel_from_ray(point_in_source, source_size), max_step)
        if not np.isfinite(seen):
            continue
        back = source_from_reference.inverse().apply(seen * point_in_source / distance)
        cosine = back @ rays[row, column] / np.linalg.norm(back)
        error_px = np.arccos(np.clip(cosine, -1, 1)) * size[1] / (2 * np.pi)
        if abs(seen - distance) / distance <= max_error and error_px <= max_px:
            verdicts[row, column] = AGREES
            supports[row, column] = (1 - (error_px / max_px) ** 2) ** 2
            a_little_further = source_from_reference.apply((1 + 1e-6) * float(ranges[row, column]) * rays[row, column])
            motions[row, column] = (angle_between(point_in_source, a_little_further) / 1e-6) ** 2
        elif seen > distance * (1 + 2 * max_error):
            verdicts[row, column] = CONTRADICTS
        elif seen < distance * (1 - 2 * max_error):
            verdicts[row, column] = HIDDEN
    return verdicts, supports, motions


def fill(
    ranges: NDArray[np.float32],
    trusted: NDArray[np.bool_],
    columns_per_step: NDArray[np.int64],
    max_distance_px: int,
    max_ratio: float,
) -> NDArray[np.float64]:
    """Range of each invalid pixel from trusted ones along eight paths; NaN where fewer than two are found."""
    height, width = ranges.shape
    result = np.full(ranges.shape, np.nan)
    for row, column in np.argwhere(~np.isfinite(ranges)):
        found = []
        for d_row in (-1, 0, 1):
            for d_column in (-1, 0, 1):
                place = np.array([row, column])
                for step in range(1, max_distance_px + 1) if (d_row, d_column) != (0, 0) else ():
                    place = place + np.array(
                        [d_row, d_column * columns_per_step[wrap(place[0], place[1], height, width)[0]]]
                    )
                    at = wrap(place[0], place[1], height, width)
                    if trusted[at]:
                        found.append((1 / float(ranges[at]), step * np.hypot(d_row, d_column)))
                        break
        if len(found) >= 2:
            second = sorted(found)[1][0]
            behind = [(value, steps) for value, steps in found if value <= max_ratio * second]
            inverse = sum(value / steps for value, steps in behind) / sum(1 / steps for _, steps in behind)
            result[row, column] = 1 / inverse
    return result


def corner_weights(cells: SphereCells, row: int, column: int) -> NDArray[np.float64]:
    gap, down = cells.gap_of_row[row], cells.weight_row[row]
    upper, lower = cells.weight_upper[gap, column], cells.weight_lower[gap, column]
    return np.array([(1 - down) * (1 - upper), (1 - down) * upper, down * (1 - lower), down * lower])


def dense_system(
    target: NDArray[np.float64],
    weight: NDArray[np.float64],
    colors: NDArray[np.int64],
    cells: SphereCells,
    smoothness: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return A, b and S (V, N) of min λ yᵀ (D_m − D_n B̄ D_n) y + Σ c (Sᵀ y − t)²; `colors` is (H, W, 3) bins."""
    height, width = target.shape
    numbers: dict[tuple[int, ...], int] = {}
    entries = []
    for row in range(height):
        for column in range(width):
            corners = cells.corners[cells.element_of_pixel[cells.gap_of_row[row], column]]
            for cell, share in zip(corners, corner_weights(cells, row, column), strict=True):
                vertex = numbers.setdefault((int(cell), *map(int, colors[row, column])), len(numbers))
                entries.append((vertex, row * width + column, share))
    splat = np.zeros((len(numbers), height * width))
    for vertex, pixel, share in entries:
        splat[vertex, pixel] += share
    blur = 10.0 * np.eye(len(numbers))
    for (cell, *color), vertex in numbers.items():
        for position in range(cells.starts[cell], cells.starts[cell + 1]):
            other = numbers.get((int(cells.neighbours[position]), *color))
            if other is not None:
                blur[vertex, other] += cells.strengths[position]
        for channel in range(3):
            for step in (-1, 1):
                moved = list(color)
                moved[channel] += step
                other = numbers.get((cell, *moved))
                if other is not None:
                    blur[vertex, other] += 1
    mass = splat.sum(axis=1)
    n = np.ones_like(mass)
    for _ in range(10):
        n = np.sqrt(n * mass / (blur @ n))
    smooth = np.diag(n * (blur @ n)) - n[:, None] * blur * n
    matrix = smoothness * smooth + (splat * weight.ravel()) @ splat.T
    return matrix, splat @ (weight * target).ravel(), splat


def tangents(row: int, column: int, size_hw: tuple[int, int], stretch: float) -> list[NDArray[np.float64]]:
    """What a step of `stretch` columns and one of a row add to the ray of a pixel, to first order."""
    center = np.array([column + 0.5, row + 0.5])
    step = 1e-4
    return [
        (ray_from_pixel(center + d, size_hw) - ray_from_pixel(center - d, size_hw)) / (2 * step)
        for d in (np.array([step * stretch, 0]), np.array([0, step]))
    ]


def weighted_plane(
    rows: NDArray[np.float64], values: NDArray[np.float64], deviations: NDArray[np.float64]
) -> NDArray[Any] | None:
    """(α, β, γ) of the plane through values at rows (1, u, v), with Tukey's biweight; None if it is ill posed."""
    weight = np.where(np.abs(deviations) < 1, 1 - deviations**2, 0)
    if np.sum(weight**2) < 5 or np.linalg.det(np.cov(rows[:, 1:].T, aweights=weight**2, ddof=0)) < 0.25:
        return None
    return np.linalg.lstsq(rows * weight[:, None], values * weight)[0]


def plane_at(
    inverse: NDArray[Any], row: int, column: int, columns: NDArray[np.int64], stretch: float, max_step: float
) -> NDArray[np.float64]:
    """The plane p with p · ray = q around a pixel, by weighted least squares, twice."""
    size, radius = inverse.shape, len(columns) // 2
    q = inverse[row, column]
    places = [(v, k, u) for v in range(-radius, radius + 1) for k, u in enumerate(columns)]
    values = np.array([inverse[wrap(row + v, column + u, *size)] / q for v, _, u in places])
    rows = np.array([(1, u / stretch, v) for v, _, u in places])
    away = np.array([max(abs(k - radius), abs(v)) for v, k, _ in places])
    known = np.isfinite(values)
    rows, values, away = rows[known], values[known], away[known]
    slopes = np.array([1.0, 0, 0])
    for reach in (max_step * (1 + away), np.full(len(away), max_step)):
        found = weighted_plane(rows, values, (values - rows @ slopes) / reach)
        slopes = slopes if found is None else found
    ray = ray_from_pixel([column + 0.5, row + 0.5], size)
    across, down = tangents(row, column, size, stretch)
    result: NDArray[np.float64] = q * (
        slopes[0] * ray + slopes[1] * across / (across @ across) + slopes[2] * down / (down @ down)
    )
    return result


def window(
    grey: NDArray[Any], row: int, column: int, rows: Sequence[int], columns: NDArray[np.int64], sigma_color: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Positions (K, 2) of a window's samples, their values and their weights, which sum to 1."""
    places = np.array([(column + u + 0.5, row + v + 0.5) for v in rows for u in columns])
    values = np.array([grey[wrap(row + v, column + u, *grey.shape)] for v in rows for u in columns])
    weights = 1 / (1 + ((values - grey[row, column]) / sigma_color) ** 2)
    return places, values, weights / weights.sum()


def likely_inverse(
    plane: NDArray[np.float64],
    seen: tuple[Any, ...],
    sources: Sequence[tuple[NDArray[Any], Rigid3, bool]],
    steps_uv: NDArray[np.float64],
    settings: tuple[float, ...],
    shares: Sequence[float] | None = None,
) -> float:
    """The most likely inverse range at a window's centre, by normal equations over the better half of the sources.

    `seen` holds size, places, values and weights of the window; `sources` (grey, pose, votes) each; `steps_uv` (K, 2)
    where the samples lie; `settings` (noise, prior of α, prior of β and γ, samples, largest step); `shares` the weights
    of all sources, instead of the better half.
    """
    size, places, values, weights = seen
    noise, prior_q, prior_slope, samples, largest = settings
    rays = ray_from_pixel(places, size)
    design = np.column_stack([np.ones(len(steps_uv)), steps_uv])
    centred = values - weights @ values
    reference_spread = weights @ centred**2 + noise
    found = []
    for idx, (grey, pose, votes) in enumerate(sources):

        def look(delta: float, grey: NDArray[Any] = grey, pose: Rigid3 = pose) -> NDArray[np.float64]:
            directions = rays @ pose.rotation.T + pose.translation * (rays @ plane + delta)[:, None]
            return sample_panorama(grey, pixel_from_ray(directions, grey.shape))

        step = 1e-7 / float(np.linalg.norm(pose.translation))
        sample = look(0)
        sample = sample - weights @ sample
        slope = ((look(step) - look(-step)) / (2 * step))[:, None] * design
        slope -= weights @ slope
        spread = weights @ sample**2 + noise
        correlation = weights @ (sample * centred) / np.sqrt(spread * reference_spread)
        if votes:
            count = samples * (1.0 if shares is None else shares[idx])
            found.append((correlation, count, centred / np.sqrt(reference_spread), sample, slope, spread))
    found.sort(key=lambda entry: -entry[0])
    normal, right = np.diag([prior_q, prior_slope, prior_slope]), np.zeros(3)
    counted = found if shares is not None else found[: (len(found) + 1) // 2]
    for correlation, count, wanted, sample, slope, spread in counted:
        if correlation < 0.2:
            continue
        unit, change = sample / np.sqrt(spread), slope / np.sqrt(spread)
        along = (weights * unit) @ change
        information = count * spread / (noise + spread * (1 - correlation**2))
        normal += information * ((weights[:, None] * change).T @ change - np.outer(along, along))
        right += information * ((weights * wanted) @ change - correlation * along)
    q = plane @ rays[len(rays) // 2]
    return float(max(q + np.clip(np.linalg.solve(normal, right)[0], -largest, largest), q / 2))
