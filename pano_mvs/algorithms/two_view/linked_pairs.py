"""What the links of a virtual tour say about the relative pose of a pair of its scenes.

A link stands where the next scene is, or at the door that leads there: of 25 links between cameras of published tours,
19 were within 20° of the direction to the other camera, and one was more than 45° off (docs/benchmarks.md).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np

from pano_mvs.algorithms.two_view.verification import judged_again
from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import Rigid3
from pano_mvs.scene import Features, SceneLink, TwoView

# Of how far a link is from the other camera: shares of three distributions, normal ones with these standard deviations
# and any direction.
_SHARES, _STDS_DEG = (0.75, 0.20, 0.05), (10.0, 30.0)
# What is steeper has no azimuth worth the name: an arrow at the nadir that leads back, or a scene up the stairs.
_STEEPEST_DEG = 75.0


def judged_by_links(
    views: Mapping[tuple[str, str], TwoView],
    features: Mapping[str, Features],
    links: Mapping[str, Sequence[SceneLink]],
) -> dict[tuple[str, str], TwoView]:
    """Return pairs of learned matches whose scenes are linked, judged by the directions of these links as well.

    What two places have in common mostly lies in other directions than the links between them, so that links both
    accept poses that look alike could have, and reject some that matches alone would accept. Other pairs stay as they
    are.

    Args:
        views: all pairs.
        features: key points of the images.
        links: image name to its links.
    """
    result = dict(views)
    for (first, second), view in views.items():
        there, back = _directions(links.get(first, ()), second), _directions(links.get(second, ()), first)
        if not there and not back:
            continue
        ends = features[first], features[second]
        odds_of = partial(_odds_of_pose, there=there, back=back, ends=ends)
        result[first, second] = judged_again(*ends, view, odds_of=odds_of)
    return result


def _odds_of_pose(
    pose: Rigid3, *, there: Sequence[FloatArray], back: Sequence[FloatArray], ends: tuple[Features, Features]
) -> float:
    """Return what links from the first image to the second one and back say of a pose: a logarithm of odds."""
    return _log_odds(there, pose.center, ends[0]) + _log_odds(back, pose.translation, ends[1])


def _directions(links: Sequence[SceneLink], name: str) -> list[FloatArray]:
    """Return the unit rays of the links that lead to an image."""
    rays = []
    for link in links:
        if link.name == name and link.direction_deg is not None:
            yaw, pitch = np.deg2rad(link.direction_deg)
            rays.append(np.array([np.cos(pitch) * np.sin(yaw), -np.sin(pitch), np.cos(pitch) * np.cos(yaw)]))
    return rays


def _log_odds(stated: Sequence[FloatArray], direction: FloatArray, features: Features) -> float:
    """Return how much more likely links are where they stand if the other camera is in a direction; 0 without any."""
    up = np.array(features.ups[0])
    turns = [_turn_deg(ray, direction, up) for ray in stated]
    return max((_log_ratio(turn) for turn in turns if not np.isnan(turn)), default=0.0)


def _turn_deg(one: FloatArray, other: FloatArray, up: FloatArray) -> float:
    """Return the angle between two unit vectors around the vertical; NaN if one of them is too steep to have one."""
    level, other_level = (ray - (ray @ up) * up for ray in (one, other))
    if min(np.linalg.norm(level), np.linalg.norm(other_level)) < np.cos(np.deg2rad(_STEEPEST_DEG)):
        return float("nan")
    return float(np.rad2deg(np.arctan2(np.linalg.norm(np.cross(level, other_level)), level @ other_level)))


def _log_ratio(off_deg: float) -> float:
    """Return the logarithm of how likely a link is that far off, relative to one in any direction."""
    normal, far, anywhere = _SHARES
    density = anywhere / 360
    for share, std in zip((normal, far), _STDS_DEG, strict=True):
        density += share * np.exp(-0.5 * (off_deg / std) ** 2) / (std * np.sqrt(2 * np.pi))
    return float(np.log(density * 360))
