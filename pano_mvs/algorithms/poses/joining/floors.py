"""The ratio of the units of two models from their floors: people take the panoramas of a capture at one height."""

from __future__ import annotations

import numpy as np

from pano_mvs.algorithms.poses.frame.horizontal_layers import floor_below
from pano_mvs.algorithms.poses.placement.placed_model import PlacedModel

_MAX_TILT_RAD = float(np.deg2rad(3.0))  # of a typical camera against all: others are not known to be upright
# Of heights within a model, relative to the floor; .4 to 1.3 % in a real tour, whose five models agree within 4 %.
_MAX_SPREAD = 0.05
_MIN_POINTS = 30


def scale_of_floors(first: PlacedModel, second: PlacedModel) -> float | None:
    """Return how long the unit of the second model is in that of the first, if cameras stand equally high in both.

    None where a model has no clear floor, or its cameras are not upright at one height above it.
    """
    heights = [_height(model) for model in (first, second)]
    return heights[0] / heights[1] if heights[0] and heights[1] else None


def _height(model: PlacedModel) -> float:
    """Return the height of the cameras of a model above its floor, in its unit; 0 if it is not known."""
    features = list(model.pairs.features.values())
    ups = np.array([camera.rotation.T @ features[image].ups[0] for image, camera in model.cameras.items()])
    up = ups.mean(axis=0)
    up /= max(float(np.linalg.norm(up)), 1e-12)
    if np.median(np.arccos(np.clip(ups @ up, -1, 1))) > _MAX_TILT_RAD:
        return 0.0
    centers = np.array([camera.center for camera in model.cameras.values()])
    points = []
    for image, camera in model.cameras.items():
        ranges = model.known_ranges(image)
        known = np.isfinite(ranges)
        points.append(camera.center + ranges[known, None] * (model.pairs.bearings[image][known] @ camera.rotation))
    floor = floor_below(np.concatenate(points), centers, up)
    if floor.points < _MIN_POINTS or np.std(centers @ up) > _MAX_SPREAD * floor.depth:
        return 0.0
    return floor.depth
