"""Register a capture by chaining relative poses with translation scale factors."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pano_mvs.algorithms.poses.gauge import normalised_poses
from pano_mvs.algorithms.poses.registration import GrowingModel
from pano_mvs.algorithms.poses.scale import ScaleEstimator
from pano_mvs.algorithms.poses.tracks import Tracks, build_tracks, poses_with_points
from pano_mvs.algorithms.poses.view_graph import Edge, connected_groups, consistent_edges, relative_pose
from pano_mvs.geometry import Rigid3
from pano_mvs.scene import Features, Poses, TwoView

_MAX_ERROR_DEG, _MIN_ANGLE_DEG = 0.4, 1.0
_SEED_TRIALS = 5
_ADJUST_GROWTH = 1.2  # all cameras are adjusted whenever there are a fifth more than at the last time
_FULL_PARALLAX_DEG = 10.0


def solve_scaled_translation(
    features: Mapping[str, Features],
    two_views: Mapping[tuple[str, str], TwoView],
    *,
    scale_estimator: ScaleEstimator = "cauchy",
    kappa: float = 0.01,
    adjust: bool = True,
    rng: np.random.Generator,
) -> Poses:
    """Return the poses of a capture from its verified pairs, by translation scale factors.

    Yang, Kim & Lee, "Dense Depth Estimation from Multiple 360-degree Images Using Virtual Depth", generalised from
    views that all see the first to an unordered set: from a seed pair on, every image is attached to registered ones
    by the pair's rotation and direction; the length of its translation is the one at which points that are known
    already come to lie where they are. It stays only if it sees enough known points where they should be.

    Args:
        features: key points by image name, in the capture's order.
        two_views: verified pairs.
        scale_estimator: see `estimate_scale`; "kappa" is the paper's.
        kappa: the paper's κ.
        adjust: whether to adjust all cameras and points together now and then, which keeps errors from piling up;
            without it the poses are those of the chain, as in the paper.
        rng: not drawn from today; part of the contract of pose solvers.

    Returns:
        Poses in the frame of the first registered camera, the first baseline being 1. What cannot be attached with
        enough support is in `rejected`, with the reason; without any sound pair that is every image.
    """
    del rng
    names = tuple(features)
    edges = consistent_edges(names, two_views)
    group = connected_groups(edges, len(names))[0] if names else []
    if len(group) < 2:
        return _nothing({name: _why_alone(name, two_views) for name in names})
    inside = {edge: view for edge, view in edges.items() if edge[0] in group}
    kept = {(names[a], names[b]): view for (a, b), view in inside.items()}
    tracks = build_tracks(features, {**kept})
    models = []
    for seed in _seeds(inside):
        model, reasons = _grown(GrowingModel(tracks, inside, scale_estimator, kappa), seed, adjust=adjust)
        models.append((model, reasons))
        if len(model.cameras) == len(group):
            break
    model, reasons = max(models, key=lambda grown: len(grown[0].cameras))
    if adjust:
        model.adjust()
    rejected = {names[image]: reason for image, reason in reasons.items()}
    rejected |= {name: _why_alone(name, two_views) for i, name in enumerate(names) if i not in group}
    return _finished(model, tracks, rejected)


def _seeds(edges: Mapping[Edge, TwoView]) -> list[Edge]:
    """Return the pairs to begin with, best first: many matches, and parallax enough to know their range."""

    def quality(edge: Edge) -> tuple[float, Edge]:
        view = edges[edge]
        return -len(view) * min(view.parallax_deg / _FULL_PARALLAX_DEG, 1.0), edge

    return sorted(edges, key=quality)[:_SEED_TRIALS]


def _grown(model: GrowingModel, seed: Edge, *, adjust: bool) -> tuple[GrowingModel, dict[int, str]]:
    """Attach image after image, the one that sees most known points first; return also why the rest was refused."""
    model.add(seed[0], Rigid3.identity())
    model.add(seed[1], relative_pose(model.edges, *seed))
    left = sorted({image for edge in model.edges for image in edge} - set(seed))
    adjusted = 0

    def adjust_now_and_then() -> None:
        nonlocal adjusted
        if adjust and len(model.cameras) > _ADJUST_GROWTH * adjusted:
            model.adjust()
            adjusted = len(model.cameras)

    return model, model.attach_all(left, after_each=adjust_now_and_then)


def _finished(model: GrowingModel, tracks: Tracks, rejected: dict[str, str]) -> Poses:
    images = sorted(model.cameras)
    poses = Poses.without_points(
        {tracks.names[image]: model.cameras[image] for image in images},
        rejected=rejected,
        frame="the first registered camera",
        scale="the first reference–neighbour baseline is 1",
        metric=False,
    )
    return poses_with_points(
        normalised_poses(poses), tracks, max_error_deg=_MAX_ERROR_DEG, min_angle_deg=_MIN_ANGLE_DEG
    )


def _nothing(rejected: dict[str, str]) -> Poses:
    return Poses.without_points(
        {}, rejected=rejected, frame="the first registered camera", scale="none: no image is registered", metric=False
    )


def _why_alone(name: str, two_views: Mapping[tuple[str, str], TwoView]) -> str:
    """Return in a photographer's words why an image is joined to no group."""
    tried = [(len(view), view.candidates, pair, view) for pair, view in two_views.items() if name in pair]
    if not tried:
        return "it was compared with no other picture"
    _, _, pair, view = max(tried, key=lambda item: item[:3])
    partner = pair[1] if pair[0] == name else pair[0]
    if view:
        return f"its {len(view)} matches to {partner!r} are not joined to the other pictures, or contradict them"
    return f"no sound pair; the best partner is {partner!r}: {view.reason}"
