"""Sizes of objects in the scene, and lengths as text."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray

# Radius of a sphere as a share of the distance to the next camera, within these shares of the scene.
_RADIUS_SHARE, _RADIUS_LIMITS = 0.18, (0.008, 0.025)
_CROWDED_SHARE = 0.4
_BOX_SHARES, _OUTER_SHARES = (0.01, 0.99), (0.0005, 0.9995)


def sphere_radius(centers: FloatArray, box: FloatArray) -> float:
    """Return the radius of the spheres of cameras, at which they neither touch nor vanish; scene units."""
    size = float(np.linalg.norm(box[1] - box[0])) or 1.0
    least, most = (share * size for share in _RADIUS_LIMITS)
    if len(centers) < 2:
        return most
    from scipy.spatial import cKDTree

    gaps = np.asarray(cKDTree(centers).query(centers, k=2)[0])[:, 1]
    gap = float(np.median(gaps))
    wanted = min(max(_RADIUS_SHARE * gap, least), most)
    return min(wanted, _CROWDED_SHARE * gap) if gap > 0 else wanted


def box_of(points: NDArray[np.floating], centers: FloatArray) -> FloatArray:
    """Return the box, (2, 3), in which nearly all points (N, 3) and all cameras (M, 3) lie; never empty."""
    corners = [centers] if len(centers) else []
    if len(points):
        corners.append(np.asarray(np.quantile(np.asarray(points, np.float64), _BOX_SHARES, axis=0)))
    if not corners:
        return np.array([[-1.0, -1, -1], [1, 1, 1]])
    together = np.concatenate(corners)
    box = np.stack([together.min(axis=0), together.max(axis=0)])
    if np.ptp(box, axis=0).max() < 1e-9:
        box = box + np.array([[-1.0], [1.0]])
    return box


def outer_box(points: NDArray[np.floating], box: FloatArray) -> FloatArray:
    """Return a box, (2, 3), in which the thinly sampled ends of a cloud (N, 3) lie too.

    Points become sparse with the distance from the cameras, so a small share of them may be half a corridor. Points
    farther away than half the longest side of the scene's box are treated as outliers.
    """
    if not len(points):
        return box
    margin = np.ptp(box, axis=0).max() / 2
    low, high = np.quantile(np.asarray(points, np.float64), _OUTER_SHARES, axis=0)
    return np.stack([np.clip(low, box[0] - margin, box[0]), np.clip(high, box[1], box[1] + margin)])


def length_text(length: float, unit: str) -> str:
    """Return a length with its unit, as text."""
    if unit != "m":
        return f"{length:.4g} {unit}"
    return f"{length:.3f} m" if length >= 1 else f"{100 * length:.1f} cm"


def bar_text(length: float, unit: str) -> str:
    """Return a round length with its unit, as text."""
    return f"{length:g} {unit.removesuffix('s') if length == 1 else unit}"


def bar_length(extent: float) -> float:
    """Return the largest length of the form 1, 2 or 5 × 10ⁿ that is at most a quarter of an extent."""
    power = 10.0 ** np.floor(np.log10(extent / 4))
    return float(next(step * power for step in (5, 2, 1) if step * power <= extent / 4 * (1 + 1e-9)))
