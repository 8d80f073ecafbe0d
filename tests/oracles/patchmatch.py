"""Slow, obvious versions of the refinement by slanted planes: one pixel at a time, by least squares."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pano_mvs.geometry import Rigid3, pixel_from_ray, ray_from_pixel, sample_panorama
from tests.oracles.range_filters import wrap


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
