"""Compiled: what a view sees where points of another view land: the same, something farther, something nearer."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.kernels import inlined, kernel
from pano_mvs.geometry.kernels_sphere import angle_between, corners_at, even_atan2, pixel_at, pixel_from_ray

Triple = FloatArray | tuple[float, float, float]

# Verdicts of a source on a point: no information; it sees the same surface; it sees something farther away through
# the point; something nearer hides the point.
UNKNOWN, AGREES, CONTRADICTS, HIDDEN = 0, 1, 2, 3

_U = np.uint64
_FINE, _FINEST = 2.0**40, 2.0**60


@kernel
def sample_range(ranges: NDArray[np.float32], x: float, y: float, max_step: float) -> float:
    """Return the range between pixels: bilinear in 1/range if the four lie on one surface, else that of the nearest."""
    height, width = ranges.shape
    row_0, row_1, column_00, column_01, column_10, column_11, weight_x, weight_y = corners_at(x, y, height, width)
    r00, r01 = ranges[row_0, column_00], ranges[row_0, column_01]
    r10, r11 = ranges[row_1, column_10], ranges[row_1, column_11]
    near, far = min(min(r00, r01), min(r10, r11)), max(max(r00, r01), max(r10, r11))
    # min and max may swallow a NaN; the sum does not.
    if math.isfinite(r00 + r01 + r10 + r11) and far <= near * (1 + max_step):
        upper = (1 - weight_x) / r00 + weight_x / r01
        lower = (1 - weight_x) / r10 + weight_x / r11
        return float(1.0 / ((1 - weight_y) * upper + weight_y * lower))
    if weight_y < 0.5:
        return float(r00) if weight_x < 0.5 else float(r01)
    return float(r10) if weight_x < 0.5 else float(r11)


@inlined
def transformed(point: Triple, rotation: FloatArray, translation: FloatArray) -> tuple[float, float, float]:
    """Return R x + t of a point (3 numbers)."""
    a = rotation[0, 0] * point[0] + rotation[0, 1] * point[1] + rotation[0, 2] * point[2] + translation[0]
    b = rotation[1, 0] * point[0] + rotation[1, 1] * point[1] + rotation[1, 2] * point[2] + translation[1]
    c = rotation[2, 0] * point[0] + rotation[2, 1] * point[1] + rotation[2, 2] * point[2] + translation[2]
    return a, b, c


@inlined
def reprojection_angle(point: Triple, baseline: FloatArray, ratio: float) -> float:
    """Return the angle, at the reference, between a point and the source's point along its own ray.

    `baseline` is the source's centre in the reference frame; the source puts the point at
    baseline + ratio (point − baseline).
    """
    other_0 = baseline[0] + ratio * (point[0] - baseline[0])
    other_1 = baseline[1] + ratio * (point[1] - baseline[1])
    other_2 = baseline[2] + ratio * (point[2] - baseline[2])
    angle: float = angle_between(point[0], point[1], point[2], other_0, other_1, other_2)
    return angle


@kernel
def judge_point(
    point: Triple,
    rotation: FloatArray,
    translation: FloatArray,
    baseline: FloatArray,
    ranges: NDArray[np.float32],
    limits: Triple,
) -> tuple[int, float, float, float, float]:
    """Return (verdict, relative error, x, y, source range) of one source on one point.

    `limits` holds the maximum relative error, the maximum reprojection angle in radians, and the maximum relative
    step between neighbours on one surface.
    """
    a, b, c = transformed(point, rotation, translation)
    x, y = pixel_from_ray(a, b, c, ranges.shape[0], ranges.shape[1])
    distance = math.sqrt(a * a + b * b + c * c)
    if not distance > 0:
        return UNKNOWN, 0.0, x, y, 0.0
    seen = sample_range(ranges, x, y, limits[2])
    if not math.isfinite(seen):
        return UNKNOWN, 0.0, x, y, 0.0
    error = abs(seen - distance) / distance
    if error <= limits[0] and reprojection_angle(point, baseline, seen / distance) <= limits[1]:
        return AGREES, error, x, y, seen
    if seen > distance * (1 + 2 * limits[0]):
        return CONTRADICTS, error, x, y, seen
    if seen < distance * (1 - 2 * limits[0]):
        return HIDDEN, error, x, y, seen
    return UNKNOWN, error, x, y, seen


@inlined
def squared_motion(point: Triple, distance: float, baseline: FloatArray) -> float:
    """Return the squared motion of a point, in radians at the source, per relative change of its range.

    It is (sin γ r / d)², where γ is the angle between the two rays and r and d are the distances of the cameras.
    """
    square = point[0] * point[0] + point[1] * point[1] + point[2] * point[2]
    along = point[0] * baseline[0] + point[1] * baseline[1] + point[2] * baseline[2]
    length = baseline[0] * baseline[0] + baseline[1] * baseline[1] + baseline[2] * baseline[2]
    motion: float = max(square * length - along * along, 0.0) / distance**4
    return motion


@kernel
def locate_row(
    ranges: NDArray[np.float32],
    turns: FloatArray,
    elevation: tuple[float, float],
    view: tuple[FloatArray, FloatArray],
    size_hw: tuple[int, int],
    places: FloatArray,
) -> None:
    """Project the points of one row into a source, in loops that can be vectorised.

    `ranges`: (W,) float32 of the row; the place of a NaN is NaN. `turns`: (2, W) sin θ and cos θ of the columns.
    `elevation`: sin φ and cos φ of the row. `view`: rotation (3, 3) and translation (3,) source_from_reference.
    `size_hw`: of the source. `places`: (3, W) written: x and y in pixels, and the distance from the source.
    """
    rotation, translation = view
    sine, cosine = elevation
    r00, r01, r02, t0 = rotation[0, 0], rotation[0, 1], rotation[0, 2], translation[0]
    r10, r11, r12, t1 = rotation[1, 0], rotation[1, 1], rotation[1, 2], translation[1]
    r20, r21, r22, t2 = rotation[2, 0], rotation[2, 1], rotation[2, 2], translation[2]
    height, width = size_hw
    for i in range(_U(len(ranges))):
        r = ranges[i]
        p0, p1, p2 = r * (cosine * turns[0, i]), r * -sine, r * (cosine * turns[1, i])
        a = r00 * p0 + r01 * p1 + r02 * p2 + t0
        b = r10 * p0 + r11 * p1 + r12 * p2 + t1
        c = r20 * p0 + r21 * p1 + r22 * p2 + t2
        places[0, i] = (even_atan2(a, c) / (2 * math.pi) + 0.5) * width
        places[1, i] = (0.5 - even_atan2(-b, math.sqrt(a * a + c * c)) / math.pi) * height
    for i in range(_U(len(ranges))):
        r = ranges[i]
        p0, p1, p2 = r * (cosine * turns[0, i]), r * -sine, r * (cosine * turns[1, i])
        a = r00 * p0 + r01 * p1 + r02 * p2 + t0
        b = r10 * p0 + r11 * p1 + r12 * p2 + t1
        c = r20 * p0 + r21 * p1 + r22 * p2 + t2
        places[2, i] = math.sqrt(a * a + b * b + c * c)


@kernel
def reproject_row(
    ranges: NDArray[np.float32],
    turns: FloatArray,
    elevation: tuple[float, float],
    baseline: FloatArray,
    distances: FloatArray,
    seen: FloatArray,
    angles: FloatArray,
) -> None:
    """Write `reprojection_angle`, (W,), of the points of one row, in a loop that can be vectorised.

    `ranges`: (W,) float32 of the row. `turns`: (2, W) sin θ and cos θ of the columns. `elevation`: sin φ and cos φ of
    the row. `baseline`: (3,) the source's centre in the reference frame. `distances`: (W,) of the points from the
    source. `seen`: (W,) the source's ranges in their places. `angles`: (W,) written.
    """
    sine, cosine = elevation
    b0, b1, b2 = baseline[0], baseline[1], baseline[2]
    for i in range(_U(len(ranges))):
        r, ratio = ranges[i], seen[i] / distances[i]
        p0, p1, p2 = r * (cosine * turns[0, i]), r * -sine, r * (cosine * turns[1, i])
        o0, o1, o2 = b0 + ratio * (p0 - b0), b1 + ratio * (p1 - b1), b2 + ratio * (p2 - b2)
        x, y, z = p1 * o2 - p2 * o1, p2 * o0 - p0 * o2, p0 * o1 - p1 * o0
        angles[i] = even_atan2(math.sqrt(x * x + y * y + z * z), p0 * o0 + p1 * o1 + p2 * o2)


@kernel
def judge_row(
    ranges: NDArray[np.float32],
    turns: FloatArray,
    elevation: tuple[float, float],
    view: tuple[FloatArray, FloatArray, FloatArray],
    source_ranges: NDArray[np.float32],
    limits: Triple,
    verdicts: NDArray[np.uint8],
    found: FloatArray,
) -> None:
    """Write the verdicts of one source on the points of a row: what `judge_point` returns for each of them.

    `ranges`: (W,) float32 of the row. `turns`: (2, W) sin θ and cos θ of the columns. `elevation`: sin φ and cos φ of
    the row. `view`: rotation (3, 3), translation (3,) source_from_reference, and the source's centre (3,) in the
    reference. `source_ranges`: (Hs, Ws) float32. `limits`: see `judge_point`. `verdicts`: (W,) uint8, written. `found`:
    (5, W) written: x, y, distance from the source, the source's range, angle of the reprojection.
    """
    rotation, translation, baseline = view
    max_error, max_angle, max_step = limits[0], limits[1], limits[2]
    locate_row(ranges, turns, elevation, (rotation, translation), source_ranges.shape, found)
    for i in range(len(ranges)):
        place = found[2, i] > 0  # False for NaN
        found[3, i] = sample_range(source_ranges, found[0, i], found[1, i], max_step) if place else math.nan
    reproject_row(ranges, turns, elevation, baseline, found[2], found[3], found[4])
    for i in range(_U(len(ranges))):
        distance, seen = found[2, i], found[3, i]
        verdict = UNKNOWN  # for NaN, all comparisons are False
        verdict = CONTRADICTS if seen > distance * (1 + 2 * max_error) else verdict
        verdict = HIDDEN if seen < distance * (1 - 2 * max_error) else verdict
        agrees = (abs(seen - distance) / distance <= max_error) & (found[4, i] <= max_angle)
        verdicts[i] = AGREES if agrees else verdict


@kernel
def compare_rows(
    rows: tuple[int, int],
    ranges: NDArray[np.float32],
    grid: tuple[FloatArray, FloatArray],
    view: tuple[FloatArray, FloatArray],
    source_ranges: NDArray[np.float32],
    limits: Triple,
    counts: tuple[NDArray[np.uint16], NDArray[np.uint16], NDArray[np.uint16]],
    sums: tuple[FloatArray, FloatArray, FloatArray],
) -> None:
    """Add the verdicts of one source on the pixels of some rows to those of other sources.

    Sums are rounded to a multiple of 2⁻⁴⁰ or 2⁻⁶⁰, so that they do not depend on the order of the sources.

    `rows`: the first row, and the end. `ranges`: (H, W) float32 of the reference. `grid`: (2, W) sin θ and cos θ of the
    columns, (2, H) sin φ and cos φ of the rows. `view`: rotation (3, 3) and translation (3,) source_from_reference.
    `source_ranges`: (Hs, Ws) float32. `limits`: see `judge_point`. `counts`: (H, W) each: sources that agree, that
    contradict, and that see something nearer. `sums`: (H, W) each: of the supports (1 − (angle / limit)²)² of those
    that agree, of these times `squared_motion`, and of these times the squared angles.
    """
    rotation, translation = view
    width = ranges.shape[1]
    baseline = -(rotation.T @ translation)
    turns, elevations = grid
    verdicts, found = np.empty(width, np.uint8), np.empty((5, width))
    agreeing, contradicting, hiding = counts
    supports, motions, squared_errors = sums
    for row in range(rows[0], rows[1]):
        elevation = elevations[0, row], elevations[1, row]
        judge_row(
            ranges[row], turns, elevation, (rotation, translation, baseline), source_ranges, limits, verdicts, found
        )
        for i in range(width):
            verdict = verdicts[i]
            if verdict == AGREES:
                r = ranges[row, i]
                point = (r * (elevation[1] * turns[0, i]), r * -elevation[0], r * (elevation[1] * turns[1, i]))
                share = found[4, i] / limits[1]
                support = (1.0 - share * share) ** 2
                motion = squared_motion(point, found[2, i], baseline)
                squared_error = support * limits[1] ** 2 * (1 - math.sqrt(support))
                agreeing[row, i] += 1
                supports[row, i] += np.rint(support * _FINE) / _FINE
                motions[row, i] += np.rint(support * motion * _FINE) / _FINE
                squared_errors[row, i] += np.rint(squared_error * _FINEST) / _FINEST
            elif verdict == CONTRADICTS:
                contradicting[row, i] += 1
            elif verdict == HIDDEN:
                hiding[row, i] += 1


@kernel
def count_agreeing(
    points: FloatArray,
    view: tuple[FloatArray, FloatArray],
    source_ranges: NDArray[np.float32],
    limits: Triple,
    most: int,
    counts: NDArray[np.uint8],
) -> None:
    """Add 1 to the counts (N,) of the points (N, 3) of the reference with which a source agrees, up to `most`."""
    rotation, translation = view
    baseline = -(rotation.T @ translation)
    for i in range(len(points)):
        if counts[i] < most:
            point = (points[i, 0], points[i, 1], points[i, 2])
            verdict = judge_point(point, rotation, translation, baseline, source_ranges, limits)[0]
            counts[i] += verdict == AGREES


@kernel
def z_depth_rows(
    first: int,
    rows: int,
    ranges: NDArray[np.float32],
    view: tuple[FloatArray, float, float, float],
    max_step: float,
    z_depth: NDArray[np.float32],
) -> None:
    """Write the z-depths of some rows of a view.

    `first`: the first row. `rows`: number of rows. `ranges`: (H, W) float32 of the panorama, NaN invalid. `view`:
    (rotation view_from_cam (3, 3), focal length in px, principal point x, y). `max_step`: as in `sample_range`.
    `z_depth`: (h, w) float32, written.
    """
    rotation, focal, center_x, center_y = view
    height, width = ranges.shape
    for row in range(first, first + rows):
        b = (row + 0.5 - center_y) / focal
        for column in range(z_depth.shape[1]):
            a = (column + 0.5 - center_x) / focal
            ray_x = rotation[0, 0] * a + rotation[1, 0] * b + rotation[2, 0]
            ray_y = rotation[0, 1] * a + rotation[1, 1] * b + rotation[2, 1]
            ray_z = rotation[0, 2] * a + rotation[1, 2] * b + rotation[2, 2]
            x, y = pixel_from_ray(ray_x, ray_y, ray_z, height, width)
            z_depth[row, column] = sample_range(ranges, x, y, max_step) / math.sqrt(1 + a * a + b * b)


@kernel
def see_points(
    points: FloatArray,
    homes: FloatArray,
    max_angle: float,
    view: tuple[FloatArray, FloatArray],
    ranges: NDArray[np.float32],
    confidence: NDArray[np.uint8],
    limits: tuple[float, float, int],
    seen: NDArray[np.bool_],
    errors: FloatArray,
    bearings: FloatArray,
) -> None:
    """Write which points one view sees, with the angular error and the bearing of each.

    `points`: (N, 3) in the world. `homes`: (N, 3) centres of the cameras whose range maps the points come from.
    `max_angle`: maximum angle, at the home, between a point and the view's point on its own ray. `view`: (rotation (3,
    3), translation (3,)) cam_from_world. `ranges`: (H, W) float32 of the view. `confidence`: (H, W) uint8 of the view.
    `limits`: maximum relative error of the range, maximum relative step on a surface, minimum confidence. `seen`: (N,)
    bool, written. `errors`: (N,) float64, written where seen: the angle limited by `max_angle`. `bearings`: (N, 3)
    float64, written where seen: unit rays in the view's camera frame.
    """
    rotation, translation = view
    height, width = ranges.shape
    for idx in range(len(points)):
        point = points[idx] - homes[idx]
        moved = rotation @ homes[idx] + translation
        baseline = -(rotation.T @ moved)
        bounds = (limits[0], max_angle, limits[1])
        verdict, _, x, y, found = judge_point(point, rotation, moved, baseline, ranges, bounds)
        row, column = pixel_at(x, y, height, width)
        seen[idx] = verdict == AGREES and confidence[row, column] >= limits[2]
        if not seen[idx]:
            continue
        in_view = rotation @ point + moved
        distance = math.sqrt(in_view[0] ** 2 + in_view[1] ** 2 + in_view[2] ** 2)
        errors[idx] = reprojection_angle(point, baseline, found / distance)
        for axis in range(3):
            bearings[idx, axis] = in_view[axis] / distance
