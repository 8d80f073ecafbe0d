"""Find false loop closures of a walk: pairs of places that look the same, but are far apart along the path."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.poses.placement.placed_model import PlacedModel, pairs_of
from pano_mvs.algorithms.poses.solved_models import solved_models
from pano_mvs.core.arrays import FloatArray
from pano_mvs.scene import Features, TwoView

Pair = tuple[str, str]


@dataclass(frozen=True)
class FalseClosure:
    """A loop closure that contradicts the path."""

    pair: Pair  # the images
    steps: float  # distance between the two places of the same points, in median steps of the path


def find_false_closures(features: Mapping[str, Features], two_views: Mapping[Pair, TwoView]) -> list[FalseClosure]:
    """Return the pairs that join places which are far apart, by the path of the cameras.

    The poses are solved from the pairs in sequence alone. Points that a closure matches have two positions in this
    model, one from either stretch of the path. For a true closure, they differ by the drift of the path, at most 2 % of
    its length between the two images. Rooms that look the same give matches that agree perfectly with each other, but
    their points are elsewhere. Captures that were not taken along a path are not tested, nor are closures with too few
    points that are known twice.

    Args:
        features: key points by image name, in the order in which the images were taken.
        two_views: verified pairs.
    """
    place = {name: idx for idx, name in enumerate(features)}

    def is_near(pair: Pair) -> bool:
        return abs(place[pair[0]] - place[pair[1]]) <= 10

    def is_path(pairs: Collection[Pair]) -> bool:
        return sum(abs(place[a] - place[b]) == 1 for a, b in pairs) >= 0.8 * (len(place) - 1)

    # Captures are tested that have this number of images, in which most consecutive images are paired, valid or not …
    if len(place) < 20 or not is_path(two_views) or all(map(is_near, two_views)):
        return []
    valid = [pair for pair, view in two_views.items() if view]
    sequence = [pair for pair in valid if is_near(pair)]
    # … and by valid pairs, most of which are in sequence.
    if len(sequence) == len(valid) or not is_path(sequence) or len(sequence) < 0.5 * len(valid):
        return []
    models, _ = solved_models(pairs_of(features, {pair: two_views[pair] for pair in sequence}))
    found = []
    for model in models:
        model.adjust()
        order = sorted(model.cameras)
        steps = np.linalg.norm(np.diff([model.cameras[image].center for image in order], axis=0), axis=1)
        step = float(np.median(steps))
        along = dict(zip(order, np.concatenate([[0.0], np.cumsum(steps)]).tolist(), strict=True))
        for pair in valid:
            images = place[pair[0]], place[pair[1]]
            if is_near(pair) or not model.cameras.keys() >= {*images}:
                continue
            first, second = map(_points, (model, model), images, two_views[pair].matches_idx.T)
            apart = np.linalg.norm(first - second, axis=1)
            apart = apart[np.isfinite(apart)]
            # A closure contradicts the path if its points are farther apart than this share of the path between both
            # images, and than this number of steps.
            allowed = max(2.0 * step, 0.02 * abs(along[images[0]] - along[images[1]]))
            if len(apart) >= 8 and float(np.median(apart)) > allowed:
                found.append(FalseClosure(pair, float(np.median(apart)) / step))
    return found


def _points(model: PlacedModel, image: int, keypoints: NDArray[np.int32]) -> FloatArray:
    """Return some key points of an image in the world, (M, 3), NaN where unknown."""
    camera, rays = model.cameras[image], model.pairs.bearings[image][keypoints]
    return camera.center + model.known_ranges(image)[keypoints, None] * (rays @ camera.rotation)
