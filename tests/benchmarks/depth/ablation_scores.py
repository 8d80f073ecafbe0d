"""The figures of one run of the dense stages that an ablation compares."""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pano_mvs.engine.stages.context import Context
from pano_mvs.evaluation.clouds.distances import PointsInMemory, cloud_distances, score_cloud
from pano_mvs.evaluation.clouds.true_surface import TrueView, surface_of_views, view_points
from pano_mvs.geometry import pixel_solid_angle
from pano_mvs.scene import PointCloud, Pose, RangeMap
from pano_mvs.scene.range_map import CONSISTENT_CONFIDENCE
from tests.benchmarks.captures import Capture
from tests.benchmarks.dense_chain import DenseChain, DenseRun
from tests.benchmarks.depth.place_scores import score_place
from tests.benchmarks.walls import completeness, thicknesses

Figures = dict[str, float]

# Tolerance of the cloud as a share of the median true range.
_TOLERANCE = 0.01
# Radius in baselines around the cameras within which real clouds are compared, and that of a point's neighbours.
_WITHIN, _NEIGHBOURS = 12.0, 0.4
_MAX_SAMPLES = 200_000


def figures_of(capture: Capture, run: DenseRun, chain: DenseChain, *, drops_uncertainty: bool) -> Figures:
    """Return all figures, shares in percent; those that need true ranges only where these are known."""
    maps = run.range_maps
    checked, last = maps["checked"], list(maps.values())[-1]
    names = list(capture.panoramas)
    cloud = fused(capture, chain, run, drops_uncertainty=drops_uncertainty)
    if not any(np.isfinite(capture.ranges[name]).any() for name in names):
        return {**_shares(checked, last), **_walls(cloud, capture)}
    truth = [capture.ranges[name] for name in names]
    scores = score_place([checked[name] for name in names], [last[name] for name in names], truth)
    figures = {name: value for name, value in dataclasses.asdict(scores).items() if name != "cpu_s"}
    return {**figures, **_without_surface(last, capture), "cloud_f": _cloud_f(cloud, capture)}


def fused(capture: Capture, chain: DenseChain, run: DenseRun, *, drops_uncertainty: bool) -> PointCloud:
    """Return the cloud of the workflow's fusion, of the maps that it is wired to."""
    name, entry = next((name, entry) for name, entry in chain.stages.items() if entry.spec.output is PointCloud)
    items = run.range_maps[chain.graph.edges[name]["ranges"].producer]
    if drops_uncertainty:
        items = {image: dataclasses.replace(item, uncertainty=None) for image, item in items.items()}
    context = Context(np.random.default_rng(0), Path(tempfile.gettempdir()))
    given: dict[str, Any] = {"params": entry.params, "ctx": context}
    extras = {argument: given[what] for argument, what in entry.spec.extras.items()}
    poses = {image: Pose(pose) for image, pose in capture.poses.items()}
    cloud = entry.spec.function(ranges=items, poses=poses, images=dict(capture.panoramas), **extras)
    assert isinstance(cloud, PointCloud)
    return cloud


def _shares(checked: Mapping[str, RangeMap], last: Mapping[str, RangeMap]) -> Figures:
    """Return the shares of the sphere that are confirmed, and that have a range in the end."""
    confirmed = [_share(item.confidence >= CONSISTENT_CONFIDENCE[0]) for item in checked.values()]
    valid = [_share(item.valid) for item in last.values()]
    return {"confirmed": float(np.mean(confirmed)), "valid": float(np.mean(valid))}


def _without_surface(last: Mapping[str, RangeMap], capture: Capture) -> Figures:
    """Return the share of what has no surface that has a range, and the share of what has one that has none."""
    empty = {name: ~np.isfinite(true) for name, true in capture.ranges.items()}
    with_sky = {name: last[name].valid for name, where in empty.items() if where.any()}
    nothing = [100 * _share(empty[name] & valid) / _share(empty[name]) for name, valid in with_sky.items()]
    lost = [100 * _share(~empty[name] & ~item.valid) / _share(~empty[name]) for name, item in last.items()]
    return {"lost": float(np.mean(lost)), **({"nothing": float(np.mean(nothing))} if nothing else {})}


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


def _share(where: NDArray[np.bool_]) -> float:
    """Return the share of the sphere, in percent."""
    weights = pixel_solid_angle(where.shape)
    return float(100 * (where.mean(axis=1) * weights).sum() / weights.sum())
