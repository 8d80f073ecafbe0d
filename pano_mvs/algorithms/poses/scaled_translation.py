"""Register a capture by chaining relative poses with translation scale factors, with several geometries per pair."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Annotated

import numpy as np

from pano_mvs.algorithms.poses.frame.gauge import no_poses, normalised_poses
from pano_mvs.algorithms.poses.growth_by_images import model_by_images, repeats
from pano_mvs.algorithms.poses.placement.pair_evidence import ScaleEstimator, estimate_scale
from pano_mvs.algorithms.poses.placement.placed_model import PlacedModel, pairs_of
from pano_mvs.algorithms.poses.placement.resection import why_no_pair
from pano_mvs.algorithms.poses.solved_models import solved_models
from pano_mvs.algorithms.poses.verification.confirmation import Confirmation, Picture
from pano_mvs.algorithms.poses.verification.correct_cameras import check_cameras
from pano_mvs.algorithms.poses.verification.verify_poses import poses_of, with_camera_checks
from pano_mvs.core.settings import Setting, checks_settings
from pano_mvs.scene import Features, Poses, TwoView
from pano_mvs.scene.pose_groups import join_groups


@checks_settings
def solve_scaled_translation(
    features: Mapping[str, Features],
    two_views: Mapping[tuple[str, str], TwoView],
    *,
    scale_estimator: Annotated[
        ScaleEstimator, Setting("estimator of translation scale factors; kappa is the paper's")
    ] = "cauchy",
    kappa: Annotated[float, Setting("width of the paper's clusters of scale factors", gt=0)] = 0.01,
    adjust: Annotated[bool, Setting("adjust all cameras and points as the model grows")] = True,
    load: Callable[[str], Picture] | None = None,
    rng: np.random.Generator,
) -> Poses:
    """Estimate the poses of a capture from its verified pairs by translation scale factors.

    Yang, Kim & Lee, "Dense Depth Estimation from Multiple 360-degree Images Using Virtual Depth", generalised from
    views that all see the first image to an unordered set. Starting from a seed pair, each image is placed by the
    rotations and directions of its pairs with registered images. The length of a translation is the one that puts
    points with known ranges at these ranges. All geometries of a pair are considered, not only the one with most
    matches, and a pose is chosen by all pairs of an image together (see `placements`). Where structure repeats, the
    images choose (see `model_by_images`).

    Args:
        features: key points by image name, in the capture's order.
        two_views: verified pairs.
        scale_estimator: see `estimate_scale`; "kappa" is the paper's.
        adjust: whether to adjust all cameras and points together at intervals, which keeps errors from accumulating. If
            False, the poses are those of the chain, as in the paper.
        load: returns the panorama and the mask of an image by its name; None leaves every decision to the pairs.
        rng: not used; part of the interface of pose solvers.

    Returns:
        Poses of all connected groups of two or more images. Each group is in the frame of its first camera, and its
        first baseline has length 1. Images that cannot be placed reliably are in `rejected`, with the reason.
    """
    del rng
    names = tuple(features)
    scale_of = partial(estimate_scale, estimator=scale_estimator, kappa=kappa)
    pairs = pairs_of(features, two_views, scale_of=scale_of, consistent=False)
    consistent = pairs.consistent()
    if load is None or not repeats(pairs, consistent):
        models, reasons = solved_models(consistent, adjust=adjust)
    else:
        confirmation = Confirmation(lambda image: load(names[image]))
        models, reasons = solved_models(pairs, adjust=adjust, grow=partial(model_by_images, confirmation=confirmation))
    groups = [_finished(model, adjust=adjust) for model in models]
    rejected = {
        name: reasons.get(image) or why_no_pair(name, two_views) or "its pairs contradict neighbouring pairs"
        for image, name in enumerate(names)
    }
    if not groups:
        return no_poses(rejected)
    return join_groups(groups, order=names, rejected=rejected)


def _finished(model: PlacedModel, *, adjust: bool) -> Poses:
    """Return a finished model as poses of one group, with points and with what its pairs say for its cameras."""
    if adjust:
        model.adjust()
    return with_camera_checks(normalised_poses(poses_of(model)), model.pairs, check_cameras(model))
