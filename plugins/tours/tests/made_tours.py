"""Tours of places whose plan is known, with the links that somebody would put into them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import Rigid3, rotation_from_rotvec
from pano_mvs.scene import SceneLink

# Positions x and z in camera heights, and the scenes between which there are links.
POSITIONS = np.array([[0.0, 0.0], [2.5, 0.3], [0.2, 3.0], [2.7, 3.2], [-2.4, 0.1], [5.0, 3.0]])
LINKS = ((0, 1), (0, 2), (0, 4), (1, 3), (2, 3), (3, 5))


@dataclass(frozen=True, eq=False)
class MadeTour:
    """A tour with true positions (N, 2) in camera heights, and turns (N,) from the frames of the scenes."""

    positions: FloatArray
    turns_rad: FloatArray
    links: dict[str, list[SceneLink]]

    def level_camera(self, number: int, unit: float = 1.0) -> Rigid3:
        """Return the true cam_from_house of a scene, in a unit of so many camera heights."""
        x, z = self.positions[number] / unit
        return Rigid3.from_center(
            rotation_from_rotvec((0.0, -float(self.turns_rad[number]), 0.0)), np.array([x, 0.0, z])
        )


def made_tour(
    *, seed: int = 0, noise_deg: float = 0.0, one_way: tuple[int, ...] = (), on_floor: bool = True
) -> MadeTour:
    """Return a tour with links whose directions have an error.

    Args:
        seed: of turns and errors.
        noise_deg: standard deviation of the directions of links.
        one_way: numbers of links without one in the other direction.
        on_floor: whether links stand on the floor below the other camera, else on the horizon.
    """
    rng = np.random.default_rng(seed)
    turns = rng.uniform(-np.pi, np.pi, len(POSITIONS))
    links: dict[str, list[SceneLink]] = {str(number): [] for number in range(len(POSITIONS))}
    for idx, pair in enumerate(LINKS):
        for here, there in (pair, pair[::-1])[: 1 if idx in one_way else 2]:
            x, z = POSITIONS[there] - POSITIONS[here]
            yaw = np.rad2deg(np.arctan2(x, z) - turns[here]) + noise_deg * rng.normal()
            pitch = -np.rad2deg(np.arctan2(1.0, np.hypot(x, z))) if on_floor else 0.0
            links[str(here)].append(SceneLink(str(there), (float((yaw + 180) % 360 - 180), float(pitch))))
    return MadeTour(POSITIONS, turns, links)
