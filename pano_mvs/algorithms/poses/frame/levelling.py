"""Rotate the world so that y points down, along gravity, and z north if compass headings agree."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Annotated

import numpy as np

from pano_mvs.algorithms.poses.frame.gauge import moved_poses
from pano_mvs.algorithms.poses.frame.georeference import origin_of_frame
from pano_mvs.algorithms.poses.frame.vertical import Evidence, Vertical, find_vertical
from pano_mvs.algorithms.poses.frame.vertical_lines import Picture
from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.settings import Setting, checks_settings
from pano_mvs.core.text import plural
from pano_mvs.geometry import UP, Similarity3, rotation_from_rotvec, rotation_from_two_vectors
from pano_mvs.scene import Poses


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
            "structure (level surfaces among the sparse points), or cameras (their up directions); auto uses the first "
            "available one"
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
    if origin_of_frame(poses.frame) is not None:
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
    towards, heading = _northward(level, heading_deg or {})
    # Adding 0 turns −0 into 0: the first camera is exactly at the origin.
    level = moved_poses(level, Similarity3(1.0, towards, np.zeros(3)))
    level.translations[0] = 0.0
    known = f"{vertical.evidence}, uncertain by {vertical.uncertainty_deg:.1f}°"
    frame = f"origin at the first registered camera; y down along gravity, by {known}; {heading}"
    return replace(level, frame=frame), vertical


def _northward(level: Poses, heading_deg: Mapping[str, float]) -> tuple[FloatArray, str]:
    """Return the rotation about the vertical that makes z point north, and its description."""
    headings = [(idx, heading_deg[name]) for idx, name in enumerate(level.names) if name in heading_deg]
    unturned = "z close to where it pointed before levelling"
    # Software that knows no heading writes zero for all images.
    if len(headings) < 2 or not any(heading for _, heading in headings):
        return np.eye(3), unturned
    forward = np.array([level.rotations[idx][2] for idx, _ in headings])
    measured_rad = np.deg2rad([heading for _, heading in headings])
    turns = np.exp(1j * (measured_rad - np.arctan2(forward[:, 0], forward[:, 2])))
    medoid = turns[int(np.argmin(np.abs(np.angle(turns[:, None] / turns[None, :])).sum(axis=1)))]
    turn_rad = float(np.angle(medoid)) + float(np.median(np.angle(turns / medoid)))
    off_deg = float(np.median(np.abs(np.rad2deg(np.angle(turns * np.exp(-1j * turn_rad))))))
    if off_deg > 15.0:
        return np.eye(3), f"{unturned} (the compass headings disagree by {off_deg:.0f}°)"
    return rotation_from_rotvec([0.0, turn_rad, 0.0]), (
        f"z north, by {len(headings)} compass {plural(len(headings), 'heading')} (median disagreement {off_deg:.1f}°)"
    )
