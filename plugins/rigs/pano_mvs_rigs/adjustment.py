"""Bundle adjustment of the lenses of a rig, the pose of the second lens in the first, cameras and points.

The residuals are distances in pixels between key points and the Kannala–Brandt projections of their points, with a
Cauchy loss. Levenberg–Marquardt steps are solved for lenses and cameras alone, after the points are eliminated (Schur
complement; Triggs et al. 2000, "Bundle adjustment: a modern synthesis", section 6.1). Its inverse is their covariance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import rotation_from_rotvec, skew

INTRINSICS = 7  # f, cx, cy, k1, k2, k3, k4
RIG = slice(2 * INTRINSICS, 2 * INTRINSICS + 6)
CAMERAS = RIG.stop


@dataclass(frozen=True, eq=False)
class RigBundle:
    """Lenses, cameras, points and observations."""

    lenses: FloatArray  # (2, 7) f, cx, cy, k1, k2, k3, k4 of each lens, in pixels
    turn: FloatArray  # (3, 3) rotation of second_lens_from_first
    offset: FloatArray  # (3,) its translation, in units of the world
    rotations: FloatArray  # (N, 3, 3) of first_lens_from_world of each camera; the first camera is held
    translations: FloatArray  # (N, 3)
    points: FloatArray  # (P, 3) in the world
    pixels: FloatArray  # (M, 2) observed
    lens_idx: NDArray[np.intp]  # (M,) lens of each observation: 0 or 1
    camera_idx: NDArray[np.intp]  # (M,) its camera
    point_idx: NDArray[np.intp]  # (M,) its point

    def only(self, keep: NDArray[np.bool_]) -> RigBundle:
        """Return the bundle with some of its observations, and the points that two or more of them see."""
        seen = np.bincount(self.point_idx[keep], minlength=len(self.points)) >= 2
        keep = keep & seen[self.point_idx]
        number = np.cumsum(seen) - 1
        return replace(
            self,
            points=self.points[seen],
            pixels=self.pixels[keep],
            lens_idx=self.lens_idx[keep],
            camera_idx=self.camera_idx[keep],
            point_idx=number[self.point_idx[keep]],
        )


@dataclass(frozen=True, eq=False)
class Freedom:
    """What is adjusted, and what is known about it before."""

    # (20,) standard deviations of f, cx, cy and k1 to k4 of both lenses, the rotation (radians) and the offset of the
    # second lens about their start values; 0 holds a value, inf leaves it free
    sigmas: FloatArray
    start: FloatArray  # (20,) the start values; those of the rotation are 0


def residuals_px(bundle: RigBundle) -> FloatArray:
    """Return the distances of the observations from the projections of their points, (M,), in pixels."""
    return np.asarray(np.hypot(*_linearised(bundle)[0].T))


def adjust_rig(
    bundle: RigBundle, freedom: Freedom, *, scale_px: float, max_iterations: int = 30
) -> tuple[RigBundle, FloatArray]:
    """Return the adjusted bundle and the covariance of its lenses and rig, (20, 20).

    The length of the longest baseline from the first camera is held, if there is one. The covariance is that of noise
    in the key points only, as large as the residuals show; rows of held values are 0.

    Args:
        bundle: start values.
        freedom: what is adjusted.
        scale_px: residual at which an observation starts to lose influence.
        max_iterations: maximum number of steps.
    """
    damping, turned = 1e-4, np.zeros(3)
    system = _System(bundle, freedom, turned, scale_px=scale_px)
    for _ in range(max_iterations):
        step, point_steps = system.step(damping)
        moved, more = _moved(bundle, step, point_steps), turned + step[RIG][:3]
        trial = _System(moved, freedom, more, scale_px=scale_px)
        if not trial.cost < system.cost:
            damping *= 10
            if damping > 1e6:
                break
            continue
        gained = (system.cost - trial.cost) / system.cost
        bundle, turned, system, damping = moved, more, trial, max(damping / 5, 1e-9)
        if gained < 1e-5:
            break
    return bundle, system.covariance()


class _System:
    """The normal equations at some values."""

    def __init__(self, bundle: RigBundle, freedom: Freedom, turned: FloatArray, *, scale_px: float) -> None:
        errors, by_camera, columns, by_point = _linearised(bundle)
        size = CAMERAS + 6 * len(bundle.rotations)
        squared = np.sum(errors**2, axis=1) / scale_px**2
        root = np.sqrt(1 / (1 + squared))  # of the weight that the Cauchy loss gives
        self.cost = float(0.5 * scale_px**2 * np.log1p(squared).sum())
        # Of a Rayleigh distribution, and larger than the residuals because of what was adjusted.
        redundancy = 1 - min((size + 3 * len(bundle.points)) / max(2 * len(errors), 1), 0.9)
        noise = np.median(np.hypot(*errors.T)) / np.sqrt(2 * np.log(2)) if len(errors) else 0.0
        self._noise = float(noise / np.sqrt(redundancy))
        by_camera, by_point = by_camera * root[:, None, None], by_point * root[:, None, None]
        weighted = errors * root[:, None]
        self._both = np.zeros((size, len(bundle.points), 3))
        self._camera_block, self._camera_side = np.zeros((size, size)), np.zeros(size)
        view_idx = 2 * bundle.camera_idx + bundle.lens_idx
        for view in np.unique(view_idx):  # a view sees a point once
            seen = np.flatnonzero(view_idx == view)
            own = columns[seen[0]]
            rows = by_camera[seen].reshape(-1, by_camera.shape[-1])
            self._camera_block[np.ix_(own, own)] += rows.T @ rows
            self._camera_side[own] -= rows.T @ weighted[seen].ravel()
            mixed = np.einsum("mki,mkj->imj", by_camera[seen], by_point[seen])
            self._both[np.ix_(own, bundle.point_idx[seen])] += mixed
        self._point_blocks, self._point_side = np.zeros((len(bundle.points), 3, 3)), np.zeros((len(bundle.points), 3))
        np.add.at(self._point_blocks, bundle.point_idx, np.einsum("mki,mkj->mij", by_point, by_point))
        np.add.at(self._point_side, bundle.point_idx, -np.einsum("mki,mk->mi", by_point, weighted))
        self._add_prior(bundle, freedom, turned)
        held = np.zeros(size, np.bool_)
        held[: len(freedom.sigmas)] = freedom.sigmas == 0
        held[CAMERAS : CAMERAS + 6] = True
        self._free = ~held

    def _add_prior(self, bundle: RigBundle, freedom: Freedom, turned: FloatArray) -> None:
        known = (freedom.sigmas > 0) & np.isfinite(freedom.sigmas)
        weights = np.zeros(len(freedom.sigmas))
        weights[known] = 1 / freedom.sigmas[known] ** 2
        now = np.concatenate([bundle.lenses.ravel(), turned, bundle.offset])
        off = np.where(known, now - freedom.start, 0.0)
        # In units of the noise, so that a prior counts as its standard deviation says.
        weights *= self._noise**2
        prior = np.arange(len(weights))
        self._camera_block[prior, prior] += weights
        self._camera_side[prior] -= weights * off
        self.cost += float(0.5 * np.sum(weights * off**2))
        lengths = np.linalg.norm(bundle.translations - bundle.translations[0], axis=1)
        farthest = int(np.argmax(lengths))
        if lengths[farthest] > 0:
            place = CAMERAS + 6 * farthest + 3
            along = bundle.translations[farthest] / lengths[farthest]
            self._camera_block[place : place + 3, place : place + 3] += (
                1e8 / lengths[farthest] ** 2 * np.outer(along, along)
            )

    def _reduced(self, damping: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the system without the points, its right-hand side, and the inverse of the points' blocks."""
        diagonal = np.einsum("pii->pi", self._point_blocks)
        # Seen from one place, a point may lie anywhere along its ray.
        least = 1e-9 * diagonal.sum(axis=1, keepdims=True) + 1e-12
        inverse = np.linalg.inv(self._point_blocks + (damping * diagonal + least)[..., None] * np.eye(3))
        size = len(self._camera_side)
        eliminated = np.einsum("cpi,pij->cpj", self._both, inverse).reshape(size, -1)
        block = self._camera_block + damping * np.diag(np.diag(self._camera_block))
        matrix = block - eliminated @ self._both.reshape(size, -1).T
        side = self._camera_side - eliminated @ self._point_side.ravel()
        return matrix[np.ix_(self._free, self._free)], side[self._free], inverse

    def step(self, damping: float) -> tuple[FloatArray, FloatArray]:
        """Return the steps of lenses, rig and cameras, (C,), and of the points, (P, 3)."""
        matrix, side, inverse = self._reduced(damping)
        step = np.zeros(len(self._free))
        step[self._free] = _solved(matrix, side)
        left = self._point_side - np.tensordot(step, self._both, axes=1)
        return step, np.einsum("pij,pj->pi", inverse, left)

    def covariance(self) -> FloatArray:
        """Return the covariance of lenses and rig, (20, 20)."""
        matrix, _, _ = self._reduced(0.0)
        full = np.zeros((len(self._free), len(self._free)))
        full[np.ix_(self._free, self._free)] = _solved(matrix, np.eye(len(matrix))) * self._noise**2
        return full[:CAMERAS, :CAMERAS]


def _solved(matrix: FloatArray, side: FloatArray) -> FloatArray:
    """Return the solution of a positive definite system, scaled to a unit diagonal, since units differ greatly."""
    scale = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-30))
    scaled = matrix * scale[:, None] * scale
    right = side * (scale if side.ndim == 1 else scale[:, None])
    found = np.linalg.lstsq(scaled, right, rcond=1e-14)[0]
    return np.asarray(found * (scale if side.ndim == 1 else scale[:, None]))


def _moved(bundle: RigBundle, step: FloatArray, point_steps: FloatArray) -> RigBundle:
    cameras = step[CAMERAS:].reshape(-1, 6)
    return replace(
        bundle,
        lenses=bundle.lenses + step[: 2 * INTRINSICS].reshape(2, INTRINSICS),
        turn=rotation_from_rotvec(step[RIG][:3]) @ bundle.turn,
        offset=bundle.offset + step[RIG][3:],
        rotations=rotation_from_rotvec(cameras[:, :3]) @ bundle.rotations,
        translations=bundle.translations + cameras[:, 3:],
        points=bundle.points + point_steps,
    )


def _linearised(bundle: RigBundle) -> tuple[FloatArray, FloatArray, NDArray[np.intp], FloatArray]:
    """Return the errors (M, 2) and their derivatives.

    Those by lens, rig and camera are (M, 2, 19), with their columns (M, 19), and those by the point (M, 2, 3). A turn ω
    acts from the left: R ← exp(ω) R.
    """
    rotations = bundle.rotations[bundle.camera_idx]
    turned = np.einsum("mij,mj->mi", rotations, bundle.points[bundle.point_idx])
    in_first = turned + bundle.translations[bundle.camera_idx]
    second = bundle.lens_idx == 1
    from_first = np.where(second[:, None, None], bundle.turn, np.eye(3))
    carried = np.einsum("mij,mj->mi", from_first, in_first)
    in_lens = carried + np.where(second[:, None], bundle.offset, 0.0)
    projected, by_lens, by_ray = _projected(bundle.lenses[bundle.lens_idx], in_lens)
    by_first = by_ray @ from_first
    by_rig = np.concatenate([-by_ray @ skew(carried), by_ray], axis=-1) * second[:, None, None]
    by_pose = np.concatenate([-by_first @ skew(turned), by_first], axis=-1)
    columns = np.concatenate(
        [
            INTRINSICS * bundle.lens_idx[:, None] + np.arange(INTRINSICS),
            np.broadcast_to(np.arange(RIG.start, RIG.stop), (len(second), 6)),
            CAMERAS + 6 * bundle.camera_idx[:, None] + np.arange(6),
        ],
        axis=1,
    )
    return (
        projected - bundle.pixels,
        np.concatenate([by_lens, by_rig, by_pose], axis=-1),
        columns,
        by_first @ rotations,
    )


def _projected(lens: FloatArray, rays: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return pixels (M, 2) of rays (M, 3) of any length, their derivatives by the lens (M, 2, 7) and ray (M, 2, 3).

    `lens`: (M, 7). With d(θ) as in `FisheyeLens` and s = d(θ) / r, the pixel is f s (x, y) + c.
    """
    focal, plane, z = lens[:, :1], rays[:, :2], rays[:, 2]
    r = np.maximum(np.hypot(*plane.T), 1e-12)
    angle = np.arctan2(r, z)
    powers = angle[:, None] ** np.arange(1, 10, 2)
    shape = np.concatenate([np.ones((len(lens), 1)), lens[:, 3:]], axis=1)
    d = np.sum(shape * powers, axis=1)
    slope = np.sum(shape * np.arange(1, 10, 2) * angle[:, None] ** np.arange(0, 9, 2), axis=1)
    s = d / r
    squared = r**2 + z**2
    s_by_r, s_by_z = slope * z / squared / r - d / r**2, -slope / squared
    by_ray = np.empty((len(lens), 2, 3))
    by_ray[:, :, :2] = s[:, None, None] * np.eye(2) + plane[:, :, None] * plane[:, None] * (s_by_r / r)[:, None, None]
    by_ray[:, :, 2] = plane * s_by_z[:, None]
    by_lens = np.zeros((len(lens), 2, INTRINSICS))
    by_lens[:, :, 0] = s[:, None] * plane
    by_lens[:, :, 1:3] = np.eye(2)
    by_lens[:, :, 3:] = (focal * plane / r[:, None])[:, :, None] * powers[:, None, 1:]
    return focal * s[:, None] * plane + lens[:, 1:3], by_lens, by_ray * focal[:, None]
