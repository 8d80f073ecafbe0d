"""The parts of a house, each a group of cameras or a single panorama, and the links between their panoramas."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import Rigid3
from pano_mvs.scene import SceneLink

_MIN_DOWN_DEG = 4.0
"""A link less than this far below the horizon says nothing about the distance."""


@dataclass(frozen=True, eq=False)
class Part:
    """A group of cameras with known relative poses, or a single panorama.

    Its frame is level, with y down, and has its origin amid the cameras.
    """

    cameras: Mapping[str, Rigid3]  # cam_from_part by image name
    height: float = np.nan  # of its cameras above the floor, in its own unit; NaN if not known
    # azimuth of one of its walls, in radians from 0 to π/2; NaN if it has no clear walls at right angles
    wall_rad: float = np.nan

    @property
    def is_single(self) -> bool:
        """Whether it is a single panorama, whose unit is the height of its camera."""
        return len(self.cameras) == 1


class PartLink(NamedTuple):
    """A link from a panorama to another one, in the level frames of their parts."""

    parts: tuple[int, int]
    centers: FloatArray  # (2, 2) positions of both cameras, x and z, in the units of their parts
    azimuth_rad: float  # from z towards x, in the frame of the first part
    length: float  # distance at which it meets the floor, in camera heights; NaN if it does not


def part_links(parts: Iterable[Part], links: Mapping[str, Iterable[SceneLink]]) -> list[PartLink]:
    """Return the links with known directions between the panoramas of some parts.

    Links of tours mostly stand on the floor, below the next camera or at the door that leads to it.

    Args:
        parts: without common images.
        links: image name to its links.
    """
    found = {name: (number, pose) for number, part in enumerate(parts) for name, pose in part.cameras.items()}
    result = []
    for name, (number, pose) in found.items():
        for link in links.get(name, ()):
            if link.direction_deg is None or link.name not in found:
                continue
            other, there = found[link.name]
            ray = pose.rotation.T @ _ray(*link.direction_deg)
            level = float(np.hypot(ray[0], ray[2]))
            down = float(np.rad2deg(np.arctan2(ray[1], level)))
            result.append(
                PartLink(
                    (number, other),
                    np.array([pose.center[[0, 2]], there.center[[0, 2]]]),
                    float(np.arctan2(ray[0], ray[2])),
                    level / float(ray[1]) if down > _MIN_DOWN_DEG else np.nan,
                )
            )
    return result


def _ray(yaw_deg: float, pitch_deg: float) -> FloatArray:
    """Return the unit ray of a direction to the right of the middle of a panorama and above the horizon."""
    yaw, pitch = np.deg2rad([yaw_deg, pitch_deg])
    return np.array([np.cos(pitch) * np.sin(yaw), -np.sin(pitch), np.cos(pitch) * np.cos(yaw)])
