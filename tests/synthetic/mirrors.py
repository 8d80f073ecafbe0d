"""A furnished room with a mirror on one of its walls."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pano_mvs.geometry import Rigid3, ray_grid
from pano_mvs.testing.room import Room, default_room, render
from pano_mvs.testing.surfaces import Cuboid, Quad
from tests.synthetic.paints import OAK, STEEL
from tests.synthetic.scenes import Scene, painted, placed

WALL_Z = 2.48
"""The mirror is in the plane z = WALL_Z, 2 cm before its wall."""
LOW_XY, HIGH_XY = (-1.2, -0.9), (0.4, 0.5)
"""Its corners."""
_REFLECTANCE = 0.85


@dataclass(frozen=True)
class MirrorScene(Scene):
    """A scene whose room has a mirror; the true range of the mirror is that of its pane."""

    def view(
        self, idx: int, size_hw: tuple[int, int], *, supersample: int = 2
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Return the image and the true ranges, as of any scene."""
        image, ranges = render(self.room, self.poses[idx], size_hw, supersample=supersample)
        turn, center = self.poses[idx].rotation, self.poses[idx].center
        # What the pane shows is what a camera sees from behind it, left and right exchanged.
        behind = Rigid3.from_center(
            turn * np.outer((-1, 1, 1), (1, 1, -1)), np.array([center[0], center[1], 2 * WALL_Z - center[2]])
        )
        reflected = render(_seen_from_behind(self.room), behind, size_hw, supersample=supersample)[0][:, ::-1]
        shown = shows_mirror(self, idx, ranges)
        image = np.where(shown[..., None], _REFLECTANCE * reflected, image)
        levels = image * np.array(self.gains[idx]) + self.offsets[idx]
        levels += np.random.default_rng([self.room.seed, idx]).normal(0, self.noise, image.shape)
        return np.clip(np.rint(levels), 0, 255).astype(np.uint8), ranges


def mirror_room(*, seed: int = 0, views: int = 4, turned: bool = True, exposure: float = 0.0) -> Scene:
    """Return the furnished room of `pano_mvs.testing.room` with a framed mirror of 1.6 × 1.4."""
    (left, top), (right, bottom) = LOW_XY, HIGH_XY
    frame = [
        Cuboid((a, b, WALL_Z - 0.02), (c, d, 2.5), OAK)
        for a, b, c, d in (
            (left - 0.08, top - 0.08, right + 0.08, top),
            (left - 0.08, bottom, right + 0.08, bottom + 0.08),
            (left - 0.08, top, left, bottom),
            (right, top, right + 0.08, bottom),
        )
    ]
    pane = Quad((left, top, WALL_Z), (right - left, 0, 0), (0, bottom - top, 0), STEEL)
    surfaces = [*default_room().surfaces, *frame, pane]
    room = painted("mirror", [(surface, "strong") for surface in surfaces], seed=seed, lamp=(0.4, -1.2, 0.3))
    scene = placed("mirror_room", room, views=views, turned=turned, spread=(0.6, 0.3, 0.6), exposure=exposure)
    return MirrorScene(**vars(scene))


def shows_mirror(scene: Scene, idx: int, ranges: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return which pixels (H, W) of a view with true ranges (H, W) show the mirror."""
    pose = scene.poses[idx]
    points = pose.center + ray_grid(ranges.shape) @ pose.rotation * ranges[..., None]
    within = (points[..., :2] > LOW_XY).all(axis=-1) & (points[..., :2] < HIGH_XY).all(axis=-1)
    return np.asarray(within & (np.abs(points[..., 2] - WALL_Z) < 1e-3))


def _seen_from_behind(room: Room) -> Room:
    """Return the room without what is on the wall of the mirror, and with that wall far away."""
    kept = len(default_room().surfaces)
    shell = room.surfaces[0]
    assert isinstance(shell, Cuboid)
    far = replace(shell, high=(shell.high[0], shell.high[1], 20.0))
    return replace(room, surfaces=(far, *room.surfaces[1:kept]), textures=room.textures[:kept])
