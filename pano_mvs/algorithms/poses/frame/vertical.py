"""The vertical in the world frame of poses, from sensors, lines, level surfaces and cameras, and level poses."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Annotated, Literal

import numpy as np
import scipy
from numpy.typing import NDArray

from pano_mvs.algorithms.poses.frame.gauge import moved_poses
from pano_mvs.algorithms.poses.frame.upside_down import most_probable_up, upside_down_probability
from pano_mvs.algorithms.poses.frame.vertical_lines import (
    Picture,
    Segments,
    Upward,
    contrast_of,
    find_segments,
    most_supported,
    orthogonal_directions,
    up_from_lines,
)
from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.settings import Setting, checks_settings
from pano_mvs.core.text import plural
from pano_mvs.geometry import UP, Similarity3, angle_between, rotation_from_rotvec, rotation_from_two_vectors
from pano_mvs.scene import Poses, WorldAxes

Evidence = Literal["auto", "sensors", "lines", "structure", "cameras"]

SURE = 0.8
"""Probability from which a capture is taken to be upside down. Of upright ones that were measured, none reaches .01."""


@dataclass(frozen=True, eq=False)
class Vertical:
    """The direction away from gravity; falsy, with the reason, if it is unknown."""

    up_in_world: FloatArray  # (3,) unit vector
    source: str = ""  # "sensors", "lines", "structure" or "cameras"; of several, the most precise one
    evidence: str = ""  # description of the source, with its amount and agreement
    # median angle between single readings and `up_in_world`; NaN if there is only one
    disagreement_deg: float = float("nan")
    reason: str = ""  # why the direction is unknown; "" if it is known
    uncertainty_deg: float = float("nan")  # standard deviation of `up_in_world`; NaN if unknown
    # probability that the cameras were held upside down; NaN if it was not asked for. From `SURE` on, `up_in_world` is
    # opposite to their up direction.
    upside_down: float = float("nan")
    weights: Mapping[str, float] = field(default_factory=dict)  # of each source of `up_in_world`; their sum is 1
    unused: str = ""  # why pitch and roll in the metadata were not used; "" if they were, or if there are none

    def __bool__(self) -> bool:
        return not self.reason


def find_vertical(
    poses: Poses,
    up_in_cam: Mapping[str, Sequence[float]] | None = None,
    pictures: Mapping[str, Picture] | None = None,
    *,
    evidence: Evidence = "auto",
) -> Vertical:
    """Return the direction away from gravity in the world frame of poses.

    Args:
        poses: registered images, and their sparse points for `structure`.
        up_in_cam: image name to the up direction (3,) measured by its camera's sensors, in the camera frame.
        pictures: image name to a function that loads its panorama, for `lines`.
        evidence: "sensors" of the cameras; vertical "lines" in the pictures, or the "structure" of floors, ceilings and
            tables, within 20° of the cameras' mean up direction; the up directions of the "cameras" alone; or "auto":
            the mean of the most precise of these and of those that agree with it. With "auto", sensors decide which way
            is up, unless lines and cameras agree against them; without them, the vertical is turned around if the
            capture is upside down (see `pano_mvs.algorithms.poses.frame.upside_down`).
    """
    if evidence == "auto":
        return _from_all(poses, up_in_cam or {}, pictures or {})
    cameras = vertical_from_cameras(poses)
    finders: dict[Evidence, Callable[[], Vertical]] = {
        "sensors": lambda: vertical_from_sensors(poses, up_in_cam or {}),
        "lines": lambda: _from_lines(poses, pictures or {}, cameras),
        "structure": lambda: _from_structure(poses, cameras),
        "cameras": lambda: cameras,
    }
    found = finders[evidence]()
    return _mean_of_agreeing([found]) if found else found


def _from_all(poses: Poses, up_in_cam: Mapping[str, Sequence[float]], pictures: Mapping[str, Picture]) -> Vertical:
    """Return the mean of the most precise source and of those that agree with it, with the right sign."""
    sensors, cameras = vertical_from_sensors(poses, up_in_cam), vertical_from_cameras(poses)
    prior = sensors or cameras
    lines = _from_lines(poses, pictures, prior)
    # Programs that level pictures may leave the pitch and roll of the camera in the metadata. Then the cameras of the
    # pictures are upright, and their lines say so.
    if sensors and cameras and not lines:
        upright = _from_lines(poses, pictures, cameras)
        if upright and _agrees(upright, cameras):
            lines, prior = upright, cameras
    found = [sensors, lines, _from_structure(poses, prior), cameras]
    known = [each for each in found if each and (not prior or each.up_in_world @ prior.up_in_world > 0)]
    stated = any(name in up_in_cam for name in poses.names)
    if not known:
        reason = "; ".join(dict.fromkeys(each.reason for each in found))
        return replace(_unknown(reason), unused=sensors.reason if stated else "")
    vertical = _mean_of_agreeing(known)
    if stated and "sensors" not in vertical.weights:
        off_deg = float(np.rad2deg(angle_between(sensors.up_in_world, vertical.up_in_world)))
        against = (
            f"they are {off_deg:.1f}° off {vertical.evidence}. A program that levels pictures may have left them. If "
            "they are right, set `evidence: sensors` for poses.level"
        )
        vertical = replace(vertical, unused=against if sensors else sensors.reason)
    if prior is sensors:
        return vertical
    probability = upside_down_probability(poses, pictures, vertical.up_in_world)
    up = -vertical.up_in_world if probability >= SURE else vertical.up_in_world
    return replace(vertical, up_in_world=up, upside_down=probability)


def _mean_of_agreeing(known: Sequence[Vertical]) -> Vertical:
    """Return the mean, by precision, of the most precise vertical and of those that agree with it."""
    lead = min(known, key=lambda each: each.uncertainty_deg)
    ups = np.array([each.up_in_world for each in known])
    weights = np.array([_agrees(each, lead) / each.uncertainty_deg**2 for each in known])
    up = weights @ ups / np.linalg.norm(weights @ ups)
    shares = zip([each.source for each in known], (weights / weights.sum()).tolist(), strict=True)
    named = {source: share for source, share in shares if share}
    return replace(lead, up_in_world=up, weights=named, uncertainty_deg=float(weights.sum() ** -0.5))


def _agrees(first: Vertical, second: Vertical) -> bool:
    """Return whether two verticals may be the same; one in twenty pairs that measure the same is refused."""
    off_deg = float(np.rad2deg(angle_between(first.up_in_world, second.up_in_world)))
    # A chi-square test with two degrees of freedom, whose joint standard deviation `uncertainty_deg` is.
    return off_deg**2 <= -float(np.log(0.05)) * (first.uncertainty_deg**2 + second.uncertainty_deg**2)


def vertical_from_sensors(poses: Poses, up_in_cam: Mapping[str, Sequence[float]]) -> Vertical:
    """Return the robust mean of the up directions measured by the cameras' sensors, in the world frame."""
    measured = [(idx, up_in_cam[name]) for idx, name in enumerate(poses.names) if name in up_in_cam]
    if not measured:
        return _unknown("no registered panorama has pitch and roll in its metadata")
    readings = np.array([poses.rotations[idx].T @ np.asarray(up, np.float64) for idx, up in measured])
    up, deviations_deg, kept = robust_mean_direction(readings)
    disagreement_deg = float(np.median(deviations_deg))
    # Sensors of one rigid capture that differ by more than this did not measure gravity.
    if disagreement_deg > 5.0:
        return _unknown(f"the sensors of {len(measured)} panoramas disagree by {disagreement_deg:.1f}° in the median")
    agreement = f", median disagreement {disagreement_deg:.2f}°" if len(measured) > 1 else ", nothing to compare with"
    states = plural(int(kept.sum()), "states", "state")
    evidence = f"the pitch and roll that {kept.sum()} of {len(poses.names)} panoramas {states}{agreement}"
    if len(measured) == 1:
        return Vertical(up, "sensors", evidence, uncertainty_deg=1.0)
    uncertainty_deg = _mean_uncertainty_deg(disagreement_deg, int(kept.sum()), 0.5)
    return Vertical(up, "sensors", evidence, disagreement_deg, uncertainty_deg=uncertainty_deg)


def vertical_from_cameras(poses: Poses) -> Vertical:
    """Return the robust mean of the cameras' up directions: panoramas are taken with the camera nearly upright."""
    if not poses.names:
        return _unknown("there is no camera")
    up, deviations_deg, _ = robust_mean_direction(poses.rotations.transpose(0, 2, 1) @ UP)
    # A single camera is usually held this far from upright.
    disagreement_deg = float(np.median(deviations_deg)) if len(poses.names) > 1 else 2.0
    # Cameras whose up directions differ by more than this were not held upright.
    if disagreement_deg > 20.0:
        return _unknown(
            f"the up directions of the cameras differ by {disagreement_deg:.0f}°, so they were not held upright"
        )
    evidence = f"the common up direction of {len(poses.names)} cameras, median disagreement {disagreement_deg:.2f}°"
    if len(poses.names) == 1:
        evidence = "the up direction of a single camera"
    uncertainty_deg = _mean_uncertainty_deg(disagreement_deg, len(poses.names), 1.0)
    return Vertical(up, "cameras", evidence, disagreement_deg, uncertainty_deg=uncertainty_deg)


def _from_lines(poses: Poses, pictures: Mapping[str, Picture], prior: Vertical) -> Vertical:
    """Return the direction near a prior one to which most line segments in the pictures point.

    Cameras that were turned in all directions have no common up direction; then brightness, texture and the floor show
    which of three axes of the lines is vertical.
    """
    rotations = dict(zip(poses.names, poses.rotations, strict=True))
    if not prior:
        return _of_turned_cameras(poses, pictures, find_segments(pictures, rotations)) if pictures else prior
    lines = up_from_lines(find_segments(pictures, rotations, prior.up_in_world), prior.up_in_world)
    return _near(lines, prior, "lines", evidence=f"{lines.count} vertical lines in the pictures")


def _of_turned_cameras(poses: Poses, pictures: Mapping[str, Picture], segments: Segments) -> Vertical:
    """Return the vertical by segments of all directions."""
    axes = orthogonal_directions(segments)
    if axes is None:
        return _unknown("the cameras were turned in all directions, and lines in the pictures have no clear directions")
    up, chance = most_probable_up(poses, pictures, axes)
    lines = up_from_lines(segments, up)
    # An unlevelled world is level by chance only, so what is more likely than not is enough.
    if not lines or chance < 0.5:
        return _unknown(
            "the cameras were turned in all directions, and brightness, texture and points do not show which way is up "
            f"(probability {chance:.2f})"
        )
    evidence = (
        f"{lines.count} lines in the pictures of cameras that were turned in all directions (right with probability "
        f"{chance:.2f}, by brightness, texture and points)"
    )
    return Vertical(lines.up, "lines", evidence, uncertainty_deg=lines.uncertainty_deg)


def _from_structure(poses: Poses, prior: Vertical) -> Vertical:
    """Return the direction near a prior one along which sparse points lie in the sharpest layers."""
    if not prior:
        return prior
    layers = sharpest_up(poses.points_in_world, poses.centers, prior.up_in_world)
    evidence = f"the level surfaces among {len(poses.points_in_world)} sparse points"
    return _near(layers, prior, "structure", evidence=evidence)


def _near(found: Upward, prior: Vertical, source: str, *, evidence: str) -> Vertical:
    """Return a direction as the vertical, unless it is too far from the prior one."""
    if not found:
        return _unknown(found.reason)
    moved_deg = float(np.rad2deg(angle_between(found.up, prior.up_in_world)))
    # Lines or surfaces farther than this (plus three deviations) from it are a slope or a ramp.
    if moved_deg > 2.0 + 3 * 1.4826 * np.nan_to_num(prior.disagreement_deg):
        return _unknown(f"{evidence} are tilted by {moved_deg:.1f}° against the {prior.source}")
    return Vertical(found.up, source, evidence, prior.disagreement_deg, uncertainty_deg=found.uncertainty_deg)


def robust_mean_direction(directions: FloatArray) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """Return the mean of unit vectors (N, 3), N ≥ 1, without outliers.

    It starts at the vector with the smallest sum of angles to all others, and twice rejects vectors farther from the
    mean than three standard deviations, estimated from the median of the angles.

    Returns:
        The mean (3,), the angle of every vector to it in degrees (N,), and which vectors are inliers (N,).
    """
    # One after another: a table of the angles of 5,000 cameras would take 1.8 GB.
    mean = min(directions, key=lambda each: np.rad2deg(angle_between(each, directions)).sum())
    for _ in range(2):
        deviations_deg = np.rad2deg(angle_between(directions, mean))
        # Agreement better than this rejects nothing: readings are tenths of degrees at best.
        kept = deviations_deg <= max(1.0, 3 * 1.4826 * float(np.median(deviations_deg)))
        mean = directions[kept].mean(axis=0)
        mean = mean / np.linalg.norm(mean)
    return mean, np.rad2deg(angle_between(directions, mean)), kept


def _mean_uncertainty_deg(disagreement_deg: float, count: int, bias_deg: float) -> float:
    """Return the standard deviation of a mean, with an error that all sensors, or all cameras, have in common."""
    # 0.85 √2: of the median of the angles between directions and their mean, in standard deviations of a direction.
    return float(np.hypot(bias_deg, 0.85 * np.sqrt(2.0) * disagreement_deg / np.sqrt(count)))


def _unknown(reason: str) -> Vertical:
    return Vertical(UP, reason=reason)


# Search around a given up direction: half width and step in degrees, layer thickness relative to the typical range.
_ROUNDS = ((20.0, 2.0, 0.04), (2.0, 0.5, 0.02), (0.5, 0.1, 0.01))


def sharpest_up(points: FloatArray, centers: FloatArray, up: FloatArray) -> Upward:
    """Return the direction within 20° of `up` along which the points' heights are most concentrated.

    Concentration is the integral of the squared density of heights (the exponential of the negative Rényi entropy of
    order 2). It is large for level surfaces and decreases with any tilt.

    Args:
        points: (P, 3) in the world.
        centers: (N, 3) camera centres in the world.
        up: (3,) unit vector around which to search.
    """
    if len(points) < 100:
        return Upward(up, reason=f"{len(points)} sparse points are too few for level surfaces; 100 are needed")
    offsets = points - np.median(centers, axis=0)
    ranges = np.linalg.norm(offsets, axis=1)
    typical = float(np.median(ranges))
    near = offsets[ranges < 3 * typical] / typical
    best = most_supported(partial(_concentrations, near), up, _ROUNDS)
    contrast = contrast_of(partial(_concentrations, near), best, _ROUNDS[-1][2])
    # Minimum ratio of the sharpness of the layers to the median over all directions within 8°. Sparse points of rooms,
    # 200 to 4,000 of them, give 1.3 to 2.0; points without level surfaces 1.0 to 1.2.
    if contrast < 1.3:
        return Upward(up, reason=f"the sparse points show no clear level surfaces (contrast {contrast:.2f})")
    # The deviation of four parts of the points. That of their mean would be half of it, but they have furniture and
    # slopes in common: in rendered houses with true points, errors are twice as large.
    parts = [most_supported(partial(_concentrations, near[part::4]), best, _ROUNDS[1:]) for part in range(4)]
    offs = [float(np.rad2deg(angle_between(found, best))) for found in parts]
    return Upward(best, uncertainty_deg=float(np.hypot(np.sqrt(np.mean(np.square(offs))), _ROUNDS[-1][1])))


def _concentrations(points: FloatArray, candidates: FloatArray, width: float) -> FloatArray:
    return np.array([_concentration(points @ candidate, width) for candidate in candidates])


def _concentration(heights: FloatArray, width: float) -> float:
    """Return the integral of the squared density of heights, smoothed to a given width."""
    step = width / 2
    positions = (heights - heights.min()) / step
    lower = positions.astype(np.int64)
    fractions = positions - lower
    size = int(lower.max()) + 2
    counts = np.bincount(lower, 1 - fractions, size) + np.bincount(lower + 1, fractions, size)
    smooth = scipy.ndimage.gaussian_filter1d(counts, 2.0, mode="constant")
    return float(np.sum(smooth**2)) / (step * len(heights) ** 2)


@checks_settings
def level_poses(
    poses: Poses,
    up_in_cam: Mapping[str, Sequence[float]] | None = None,
    heading_deg: Mapping[str, float] | None = None,
    *,
    pictures: Mapping[str, Picture] | None = None,
    evidence: Annotated[
        Evidence,
        Setting(
            "source of the vertical: sensors (pitch and roll in the metadata), lines (vertical edges in the pictures), "
            "structure (level surfaces among the sparse points), or cameras (their up directions); auto averages the "
            "most precise one and those that agree with it"
        ),
    ] = "auto",
    max_uncertainty_deg: Annotated[
        float, Setting("do not level if the standard deviation of the vertical is larger", gt=0, le=90)
    ] = 5.0,
) -> tuple[Poses, Vertical]:
    """Return the same scene in a level world: origin at the first camera, y down along gravity, unit unchanged.

    The z axis points north if at least two compass headings agree; otherwise the world is rotated only as far as
    levelling requires, so that z stays close to its direction.

    Args:
        poses: registered images.
        up_in_cam: image name to the up direction (3,) measured by its camera's sensors, in the camera frame.
        heading_deg: image name to the compass heading of its centre, clockwise from north.
        pictures: image name to a function that loads its panorama, for vertical lines.
        evidence: as in `find_vertical`.

    Returns:
        The poses, and the evidence that they were levelled by. If the vertical cannot be determined, or GPS has turned
        the world to east, down and north, the unchanged poses and a falsy record with the reason.
    """
    if poses.origin_lla is not None:
        return poses, Vertical(UP, reason="GPS has already turned it: x east, y down, z north")
    vertical = find_vertical(poses, up_in_cam, pictures, evidence=evidence)
    if vertical and vertical.uncertainty_deg > max_uncertainty_deg:
        reason = (
            f"by {vertical.evidence}, the vertical is uncertain by {vertical.uncertainty_deg:.1f}°, more "
            f"than max_uncertainty_deg = {max_uncertainty_deg:g}°"
        )
        vertical = replace(vertical, reason=reason)
    if not vertical:
        return poses, vertical
    levelling = rotation_from_two_vectors(vertical.up_in_world, UP)
    level = moved_poses(poses, Similarity3(1.0, levelling, -levelling @ poses.centers[0]))
    axes, towards, heading = _northward(level, heading_deg or {})
    # Adding 0 turns −0 into 0: the first camera is exactly at the origin.
    level = moved_poses(level, Similarity3(1.0, towards, np.zeros(3)))
    level.translations[0] = 0.0
    known = f"{vertical.evidence}, uncertain by {vertical.uncertainty_deg:.1f}°"
    frame = f"origin at the first registered camera; y down along gravity, by {known}; {heading}"
    return replace(level, frame=frame, axes=axes), vertical


def _northward(level: Poses, heading_deg: Mapping[str, float]) -> tuple[WorldAxes, FloatArray, str]:
    """Return the axes, the rotation about the vertical that makes z point north if it is known, and its description."""
    headings = [(idx, heading_deg[name]) for idx, name in enumerate(level.names) if name in heading_deg]
    unturned = "z close to where it pointed before levelling"
    # Software that knows no heading writes zero for all images.
    if len(headings) < 2 or not any(heading for _, heading in headings):
        return WorldAxes.LEVEL, np.eye(3), unturned
    forward = np.array([level.rotations[idx][2] for idx, _ in headings])
    measured_rad = np.deg2rad([heading for _, heading in headings])
    turns = np.exp(1j * (measured_rad - np.arctan2(forward[:, 0], forward[:, 2])))
    medoid = turns[int(np.argmin(np.abs(np.angle(turns[:, None] / turns[None, :])).sum(axis=1)))]
    turn_rad = float(np.angle(medoid)) + float(np.median(np.angle(turns / medoid)))
    off_deg = float(np.median(np.abs(np.rad2deg(np.angle(turns * np.exp(-1j * turn_rad))))))
    if off_deg > 15.0:
        return WorldAxes.LEVEL, np.eye(3), f"{unturned} (the compass headings disagree by {off_deg:.0f}°)"
    heading = (
        f"z north, by {len(headings)} compass {plural(len(headings), 'heading')} (median disagreement {off_deg:.1f}°)"
    )
    return WorldAxes.NORTH, rotation_from_rotvec([0.0, turn_rad, 0.0]), heading
