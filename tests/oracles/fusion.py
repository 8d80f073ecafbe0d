"""Slow, obvious versions of what one source adds to the pixels of a reference view, and of the support around them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pano_mvs.geometry import Rigid3, angle_between, pixel_from_ray, sample_panorama
from tests.oracles.range_filters import sample_range, wrap


def footprint(view: NDArray[np.float64], normal: NDArray[np.float32]) -> float:
    """Return the area per steradian that a camera sees along `view`, from the camera to the point."""
    distance = float(np.linalg.norm(view))
    return distance**2 / max(float(-view @ normal) / distance, 0.05)


def add_source(
    reference: tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.float32], NDArray[np.bool_]],
    source_from_reference: Rigid3,
    source: tuple[NDArray[np.float32], NDArray[np.uint8], NDArray[np.uint8], NDArray[np.float32]],
    limits: NDArray[np.float64],
) -> dict[str, NDArray[Any]]:
    """Return what `kernels_fuse.add_source` adds to tallies of zeros."""
    ranges, rays, normals, written = reference
    source_ranges, source_confidence, image, uncertainty = source
    max_error, max_angle, max_step, max_ratio, merge_within, least_confidence = limits
    center = source_from_reference.inverse().apply(np.zeros(3))
    shape = ranges.shape
    yields, counts, violations = np.zeros(shape, np.bool_), np.zeros(shape, np.uint8), np.zeros(shape, np.uint8)
    confidence, sums, colors = np.zeros(shape, np.uint8), np.zeros((*shape, 4)), np.zeros((*shape, 4))
    precisions = np.zeros(shape)
    for row, column in np.argwhere(np.isfinite(ranges)):
        at = row, column
        point = float(ranges[at]) * rays[at]
        in_source = source_from_reference.apply(point)
        distance = float(np.linalg.norm(in_source))
        pixel = pixel_from_ray(in_source, source_ranges.shape)
        seen = sample_range(source_ranges, pixel, max_step)
        if not np.isfinite(seen):
            continue
        put = source_from_reference.inverse().apply(seen * in_source / distance)
        error = abs(seen - distance) / distance
        sure = source_confidence[int(pixel[1]), int(pixel[0]) % image.shape[1]]
        if error > max_error or angle_between(put, rays[at]) > max_angle:
            violations[at] = seen > distance * (1 + 2 * max_error) and sure >= least_confidence
            continue
        counts[at] = 1
        if not written[at]:
            continue
        confidence[at] = sure
        area = footprint(point - center, normals[at])
        yields[at] = footprint(point, normals[at]) > max_ratio * area
        colors[at] = np.append(sample_panorama(image, pixel[None])[0], 1) / area
        if error < merge_within:
            sigma = uncertainty[int(pixel[1]), int(pixel[0]) % image.shape[1]] if uncertainty.size else 1.0
            precisions[at] = 1 / (sigma * distance) ** 2
            weight = (1 - (error / merge_within) ** 2) ** 2 * precisions[at]
            sums[at] = weight * np.append(put, 1)
    return {
        "yields": yields,
        "counts": counts,
        "violations": violations,
        "confidence": confidence,
        "sums": sums,
        "colors": colors,
        "precisions": precisions if uncertainty.size else np.zeros((0, 0)),
    }


def supported(
    ranges: NDArray[np.float32],
    confirmed: NDArray[np.bool_],
    stretches: NDArray[np.int64],
    *,
    radius: int,
    max_step: float,
    least: float,
) -> NDArray[np.bool_]:
    """Return the pixels that are not confirmed while a share of their window is, on the same surface."""
    result = np.zeros(ranges.shape, np.bool_)
    for row, column in np.argwhere(np.isfinite(ranges) & ~confirmed):
        count = 0
        for d_row in range(-radius, radius + 1):
            for d_column in range(-radius, radius + 1):
                other = wrap(row + d_row, column + d_column * stretches[row], *ranges.shape)
                steps = max(abs(d_row), abs(d_column), 1)
                same = abs(ranges[row, column] / ranges[other] - 1) < max_step * steps
                count += bool(confirmed[other] and same)
        result[row, column] = count / (2 * radius + 1) ** 2 >= least
    return result
