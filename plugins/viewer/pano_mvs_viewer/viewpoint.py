"""Viewpoints of the scene, and the rays of pixels in the window."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pano_mvs.core.arrays import FloatArray

OUTSIDE_ANGLE_DEG, INSIDE_ANGLE_DEG = 45.0, 80.0
# Share of the window that the scene fills.
_FILLED = 0.94


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """Position and direction of view."""

    eye: FloatArray  # (3,) in the world
    target: FloatArray  # (3,) point in the centre of the window
    up: FloatArray  # (3,) unit vector, up in the window
    angle_deg: float = OUTSIDE_ANGLE_DEG  # vertical field of view
    height: float = 0.0  # visible height in parallel projection, scene units; 0 for perspective

    @property
    def axes(self) -> FloatArray:
        """The directions right, down and forward of the window in the world, (3, 3), one per row."""
        forward = self.target - self.eye
        forward = forward / np.linalg.norm(forward)
        right = np.cross(forward, self.up)
        if np.linalg.norm(right) < 1e-9:
            right = np.cross(forward, np.eye(3)[int(np.argmin(np.abs(forward)))])
        right = right / np.linalg.norm(right)
        return np.stack([right, np.cross(forward, right), forward])

    def ray(self, x: float, y: float, size_wh: tuple[int, int]) -> tuple[FloatArray, FloatArray]:
        """Return the origin and the unit direction of the ray of a position in the window."""
        width, height = size_wh
        right, down, forward = self.axes
        # In halves of the height, from the centre.
        across, below = (2 * x - width) / height, (2 * y - height) / height
        if self.height:
            return self.eye + self.height / 2 * (across * right + below * down), forward
        reach = np.tan(np.deg2rad(self.angle_deg) / 2)
        direction = forward + reach * (across * right + below * down)
        return self.eye, direction / np.linalg.norm(direction)

    def turned(self, dx_px: float, dy_px: float, *, window_height: int) -> Viewpoint:
        """Return the view from the same position after dragging by this number of pixels to the right and down.

        Near the centre of the window, the point under the pointer stays there.
        """
        rad_per_px = np.deg2rad(self.angle_deg) / window_height
        _, _, forward = self.axes
        up = self.up
        level = forward - up * float(forward @ up)
        elevation = np.arctan2(float(forward @ up), float(np.linalg.norm(level)))
        steepest = np.deg2rad(89.0)  # straight up and down, the up direction is undefined
        elevation = float(np.clip(elevation + dy_px * rad_per_px, -steepest, steepest))
        level = level / max(float(np.linalg.norm(level)), 1e-12)
        aside = np.cross(level, up)
        turn = -dx_px * rad_per_px
        level = np.cos(turn) * level + np.sin(turn) * aside
        distance = float(np.linalg.norm(self.target - self.eye))
        target = self.eye + distance * (np.cos(elevation) * level + np.sin(elevation) * up)
        return replace(self, target=target)

    def zoomed(self, steps: float) -> Viewpoint:
        """Return the view with a smaller angle for positive steps, within limits."""
        angle = float(np.clip(self.angle_deg * 0.9**steps, 15.0, 110.0))
        return replace(self, angle_deg=angle)


def looking_along(eye: ArrayLike, direction: ArrayLike, up: ArrayLike) -> Viewpoint:
    """Return the view from inside a panorama along a direction (3,)."""
    place, along = np.asarray(eye, np.float64), np.asarray(direction, np.float64)
    return Viewpoint(place, place + along / np.linalg.norm(along), np.asarray(up, np.float64), INSIDE_ANGLE_DEG)


def outside_view(name: str, box: FloatArray, up: FloatArray, *, ahead: FloatArray, aspect: float) -> Viewpoint:
    """Return a view of a box from outside.

    Args:
        name: "overview", from above at an angle; "top", a plan; "front", an elevation, along `ahead`.
        box: (2, 3) minimum and maximum coordinates.
        up: (3,) unit.
        ahead: (3,) unit vector orthogonal to `up`: up in the plan, away from the viewer in the others.
        aspect: width of the window as a multiple of its height.
    """
    middle, right = box.mean(axis=0), np.cross(ahead, up)
    corners = np.array(np.meshgrid(*box.T)).reshape(3, -1).T - middle
    radius = float(np.linalg.norm(corners[0])) or 1.0
    if name == "overview":
        direction = 0.45 * right - 0.75 * ahead + 0.7 * up
        direction = direction / np.linalg.norm(direction)
        seen = Viewpoint(direction, np.zeros(3), up)
        return Viewpoint(middle + _distance(corners @ seen.axes.T, aspect) * direction, middle, up)
    away, upright = (up, ahead) if name == "top" else (-ahead, up)
    across, high = np.abs(corners @ right).max(), np.abs(corners @ upright).max()
    # Height of a plan or an elevation in halves of the scene, with space for the scale bar below.
    height = 2.25 * max(float(high), float(across) / aspect)
    return Viewpoint(middle + 2 * radius * away, middle, upright, height=height)


def _distance(corners: FloatArray, aspect: float) -> float:
    """Return the distance from which all corners, (N, 3) relative to the centre, are visible in the window."""
    reach = np.tan(np.deg2rad(OUTSIDE_ANGLE_DEG) / 2) * _FILLED
    needed = np.maximum(np.abs(corners[:, 0]) / aspect, np.abs(corners[:, 1])) / reach - corners[:, 2]
    return float(needed.max())


# Radius of a sphere as a share of the distance to the next camera, within these shares of the scene.
_RADIUS_SHARE, _RADIUS_LIMITS = 0.18, (0.008, 0.025)
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
    return min(wanted, 0.4 * gap) if gap > 0 else wanted


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
