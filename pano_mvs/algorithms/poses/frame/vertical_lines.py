"""The vertical from the edges of walls, doors and windows: the direction that most line segments point to.

A straight edge is seen on a great circle. All edges that are parallel in space lie on great circles through one
direction, so the normals of vertical edges are orthogonal to the vertical. Segments come from OpenCV's detector (R.
Grompone von Gioi et al., "LSD: a line segment detector", IPOL 2012) on pinhole views around the horizon.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.faces.layout import CUBE_ROTATIONS
from pano_mvs.algorithms.faces.render import face_image
from pano_mvs.algorithms.panoramas import reduced_panorama
from pano_mvs.algorithms.ranges.agreement import pixels_containing
from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.text import plural
from pano_mvs.geometry import (
    UP,
    PinholeView,
    pad_panorama,
    rotation_from_rotvec,
    rotation_from_two_vectors,
    spiral_rays,
)

Picture = Callable[[], tuple[NDArray[np.uint8], NDArray[np.bool_]]]
"""Returns a panorama (H, W, 3) uint8 and its valid pixels (H, W)."""

Support = Callable[[FloatArray, float], FloatArray]

SIDES = 4
"""Views of a panorama around the horizon; the other two look up and down."""
# Search around the given up direction: half width, step and tolerance in degrees.
_ROUNDS = ((20.0, 2.0, 3.0), (2.0, 0.5, 1.0), (0.5, 0.1, 0.5))
_MIN_SEGMENTS = 20
_WALL_ROUNDS_DEG, _DAMPING = (4.0, 2.0, 1.0, 0.5, 0.5), 0.02
_CLEAR_WALLS = 1.5  # support of the directions of walls, relative to the median over all level directions


@dataclass(frozen=True, eq=False)
class Segments:
    """Line segments in the world."""

    normals: FloatArray  # (M, 3) unit normals of the planes through the segments and their cameras
    weights: FloatArray  # (M,) lengths in radians
    # (M,) number of the view in which the segment was found; errors within a view are not independent
    groups: NDArray[np.int64]

    def turned(self, rotation: FloatArray) -> Segments:
        """Return the segments in a world that is turned by a rotation (3, 3)."""
        return Segments(self.normals @ rotation.T, self.weights, self.groups)

    def nearly_vertical(self, up: FloatArray, *, groups: int) -> Segments:
        """Return the segments of the first groups that point to within 25° of `up` (3,)."""
        # Segments that are farther from pointing up than this cannot be vertical.
        near = (np.abs(self.normals @ up) < np.sin(np.deg2rad(25.0))) & (self.groups < groups)
        return Segments(self.normals[near], self.weights[near], self.groups[near])


@dataclass(frozen=True, eq=False)
class Upward:
    """The direction near a given one on which lines or points agree; falsy, with the reason, if there is none."""

    up: FloatArray  # (3,) unit vector
    count: int = 0  # number of segments that agree on it
    uncertainty_deg: float = float("nan")  # standard deviation of the direction
    reason: str = ""  # why there is none; else ""

    def __bool__(self) -> bool:
        return not self.reason


def find_segments(
    pictures: Mapping[str, Picture], rotations: Mapping[str, FloatArray], up: FloatArray | None = None
) -> Segments:
    """Return the nearly vertical line segments in at most 24 evenly chosen panoramas.

    Args:
        pictures: image name to a function that loads it; one is in memory at a time.
        rotations: image name to cam_from_world (3, 3).
        up: (3,) approximate up direction in the world; None: unknown, so that segments of all directions are returned.
    """
    names = [name for name in rotations if name in pictures]
    chosen = np.unique(np.linspace(0, max(0, len(names) - 1), min(len(names), 24)).astype(int))
    found: list[tuple[FloatArray, FloatArray]] = []
    for idx in chosen:
        rotation = rotations[names[idx]]
        image, valid = pictures[names[idx]]()
        level_from_cam = np.eye(3) if up is None else rotation_from_two_vectors(rotation @ up, UP)
        sides = CUBE_ROTATIONS if up is None else CUBE_ROTATIONS[:SIDES]
        for normals_in_cam, lengths in _in_panorama(image, valid, [side @ level_from_cam for side in sides]):
            found.append((normals_in_cam @ rotation, lengths))
    normals = np.concatenate([np.zeros((0, 3)), *(each for each, _ in found)])
    groups = np.repeat(np.arange(len(found)), [len(each) for each, _ in found])
    segments = Segments(normals, np.concatenate([np.zeros(0), *(lengths for _, lengths in found)]), groups)
    return segments if up is None else segments.nearly_vertical(up, groups=len(found))


def up_from_lines(segments: Segments, up: FloatArray) -> Upward:
    """Return the direction within 20° of `up` that most segments point to.

    Args:
        segments: see `find_segments`.
        up: (3,) unit vector around which to search.
    """
    if len(segments.weights) < _MIN_SEGMENTS:
        return Upward(up, reason=_few(len(segments.weights)))

    def support(candidates: FloatArray, tolerance_deg: float) -> FloatArray:
        return _support(segments, candidates, tolerance_deg)

    best = most_supported(support, up, _ROUNDS)
    contrast = contrast_of(support, best, _ROUNDS[-1][2])
    # Minimum ratio of the weight of agreeing segments to the median over all directions within 8°.
    if contrast < 1.5:
        return Upward(up, reason=f"the pictures have no clear vertical lines ({contrast:.1f})")
    return _refined(segments, best)


def most_supported(support: Support, up: FloatArray, rounds: Sequence[tuple[float, float, float]]) -> FloatArray:
    """Return the direction with most support, from coarse to fine.

    Args:
        support: returns the support of directions (K, 3), given a tolerance.
        up: (3,) unit vector around which to search.
        rounds: half width and step in degrees, and tolerance.
    """
    for half_deg, step_deg, tolerance in rounds:
        candidates = directions_around(up, half_deg, step_deg)
        up = candidates[int(np.argmax(support(candidates, tolerance)))]
    return up


def contrast_of(support: Support, up: FloatArray, tolerance: float) -> float:
    """Return the support of a direction relative to the median over all directions within 8°."""
    usual = float(np.median(support(directions_around(up, 8.0, 1.0), tolerance)))
    return float(support(up[None], tolerance)[0] / max(usual, 1e-12))


def orthogonal_directions(segments: Segments) -> FloatArray | None:
    """Return three orthogonal directions (3, 3), one a row, to which most segments point; None if none is clear.

    Walls, floors and furniture are mostly at right angles, so the vertical is one of the three (J. Coughlan and A.
    Yuille, "Manhattan World", ICCV 1999).

    Args:
        segments: of all directions; see `find_segments`.
    """
    if len(segments.weights) < _MIN_SEGMENTS:
        return None
    _, step_deg, tolerance_deg = _ROUNDS[0]
    around = spiral_rays(int(4 * 180**2 / np.pi / step_deg**2))
    first = up_from_lines(segments, around[int(np.argmax(_support(segments, around, tolerance_deg)))])
    if not first:
        return None
    angles = np.deg2rad(np.arange(0.0, 90.0))
    across = np.stack([np.cos(angles), 0 * angles, np.sin(angles)], axis=1)
    across = across @ rotation_from_two_vectors(UP, first.up).T
    along = np.cross(first.up, across)
    best = int(np.argmax(sum(_support(segments, each, tolerance_deg) for each in (across, along))))
    return np.array([first.up, across[best], along[best]])


def wall_azimuth(segments: Segments) -> float:
    """Return the azimuth of walls at right angles, from z towards x, in [0, π/2); NaN if none is clear.

    Args:
        segments: of all directions in a level world, whose y points down; see `find_segments`.
    """
    # A vertical edge also lies on a great circle through the level direction in which it is seen.
    level = np.abs(segments.normals @ UP) > np.sin(np.deg2rad(3.0))
    kept = Segments(segments.normals[level], segments.weights[level], segments.groups[level])
    if len(kept.weights) < _MIN_SEGMENTS:
        return float("nan")

    def support(azimuths_deg: FloatArray, tolerance_deg: float) -> FloatArray:
        angles = np.deg2rad(azimuths_deg + np.array([[0.0], [90.0]]))
        directions = np.stack([np.sin(angles), 0 * angles, np.cos(angles)], axis=-1)
        return sum((_support(kept, each, tolerance_deg) for each in directions), np.zeros(len(azimuths_deg)))

    coarse = np.arange(0.0, 90.0)
    found = support(coarse, _ROUNDS[0][2])
    if found.max() < _CLEAR_WALLS * np.median(found):
        return float("nan")
    fine = coarse[int(np.argmax(found))] + np.arange(-2.0, 2.01, 0.1)
    return float(np.deg2rad(fine[int(np.argmax(support(fine, _ROUNDS[1][2])))]) % (np.pi / 2))


def turn_into_walls(segments: Segments, wall_rad: float) -> tuple[FloatArray, float]:
    """Return a small rotation (3, 3) that turns the vertical and both directions of walls onto the lines of a picture.

    The weight of the lines that are on them is returned as well.

    Lines along walls say as much about the vertical as vertical ones, of which a single picture shows few: tilts of
    0.5° in 92 rendered panoramas were known to 0.05° in the median and to 0.1° in nine of ten.

    Args:
        segments: of all directions in a world that is level to 3°, whose y points down.
        wall_rad: azimuth of walls there, see `wall_azimuth`.
    """
    sine, cosine = np.sin(wall_rad), np.cos(wall_rad)
    axes = np.array([UP, [sine, 0.0, cosine], [cosine, 0.0, -sine]])
    rotation: FloatArray = np.eye(3)
    weight = np.zeros(0)
    for tolerance_deg in _WALL_ROUNDS_DEG:
        turned = axes @ rotation.T
        off = segments.normals @ turned.T
        nearest = np.abs(off).argmin(axis=1)
        residual = off[np.arange(len(nearest)), nearest]
        share = residual / np.sin(np.deg2rad(tolerance_deg))
        weight = segments.weights * np.where(np.abs(share) < 1, (1 - share**2) ** 2, 0.0)
        change = np.cross(turned[nearest], segments.normals)  # of the residual, when the axes turn
        matrix = (change * weight[:, None]).T @ change + _DAMPING * np.eye(3)
        step = np.linalg.solve(matrix, -(change * weight[:, None]).T @ residual)
        rotation = rotation_from_rotvec(step) @ rotation
    return rotation, float(weight.sum())


def directions_around(up: FloatArray, half_deg: float, step_deg: float) -> FloatArray:
    """Return unit vectors (K, 3) on a grid of tilts of at most `half_deg` around `up`."""
    tilts = np.deg2rad(np.arange(-half_deg, half_deg + step_deg / 2, step_deg))
    x, y = np.meshgrid(tilts, tilts, indexing="ij")
    rotvecs = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    rotvecs = rotvecs[np.hypot(rotvecs[:, 0], rotvecs[:, 1]) <= np.deg2rad(half_deg) + 1e-9]
    around_z: FloatArray = rotation_from_rotvec(rotvecs)[:, :, 2]
    return around_z @ rotation_from_two_vectors(np.array([0.0, 0.0, 1.0]), up).T


def _few(count: int) -> str:
    return f"{count} nearly vertical {plural(count, 'line is', 'lines are')} too few; {_MIN_SEGMENTS} are needed"


def _in_panorama(
    image: NDArray[np.uint8], valid: NDArray[np.bool_], sides: Sequence[FloatArray]
) -> list[tuple[FloatArray, FloatArray]]:
    """Return normals in the camera frame (M, 3) and lengths (M,) of the segments in each view, by its rotation."""
    small = reduced_panorama(image, 4 * 512)
    mask = cv2.resize(valid.astype(np.uint8), small.shape[1::-1], interpolation=cv2.INTER_NEAREST)
    # Bicubic interpolation takes two pixels on each side, and a pixel of a view covers more than one of the panorama.
    clear = cv2.erode(pad_panorama(mask, 3), np.ones((7, 7), np.uint8))[3:-3, 3:-3] > 0
    size = max(16, small.shape[1] // 4)
    focal = size / 2 / np.tan(np.deg2rad(45.0))
    views = []
    for side in sides:
        view = PinholeView(side, float(focal), np.array([size / 2, size / 2]), (size, size))
        views.append(_in_view(face_image(small, view), clear, view))
    return views


def _in_view(image: NDArray[np.uint8], clear: NDArray[np.bool_], view: PinholeView) -> tuple[FloatArray, FloatArray]:
    # OpenCV's pixels have their centres at whole numbers, ours at halves.
    found = cv2.createLineSegmentDetector().detect(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))[0]
    ends = np.zeros((0, 2, 2)) if found is None else found.reshape(-1, 2, 2).astype(np.float64) + 0.5
    # Segments shorter than this share of a face do not point anywhere exactly.
    ends = ends[np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) >= 0.06 * view.size_hw[0]]
    if len(ends) and not clear.all():
        along = ends[:, :1] + np.linspace(0, 1, 9)[None, :, None] * (ends[:, 1:] - ends[:, :1])
        size_hw = (clear.shape[0], clear.shape[1])
        ends = ends[clear[pixels_containing(view.bearings_from_pixels(along), size_hw)].all(axis=1)]
    rays = view.bearings_from_pixels(ends)
    normals = np.cross(rays[:, 0], rays[:, 1])
    sines = np.linalg.norm(normals, axis=1, keepdims=True)
    return normals / sines, np.arcsin(np.clip(sines[:, 0], 0, 1))


def _support(segments: Segments, candidates: FloatArray, tolerance_deg: float) -> FloatArray:
    """Return the total weight (K,) of the segments that point to each candidate, falling to 0 at the tolerance."""
    tolerance = np.sin(np.deg2rad(tolerance_deg))
    support = np.empty(len(candidates))
    for start in range(0, len(candidates), 128):
        off = (segments.normals @ candidates[start : start + 128].T / tolerance) ** 2
        support[start : start + 128] = segments.weights @ np.maximum(0.0, 1 - off)
    return support


def _refined(segments: Segments, up: FloatArray) -> Upward:
    """Return the least-squares direction of the agreeing segments, with its standard deviation by the jackknife."""
    tolerance = np.sin(np.deg2rad(_ROUNDS[-1][2]))
    groups = int(segments.groups.max()) + 1
    near = np.zeros(len(segments.weights), np.bool_)
    moments = np.zeros((groups, 3, 3))
    for _ in range(3):
        off = segments.normals @ up / tolerance
        near = np.abs(off) < 1
        weights = segments.weights * np.where(near, (1 - off**2) ** 2, 0.0)
        outer = weights[:, None, None] * segments.normals[:, :, None] * segments.normals[:, None, :]
        moments = np.zeros((groups, 3, 3))
        np.add.at(moments, segments.groups, outer)
        up = _weakest(moments.sum(axis=0), up)
    count = int(near.sum())
    if count < _MIN_SEGMENTS:
        return Upward(up, count, reason=_few(count))
    spread = np.linalg.eigvalsh(moments.sum(axis=0))
    # The rest of the weight must not be in one plane: edges at one azimuth leave the tilt towards them unknown.
    if spread[1] < 0.05 * spread[2]:
        return Upward(up, count, reason="all vertical lines are in one direction")
    used = [number for number in range(groups) if moments[number].any()]
    without = np.array([_weakest(moments.sum(axis=0) - moments[number], up) for number in used])
    deviations = without - without.mean(axis=0)
    variance = (len(used) - 1) / len(used) * float((deviations**2).sum())
    # 0.1° for what all views have in common. Rendered rooms: errors of 0.03° to 0.13°, whatever the number of lines.
    return Upward(up, count, float(np.hypot(0.1, np.rad2deg(np.sqrt(variance)))))


def _weakest(moment: FloatArray, up: FloatArray) -> FloatArray:
    """Return the eigenvector of the smallest eigenvalue, on the side of `up`."""
    direction = np.linalg.eigh(moment)[1][:, 0]
    return direction if direction @ up > 0 else -direction
