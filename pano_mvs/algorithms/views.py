"""View selection: choose the source images against which each reference is swept."""

from __future__ import annotations

from typing import Annotated

import numpy as np
import scipy

from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.errors import UsageError
from pano_mvs.core.settings import Setting, checks_settings
from pano_mvs.geometry import angle_between
from pano_mvs.scene import Poses, Views
from pano_mvs.scene.pose_groups import split_groups

# Triangulation angles around this one have full weight; in MVS practice the best compromise between precision and
# similarity is here (Schönberger et al., "Pixelwise view selection for unstructured multi-view stereo", 2016, use
# similar limits).
_BEST_ANGLE_DEG = 12.0


@checks_settings
def select_views(
    poses: Poses,
    *,
    sources: Annotated[int, Setting("maximum number of source images per reference", ge=1)] = 4,
    min_angle_deg: float = 1.0,
    max_angle_deg: float = 60.0,
) -> Views:
    """Select the source images of each registered image, best first.

    With tracks, a pair's score is the sum over the points that both see of a weight for the triangulation angle: 0
    outside [min, max], rising to 1 at 12° and then falling slowly. If a reference shares too few points with any image,
    and without tracks, near images come first, by the distance of the centres; images that are much closer than usual
    in the capture come after the others, since they have no parallax. Sources are in the reference's own group.

    Args:
        poses: of all registered images, with or without points.
        min_angle_deg: points seen under a smaller angle from the two centres are ignored.
        max_angle_deg: points seen under a larger angle are ignored.

    Returns:
        An entry for every registered image that has a source at another place, in the order of `poses.names`. Ties are
        broken by that order.

    Raises:
        UsageError: if sources is not positive or the angles do not form an interval.
    """
    if not 0 <= min_angle_deg < max_angle_deg <= 180:
        raise UsageError(f"views need 0 ≤ min_angle_deg < max_angle_deg ≤ 180, got {min_angle_deg} and {max_angle_deg}")
    found: dict[str, tuple[str, ...]] = {}
    for group in split_groups(poses):
        found |= _neighbours(group, count=sources, min_angle_deg=min_angle_deg, max_angle_deg=max_angle_deg)
    return Views({name: found[name] for name in poses.names if name in found})


def _neighbours(poses: Poses, *, count: int, min_angle_deg: float, max_angle_deg: float) -> dict[str, tuple[str, ...]]:
    """Return the sources of the images of one group."""
    distances = np.asarray(scipy.spatial.distance.cdist(poses.centers, poses.centers), np.float64)
    scores = _shared_point_scores(poses, min_angle_deg=min_angle_deg, max_angle_deg=max_angle_deg)
    others = np.where(distances > 0, distances, np.inf).min(axis=1, initial=np.inf)
    usual = float(np.median(others[np.isfinite(others)])) if np.isfinite(others).any() else 0.0
    too_close = distances < usual / 4
    preference = distances + np.where(too_close, 2 * distances.max(initial=0.0), 0.0)
    extent = float(distances.max(initial=0.0))
    # Centres closer than this share of the extent of the capture are at the same place.
    apart = distances > 1e-9 * max(extent, 1e-300)
    neighbours: dict[str, tuple[str, ...]] = {}
    for idx, name in enumerate(poses.names):
        usable = np.flatnonzero(apart[idx])
        order = usable[np.lexsort((usable, preference[idx, usable], -scores[idx, usable]))]
        if len(order):
            neighbours[name] = tuple(poses.names[source] for source in order[:count])
    return neighbours


def _shared_point_scores(poses: Poses, *, min_angle_deg: float, max_angle_deg: float) -> FloatArray:
    """Return the weighted number of shared points of all pairs, (N, N), symmetric; 0 if there are too few."""
    images = len(poses.names)
    scores, shared = np.zeros((images, images)), np.zeros((images, images), np.int64)
    order = np.lexsort((poses.track_image_idx, poses.track_point_idx))
    point = np.asarray(poses.track_point_idx)[order]
    image = np.asarray(poses.track_image_idx)[order]
    firsts, seconds = [np.zeros(0, np.intp)], [np.zeros(0, np.intp)]
    step = 1
    while step < len(point):
        same = np.flatnonzero(point[:-step] == point[step:])
        if not len(same):
            break
        same = same[image[same] != image[same + step]]
        firsts.append(order[same])
        seconds.append(order[same + step])
        step += 1
    first, second = np.concatenate(firsts), np.concatenate(seconds)
    if not len(first):
        return scores
    points = np.asarray(poses.points_in_world)[poses.track_point_idx[first]]
    image_a, image_b = poses.track_image_idx[first], poses.track_image_idx[second]
    centers = poses.centers
    with np.errstate(invalid="ignore", divide="ignore"):
        angle_deg = np.degrees(angle_between(points - centers[image_a], points - centers[image_b]))
    inside = (angle_deg >= min_angle_deg) & (angle_deg <= max_angle_deg)
    safe = np.where(inside, np.maximum(angle_deg, 1e-6), _BEST_ANGLE_DEG)
    weight = np.minimum(safe / _BEST_ANGLE_DEG, np.sqrt(_BEST_ANGLE_DEG / safe))
    weight = np.where(inside, weight, 0.0)
    np.add.at(scores, (image_a, image_b), weight)
    np.add.at(shared, (image_a, image_b), weight > 0)
    scores, shared = scores + scores.T, shared + shared.T
    # With fewer shared points than this, the overlap of two images cannot be judged.
    return np.where(shared >= 8, scores, 0.0)
