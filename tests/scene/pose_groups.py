"""Poses of several groups, drawn at random."""

from __future__ import annotations

import numpy as np

from pano_mvs.geometry import Rigid3
from pano_mvs.geometry.transforms import rotation_from_rotvec
from pano_mvs.scene import Poses


def drawn_group(names: tuple[str, ...], *, seed: int, points: int = 30, frame: str = "", scale: str = "") -> Poses:
    """Return upright cameras around the origin, with points that all of them see."""
    rng = np.random.default_rng(seed)
    cameras = {
        name: Rigid3(rotation_from_rotvec(rng.normal(0, [0.02, 1.0, 0.02])), rng.normal(0, 1, 3)) for name in names
    }
    known = Poses.without_points(
        cameras, frame=frame or f"frame {seed}", scale=scale or f"unit {seed}", metric=seed % 2 == 1
    )
    positions = rng.normal(0, 4, (points, 3))
    rays = np.einsum("nij,npj->npi", known.rotations, positions[None] - known.centers[:, None])
    return Poses(
        names=known.names,
        rotations=known.rotations,
        translations=known.translations,
        points_in_world=positions,
        point_colors_rgb=rng.integers(0, 256, (points, 3), np.uint8),
        point_errors_rad=np.full(points, 1e-3, np.float32),
        track_point_idx=np.tile(np.arange(points, dtype=np.int32), len(names)),
        track_image_idx=np.repeat(np.arange(len(names), dtype=np.int32), points),
        track_bearings=(rays / np.linalg.norm(rays, axis=-1, keepdims=True)).reshape(-1, 3),
        rejected={},
        frame=known.frame,
        scale=known.scale,
        metric=known.metric,
        center_stds=rng.random(len(names)),
        rotation_stds_rad=rng.random(len(names)),
        evidence={names[0]: {"share": float(seed), "repeats": None}},
        doubts={names[-1]: f"doubt {seed}"},
        track_sigmas_rad=rng.uniform(1e-4, 1e-3, points * len(names)).astype(np.float32),
    )
