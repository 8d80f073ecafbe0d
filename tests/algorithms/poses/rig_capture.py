"""Synthetic observations of a room by rigs of two lenses, with exact ground truth."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pano_mvs.geometry import LensRig, Rigid3, Similarity3, rotation_from_rotvec, similarity_from_points
from pano_mvs.scene import Poses
from pano_mvs.testing.room import capture_poses, default_room, range_along
from tests.synthetic.fisheye_rig import example_rig


@dataclass(frozen=True, eq=False)
class RigCapture:
    """Observations in stitched panoramas.

    Attributes:
        rig: the rig.
        true: true cam_from_world of the rig, in metres.
        points: (P, 3) true points.
        poses: initial poses, not exact and in another unit, with tracks.
    """

    rig: LensRig
    true: list[Rigid3]
    points: NDArray[np.float64]
    poses: Poses

    @property
    def rigs(self) -> dict[str, LensRig]:
        return dict.fromkeys(self.poses.names, self.rig)

    def errors(self, found: Poses) -> tuple[float, float]:
        """Median error of the centres after a similarity, in metres, and of the rotations, in degrees."""
        centers = np.array([pose.center for pose in self.true])
        fit: Similarity3 = similarity_from_points(found.centers, centers)
        off = np.linalg.norm(fit.apply(found.centers) - centers, axis=1)
        turns = [
            np.degrees(np.arccos(np.clip((np.trace(r @ fit.rotation.T @ t.rotation.T) - 1) / 2, -1, 1)))
            for r, t in zip(found.rotations, self.true, strict=True)
        ]
        return float(np.median(off)), float(np.median(turns))

    def scale_error(self, found: Poses) -> float:
        """Relative error of the unit of length."""
        centers = np.array([pose.center for pose in self.true])
        return abs(similarity_from_points(found.centers, centers).scale - 1)


def rig_capture(
    *,
    offset_m: float = 0.03,
    stitch_distance_m: float = 3.0,
    noise_deg: float = 0.03,
    count: int = 6,
    points: int = 500,
    unit: float = 1.7,
    spread: float = 0.8,
    seed: int = 0,
) -> RigCapture:
    """Return what rigs in the furnished room see of points on its surfaces; the true unit is `unit` metres."""
    rng = np.random.default_rng(seed)
    rig = example_rig(offset_m=offset_m, stitch_distance_m=stitch_distance_m)
    true = capture_poses(count, spread=spread, seed=seed)
    rays = rng.normal(size=(points, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    world = true[0].center + rays * range_along(default_room(), true[0].center, rays)[:, None]
    bearings = []
    for pose in true:
        x = pose.apply(world)
        origins = rig.centers[rig.lens_of_bearings(x / np.linalg.norm(x, axis=1, keepdims=True))]
        seen = x - origins
        seen /= np.linalg.norm(seen, axis=1, keepdims=True)
        seen += rng.normal(0, np.radians(noise_deg), seen.shape)
        bearings.append(rig.bearings_from_rays(origins, seen / np.linalg.norm(seen, axis=1, keepdims=True)))
    cameras = {
        f"{idx:03d}.png": Rigid3.from_center(
            rotation_from_rotvec(rng.normal(0, np.radians(0.3), 3)) @ pose.rotation,
            (pose.center + rng.normal(0, 0.01, 3)) / unit,
        )
        for idx, pose in enumerate(true)
    }
    bare = Poses.without_points(cameras, frame="the room's", scale="arbitrary", metric=False)
    poses = replace(
        bare,
        points_in_world=world / unit,
        point_colors_rgb=np.zeros((points, 3), np.uint8),
        point_errors_rad=np.zeros(points, np.float32),
        track_point_idx=np.tile(np.arange(points, dtype=np.int32), count),
        track_image_idx=np.repeat(np.arange(count, dtype=np.int32), points),
        track_bearings=np.concatenate([b / np.linalg.norm(b, axis=1, keepdims=True) for b in bearings]),
    )
    return RigCapture(rig, true, world, poses)
