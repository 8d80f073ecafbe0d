"""The similarity between the worlds of two runs, by the cameras that stayed where they were."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np

from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3, geodesic_angle
from pano_mvs.geometry.pose_errors import align_centers, camera_extent
from pano_mvs.geometry.transforms import Similarity3

# Cameras that moved less are counted, not listed: a global solve moves every camera a little.
MOVED_SHARE, TURNED_DEG = 0.002, 0.1
_MOST_PAIRS = 300  # of cameras from which an alignment is tried
_NEAR = 2.5  # times the median: cameras that moved by less are of one arrangement


def align_runs(before: Mapping[str, Rigid3], after: Mapping[str, Rigid3]) -> Similarity3:
    """Return the similarity world_after from world_before in which at least half of the cameras move least.

    A least-squares fit spreads the movement of one camera over all. So fits to pairs of cameras are tried, too, and one
    to all cameras that agree with the best pair; the median change of the cameras decides (Rousseeuw 1984). Three
    cameras cannot say which of them moved: these get the least-squares fit.

    Args:
        before: cam_from_world by image name.
        after: those of the same images in the other run.

    Raises:
        UsageError: if there are fewer than two cameras, or their centres coincide in one of the runs.
    """
    names = list(before)
    fits = [_fit(before, after, names)]
    if len(names) < 4:
        return fits[0]
    for pair in _pairs(names):
        try:
            fits.append(_fit(before, after, pair))
        except UsageError:  # both in one place
            continue
    changes = [_change(fit, before, after) for fit in fits]
    best = min(changes, key=_median)
    near = [name for name, change in zip(names, best, strict=True) if change <= _NEAR * _median(best) + 1e-9]
    try:
        fits.append(_fit(before, after, near))
        changes.append(_change(fits[-1], before, after))
    except UsageError:
        pass
    return fits[min(range(len(fits)), key=lambda idx: _median(changes[idx]))]


def camera_changes(
    after_from_before: Similarity3, before: Mapping[str, Rigid3], after: Mapping[str, Rigid3]
) -> tuple[FloatArray, FloatArray]:
    """Return how far each camera moved, relative to the largest distance of two cameras, and its turn in degrees."""
    centers = after_from_before.apply([pose.center for pose in before.values()])
    steps = np.linalg.norm(centers - [after[name].center for name in before], axis=1)
    turned = geodesic_angle(
        np.array([pose.rotation @ after_from_before.rotation.T for pose in before.values()]),
        np.array([after[name].rotation for name in before]),
    )
    return steps / (camera_extent(after) or 1.0), np.rad2deg(turned)


def _fit(before: Mapping[str, Rigid3], after: Mapping[str, Rigid3], names: Sequence[str]) -> Similarity3:
    return align_centers({name: before[name] for name in names}, {name: after[name] for name in names})


def _pairs(names: Sequence[str]) -> list[tuple[str, str]]:
    """Return all pairs of cameras, or some of them, which are always the same."""
    count = len(names) * (len(names) - 1) // 2
    if count <= _MOST_PAIRS:
        return list(combinations(names, 2))
    drawn = np.random.default_rng(0).integers(len(names), size=(_MOST_PAIRS, 2))
    return [(names[first], names[second]) for first, second in drawn if first != second]


def _change(fit: Similarity3, before: Mapping[str, Rigid3], after: Mapping[str, Rigid3]) -> FloatArray:
    """Return the larger of the movement and the turn of each camera, in units of those that are listed."""
    moved, turned_deg = camera_changes(fit, before, after)
    return np.maximum(moved / MOVED_SHARE, turned_deg / TURNED_DEG)


def _median(change: FloatArray) -> float:
    """Return the change that more than half of the cameras do not exceed."""
    return float(np.sort(change)[len(change) // 2])
