"""Slow, obvious versions of what is done with surfaces: normals, fusion, smoothing, meshes, scores."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.mesh.atlas import Texels
from pano_mvs.algorithms.mesh.kernels_mesh import MIN_COSINE, RANGE_TOLERANCE, SLOPE_PX
from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import (
    PinholeView,
    Rigid3,
    angle_between,
    pad_panorama,
    pixel_from_ray,
    pixel_solid_angle,
    ray_grid,
    sample_panorama,
)
from pano_mvs.scene import RangeMap
from tests.oracles.range_filters import sample_range, wrap


def normals(
    ranges: NDArray[np.float32], radius: int, max_step: float, columns_per_step: NDArray[np.int64]
) -> NDArray[np.float64]:
    height, width = ranges.shape
    rays = ray_grid(ranges.shape)
    result = np.full((height, width, 3), np.nan)
    for row, column in np.argwhere(np.isfinite(ranges)):
        equations, values = [], []
        for d_row in range(-radius, radius + 1):
            for d_column in range(-radius, radius + 1):
                other = wrap(row + d_row, column + d_column * columns_per_step[row], height, width)
                value = float(ranges[row, column]) / float(ranges[other])
                deviation = abs(value - 1) / (max_step * max(abs(d_row), abs(d_column), 1))
                if deviation < 1:
                    equations.append((1 - deviation**2) * rays[other])
                    values.append((1 - deviation**2) * value)
        if len(equations) >= 5:
            plane = np.linalg.lstsq(np.array(equations), np.array(values), rcond=None)[0]
            result[row, column] = -plane / np.linalg.norm(plane)
    return result


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


def surface_heights(
    points: NDArray[np.float32], normals: NDArray[np.float32], sigmas: NDArray[np.float32]
) -> NDArray[np.float64]:
    """Return what `smooth.surface_heights` returns, if all points of a cell count."""
    heights = np.zeros(len(points))
    for i, (point, normal, sigma) in enumerate(zip(points.astype(float), normals.astype(float), sigmas, strict=True)):
        across = np.linalg.svd(normal[None])[2][1:]
        offsets = points.astype(float) - point
        height = offsets @ normal
        place = offsets @ across.T / (2 * float(sigma))
        share = (place**2).sum(axis=1)
        deviation = height**2 / (6.25 * (sigma**2 + sigmas.astype(float) ** 2))
        near = (share < 1) & (deviation < 1) & (normals.astype(float) @ normal >= 0.8)
        weight = np.where(near, (1 - share) ** 2 * (1 - deviation) ** 2 / sigmas.astype(float) ** 2, 0.0)
        center = weight @ place / weight.sum()
        if near.sum() < 6 or np.linalg.norm(center) >= 0.3:
            continue
        root = np.sqrt(weight)[:, None]
        design = np.column_stack([np.ones(len(points)), place])
        heights[i] = np.linalg.lstsq(root * design, root[:, 0] * height, rcond=None)[0][0]
    return heights


def sees(
    point: NDArray[np.float64],
    home: NDArray[np.float64],
    pose: Rigid3,
    range_map: RangeMap,
    max_error: float,
    min_confidence: int,
    max_step: float = 0.05,
) -> tuple[NDArray[np.float64], float] | None:
    """The unit ray to the point, and the angle at `home` between it and where the view puts it; None if unseen."""
    in_cam = pose.apply(point)
    distance = np.linalg.norm(in_cam)
    pixel = pixel_from_ray(in_cam, range_map.range.shape)
    found = sample_range(range_map.range, pixel, max_step)
    column, row = np.floor(pixel).astype(int)
    if not abs(found - distance) <= max_error * distance or range_map.confidence[row, column] < min_confidence:
        return None
    there = pose.inverse().apply(in_cam / distance * found)
    angle = float(angle_between(point - home, there - home))
    return (in_cam / distance, angle) if angle <= 2 * np.pi / range_map.range.shape[1] else None


def nearest_triangles(corners_in_cam: FloatArray, size_hw: tuple[int, int]) -> tuple[FloatArray, NDArray[np.int64]]:
    """Intersect each ray with each triangle (Möller & Trumbore 1997): range, infinite if none, and triangle."""
    rays = ray_grid(size_hw).reshape(-1, 3)
    ranges, triangle = np.full(len(rays), np.inf), np.full(len(rays), -1)
    for idx, (a, b, c) in enumerate(corners_in_cam):
        normal_of_b = np.cross(rays, c - a)
        volume = normal_of_b @ (b - a)
        with np.errstate(divide="ignore", invalid="ignore"):
            of_b = normal_of_b @ -a / volume
            crossed = np.cross(-a, b - a)
            of_c = rays @ crossed / volume
            distance = (c - a) @ crossed / volume
        hit = (np.abs(volume) > 1e-12) & (of_b >= 0) & (of_c >= 0) & (of_b + of_c <= 1) & (distance > 0)
        nearer = hit & (distance < ranges)
        ranges[nearer], triangle[nearer] = distance[nearer], idx
    return ranges.reshape(size_hw), triangle.reshape(size_hw)


def mean_distances(
    places: FloatArray, maps: Sequence[tuple[RangeMap, Rigid3]], *, limit: float, middle: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return distances, weights and support of `Volume.add` at places (N, 3); maps have ranges and confidence only."""
    distances, weights, support = np.zeros((3, len(places)))
    for range_map, pose in maps:
        rays, (height, width) = ray_grid(range_map.range.shape), range_map.range.shape
        for idx, place in enumerate(pose.apply(places)):
            column, row = np.floor(pixel_from_ray(place, (height, width))).astype(int)
            at = min(row, height - 1), column % width
            found, r = float(range_map.range[at]), float(np.linalg.norm(place))
            across = found - float(rays[at] @ place)
            distance = found - r if abs(found - r) < abs(across) else across
            if found - r < -8 * limit or distance <= -limit:
                continue
            sure = (int(range_map.confidence[at]) - 128) / 127
            if distance > limit:
                around = [wrap(at[0] + i, at[1] + j, height, width) for i in (-1, 0, 1) for j in (-1, 0, 1)]
                support[idx] -= sure * (min(float(range_map.range[other]) for other in around) - r > limit)
                continue
            weight = (0.01 * middle / (0.03 * found)) ** 2 * (1.0 if distance >= 0 else 1.5 + 1.5 * distance / limit)
            support[idx] += sure
            distances[idx] += distance * weight
            weights[idx] += weight
    return distances / np.maximum(weights, 1e-30), weights, support


def texel_looks(
    texels: Texels,
    mesh: tuple[FloatArray, FloatArray, NDArray[np.int32]],
    view: tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.uint8], NDArray[np.float32]],
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The weight, the colour without detail and the detail of each texel; colours only where there is a weight."""
    vertices, normals, faces = mesh
    ranges, quality, picture, smooth = view
    weights = np.column_stack([1 - texels.weights.sum(axis=1, dtype=np.float64), texels.weights])
    corner = faces[texels.triangle]
    points = np.einsum("tk,tkc->tc", weights, vertices[corner])
    normal = normals[texels.triangle]
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    distance = np.linalg.norm(points, axis=1)
    cosine = -np.sum(points * normal, axis=1) / distance
    height, width = ranges.shape
    at = pixel_from_ray(points, (height, width))
    left, top = (np.floor(at - 0.5).astype(int) + 1).T
    around = [
        pad_panorama(values, 1)[top[:, None] + [0, 0, 1, 1], left[:, None] + [0, 1, 0, 1]].min(axis=1)
        for values in (ranges, quality)
    ]
    with np.errstate(invalid="ignore", divide="ignore"):
        slope = SLOPE_PX * np.pi / height * np.sqrt(1 - np.minimum(cosine**2, 1)) / cosine
    seen = (cosine >= MIN_COSINE) & (distance <= around[0] * (1 + RANGE_TOLERANCE + slope))
    base = sample_panorama(smooth, at)
    weight = np.where(seen, around[1] * cosine / distance**2, 0.0)
    return weight, base, sample_panorama(picture, at) - base


def pixels(
    estimated: NDArray[Any],
    truth: NDArray[Any],
    *,
    scale: float = 1.0,
    valid_only: bool = False,
    weighted: bool = False,
) -> Iterator[tuple[float | None, float, float]]:
    """(estimate or None, truth, weight) of every pixel that counts."""
    for row in range(truth.shape[0]):
        weight = float(pixel_solid_angle(truth.shape)[row]) if weighted else 1.0
        for column in range(truth.shape[1]):
            true, found = float(truth[row, column]), float(estimated[row, column]) * scale
            if not (math.isfinite(true) and true > 0):
                continue
            known = math.isfinite(found) and found > 0
            if known or not valid_only:
                yield (found if known else None), true, weight


def average(values: Sequence[tuple[float, float]]) -> float:
    """Mean of (value, weight) pairs."""
    total = sum(weight for _, weight in values)
    return sum(value * weight for value, weight in values) / total if total else float("nan")


def score(name: str, estimated: NDArray[Any], truth: NDArray[Any], *, peak: float = 10.0, scale: float = 1.0) -> float:
    """One score by its name in `score_view`."""
    valid_only, weighted = name.startswith("valid_"), "w_" in name[:8]
    base = name.removeprefix("valid_").removeprefix("w_")
    counted = list(pixels(estimated, truth, scale=scale, valid_only=valid_only, weighted=weighted))
    if base == "completeness":
        return average([(float(found is not None), weight) for found, _, weight in counted])
    if base == "psnr_db":
        mse = score(name.replace("psnr_db", "mse"), estimated, truth, peak=peak, scale=scale)
        return math.nan if math.isnan(mse) else math.inf if mse == 0 else -10 * math.log10(mse)
    if base == "rmse":
        return peak * math.sqrt(score(name.replace("rmse", "mse"), estimated, truth, peak=peak, scale=scale))
    return average([(of_pixel(base, found, true, peak), weight) for found, true, weight in counted])


def of_pixel(base: str, found: float | None, true: float, peak: float) -> float:
    """What one pixel adds to a mean."""
    error = true if found is None else abs(found - true)
    if base == "mse":
        return (error / peak) ** 2
    if base == "mae":
        return error
    if base == "abs_rel":
        return error / true
    if base.startswith("delta"):
        limit = {"delta_105": 1.05, "delta_125": 1.25, "delta_125_2": 1.25**2, "delta_125_3": 1.25**3}[base]
        return float(found is not None and max(found / true, true / found) < limit)
    if base.startswith("bad_abs_"):
        return float(found is None or error > float(base.removeprefix("bad_abs_")))
    assert base.startswith("bad_")
    return float(found is None or error / true > float(base.removeprefix("bad_")) / 100)


def z_depth(ranges: NDArray[np.float32], view: PinholeView, max_step: float = 0.05) -> NDArray[np.float64]:
    result = np.full(view.size_hw, np.nan)
    for row, column in np.ndindex(view.size_hw):
        bearing = view.bearings_from_pixels((column + 0.5, row + 0.5))
        found = sample_range(ranges, pixel_from_ray(bearing, ranges.shape), max_step)
        result[row, column] = found * float(bearing @ view.view_from_cam[2])
    return result
