"""Camera poses as a path, as a record, or as transforms by image name."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from pano_mvs.geometry import Rigid3
from pano_mvs.io.poses.files import read_groups, read_poses
from pano_mvs.scene import Poses
from pano_mvs.scene.pose_groups import split_groups

Cameras = Path | Poses | Mapping[str, Rigid3]
"""Poses in any form that `read_poses` reads, as a record, or as cam_from_world by image name."""


def camera_groups(source: Cameras) -> list[Mapping[str, Rigid3]]:
    """Return the cam_from_world by image name of each group of cameras, the largest group first.

    Raises:
        InputError: if a file cannot be read or holds no poses.
    """
    if isinstance(source, Poses):
        return [group.cameras for group in split_groups(source)]
    return [source] if isinstance(source, Mapping) else [group.cameras for group in read_groups(source)]


def read_cameras(source: Cameras) -> tuple[Mapping[str, Rigid3], bool]:
    """Return cam_from_world by image name, of the largest group alone, and whether lengths are known to be metres.

    Raises:
        InputError: if a file cannot be read or holds no poses.
    """
    if isinstance(source, Path):
        poses = read_poses(source)
        return poses.cameras, poses.metric
    return camera_groups(source)[0], isinstance(source, Poses) and source.metric


def length_unit(*, metric: bool) -> str:
    """Return the unit of lengths for display."""
    return "m" if metric else "units of the truth"
