"""Slow, obvious versions of the filters on range maps."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.geometry import Rigid3, angle_between, pad_panorama, pixel_from_ray, ray_grid

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
