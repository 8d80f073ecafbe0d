"""The figures of one run of the dense stages that an ablation compares."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from pano_mvs_evaluation.clouds.distances import PointsInMemory, cloud_distances, score_cloud
from pano_mvs_evaluation.clouds.true_surface import TrueView, surface_of_views, view_points
from scipy.spatial import cKDTree

from pano_mvs.core.arrays import FloatArray, Mask
from pano_mvs.geometry import pixel_solid_angle
from pano_mvs.scene import PointCloud, RangeMap
from pano_mvs.scene.range_map import CONSISTENT_CONFIDENCE
from tools.benchmarks.captures import Capture
from tools.benchmarks.dense_chain import DenseRun

Figures = dict[str, float]

SCORES = ("delta", "kept", "surface_f")
# Largest ratio of a range that counts as right to the true one, in a map and on a surface.
_RIGHT, _PRECISE = 1.05, 1.01
# The precision at which the share of kept pixels is measured.
PRECISION = 0.95
# Tolerance of the cloud as a share of the median true range.
_TOLERANCE = 0.01
# Radius in baselines around the cameras within which real clouds are compared, and that of a point's neighbours.
_WITHIN, _NEIGHBOURS = 12.0, 0.4
_MAX_SAMPLES = 200_000
_SAMPLES, _MOST, _LEAST = 2000, 400, 12
_CELL_DEG = 4.0


def figures_of(capture: Capture, run: DenseRun, cloud: PointCloud) -> Figures:
    """Return all figures, shares in percent; those that need true ranges only where these are known."""
    names, maps = list(capture.panoramas), run.range_maps
    checked, last = ([step[name] for name in names] for step in (maps["checked"], list(maps.values())[-1]))
    truth = [capture.ranges[name] for name in names]
    if not any(np.isfinite(true).any() for true in truth):
        shares = {
            "confirmed": [share_of_sphere(item.confidence >= CONSISTENT_CONFIDENCE[0]) for item in checked],
            "valid": [share_of_sphere(item.valid) for item in last],
        }
        return {name: float(np.mean(values)) for name, values in shares.items()} | _walls(cloud, capture)
    return {**score_place(checked, last, truth), **_without_surface(last, truth), "cloud_f": _cloud_f(cloud, capture)}


def score(figures: Mapping[str, float]) -> float:
    """Return the mean of δ, kept and F; NaN without truth."""
    return float(np.mean([figures.get(name, np.nan) for name in SCORES]))


def score_place(checked: Sequence[RangeMap], last: Sequence[RangeMap], truth: Sequence[NDArray[np.float32]]) -> Figures:
    """Return means over the references of a place, in percent of the solid angle with a true surface.

    A range where the truth has none, such as in the sky, counts as wrong.

    Args:
        checked: of each reference, the map that the consistency check returned.
        last: of each reference, the map that the last stage returned.
        truth: of each reference, the true ranges (H, W), NaN where there is no surface.

    Returns:
        delta: pixels of the last range map within 5 % of the truth.
        kept: pixels that remain when, of the checked map's pixels in the order of their confidence, as many are kept
            as have a precision of 95 % (within 5 % of the truth).
        surface_f: F-score of the confirmed pixels within 1 % of the truth: harmonic mean of their precision and their
            completeness.
        confirmed: confirmed pixels.
        confirmed_delta: of the confirmed pixels (not of all pixels), those within 5 % of the truth.
    """
    rows = [_figures(*maps) for maps in zip(checked, last, truth, strict=True)]
    return {name: 100 * float(np.mean([row[name] for row in rows])) for name in rows[0]}


def _figures(checked: RangeMap, last: RangeMap, truth: NDArray[np.float32]) -> Figures:
    weight = np.broadcast_to(pixel_solid_angle(truth.shape)[:, None], truth.shape)
    weight = weight / weight[np.isfinite(truth)].sum()
    right = _within(checked.range, truth, _RIGHT)
    sure = checked.confidence >= CONSISTENT_CONFIDENCE[0]
    confirmed = float(weight[sure].sum())
    precise = float(weight[sure & _within(checked.range, truth, _PRECISE)].sum())
    return {
        "delta": float(weight[_within(last.range, truth, _RIGHT)].sum()),
        "kept": kept_at_precision(checked.confidence[checked.valid], right[checked.valid], weight[checked.valid]),
        "surface_f": 2 * precise / (confirmed + 1),
        "confirmed": confirmed,
        "confirmed_delta": float(weight[sure & right].sum()) / confirmed if confirmed else 0.0,
    }


def kept_at_precision(
    confidence: NDArray[np.uint8], right: Mask, weight: FloatArray, *, precision: float = PRECISION
) -> float:
    """Return the largest weight of the most confident pixels of which a share of `precision` is right.

    Args:
        confidence: (N,) of the pixels that have a range.
        right: (N,) whether the range is right.
        weight: (N,) of each pixel.
        precision: the share of kept weight that must be right.

    Returns:
        Weight of the pixels kept. Of pixels with equal confidence, a part may be kept, as if they were drawn at random.
    """
    levels, level = np.unique(255 - confidence, return_inverse=True)
    kept = np.concatenate([[0.0], np.cumsum(np.bincount(level, weight, len(levels)))])
    # How much more is right than the precision requires; kept pixels must not fall below 0.
    surplus = np.concatenate([[0.0], np.cumsum(np.bincount(level, weight * (right - precision), len(levels)))])
    enough = int(np.flatnonzero(surplus >= 0)[-1])
    if enough == len(levels):
        return float(kept[-1])
    share = surplus[enough] / (surplus[enough] - surplus[enough + 1])
    return float(kept[enough] + share * (kept[enough + 1] - kept[enough]))


def _within(ranges: NDArray[np.float32], truth: NDArray[np.float32], ratio: float) -> Mask:
    """Return where a range and the truth differ by at most a factor; not where either is missing."""
    with np.errstate(invalid="ignore", divide="ignore"):
        larger = np.maximum(ranges / truth, truth / ranges)
    return np.asarray(larger < ratio)


def _without_surface(last: Sequence[RangeMap], truth: Sequence[NDArray[np.float32]]) -> Figures:
    """Return the share of what has no surface that has a range, and the share of what has one that has none."""
    pairs = [(~np.isfinite(true), item.valid) for item, true in zip(last, truth, strict=True)]
    nothing = [share_of_sphere(valid, within=empty) for empty, valid in pairs if empty.any()]
    lost = [share_of_sphere(~valid, within=~empty) for empty, valid in pairs]
    return {"lost": float(np.mean(lost)), **({"nothing": float(np.mean(nothing))} if nothing else {})}


def share_of_sphere(where: Mask, *, within: Mask | None = None) -> float:
    """Return the share of the sphere, or of a part of it, in percent."""
    weights = np.broadcast_to(pixel_solid_angle(where.shape)[:, None], where.shape)
    part = np.ones(where.shape, np.bool_) if within is None else within
    return float(100 * weights[where & part].sum() / weights[part].sum())


def _cloud_f(cloud: PointCloud, capture: Capture) -> float:
    """Return the F-score of the cloud within 1 % of the median true range."""
    views = [TrueView(capture.poses[name], true) for name, true in capture.ranges.items()]
    surface = surface_of_views(views, max_samples=_MAX_SAMPLES)
    limit = _TOLERANCE * float(np.median(np.concatenate([view.range[np.isfinite(view.range)] for view in views])))
    points = PointsInMemory(cloud.points_in_world.astype(np.float32))
    distances = cloud_distances(points, (view_points(view) for view in views), surface, limit=limit)
    return 100 * score_cloud(distances, surface, [limit])[0].f_score


def _walls(cloud: PointCloud, capture: Capture) -> Figures:
    """Return the median thickness of the cloud's surfaces in baselines, and the share of directions with a point."""
    centers = np.array([pose.center for pose in capture.poses.values()])
    baseline = float(np.median(np.linalg.norm(np.diff(centers, axis=0), axis=1)))
    points = cloud.points_in_world.astype(np.float64)
    near = points[np.linalg.norm(points - centers.mean(axis=0), axis=1) < _WITHIN * baseline]
    thickness = float(np.median(thicknesses(near, _NEIGHBOURS * baseline))) / baseline
    return {"thickness": thickness, "cloud_complete": 100 * completeness(near, centers)}


def thicknesses(points: FloatArray, radius: float) -> FloatArray:
    """Return the deviation of the neighbours of at most 2,000 points along their least principal axis.

    Points with few neighbours are left out.
    """
    rng = np.random.default_rng(0)
    tree = cKDTree(points)
    found = []
    for idx in rng.choice(len(points), min(_SAMPLES, len(points)), replace=False):
        near = np.array(tree.query_ball_point(points[idx], radius))
        if len(near) < _LEAST:
            continue
        some = points[near if len(near) <= _MOST else rng.choice(near, _MOST, replace=False)]
        found.append(np.linalg.svd(some - some.mean(axis=0), compute_uv=False)[2] / np.sqrt(len(some)))
    return np.array(found)


def completeness(points: FloatArray, centers: FloatArray) -> float:
    """Return the share of the cells of 4° around the cameras in which there is a point."""
    rows = 2 * round(90 / _CELL_DEG)
    columns = np.maximum(1, np.rint(2 * rows * np.cos(np.pi * ((np.arange(rows) + 0.5) / rows - 0.5)))).astype(np.int64)
    occupied = 0
    for center in centers:
        x, y, z = ((points - center) / np.linalg.norm(points - center, axis=1, keepdims=True)).T
        row = np.minimum((np.arcsin(np.clip(y, -1, 1)) / np.pi + 0.5) * rows, rows - 1).astype(np.int64)
        column = np.minimum((np.arctan2(x, z) / (2 * np.pi) + 0.5) * columns[row], columns[row] - 1).astype(np.int64)
        occupied += len(np.unique(row * 4 * rows + column))
    return occupied / float(columns.sum() * len(centers))
