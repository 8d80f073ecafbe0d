"""The unit of length of a bundle, from rays that start at known distances from the centres of their cameras."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import LinAlgError

from pano_mvs.algorithms.poses.adjustment.bundle import Bundle, Loss
from pano_mvs.algorithms.poses.adjustment.camera_system import camera_solver
from pano_mvs.algorithms.poses.adjustment.uncertainty import HeldCameras, held_cameras
from pano_mvs.algorithms.two_view.refinement import tangent_basis
from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.errors import UsageError


@dataclass(frozen=True, slots=True)
class OffsetScale:
    """An estimate of the units per metre."""

    units_per_m: float  # units of the world per metre
    std: float  # its standard deviation from noise in the rays; inf if it cannot be estimated

    @property
    def relative_std(self) -> float:
        """The standard deviation as a share of the value; inf for a value that is not positive."""
        return self.std / self.units_per_m if self.units_per_m > 0 else float("inf")


def estimate_offset_scale(bundle: Bundle, *, loss: Loss, scale_rad: float, neighbour: int) -> OffsetScale:
    """Return the units per metre that fit the rays best, by one Gauss–Newton step from the bundle's own value.

    Residuals are r(u) ≈ r + g (u − u₀), where u is the units per metre and g = −Bᵀ (I − x̂ x̂ᵀ) o / |x|. Of g, only the
    part counts that no movement of the cameras and points explains (variable projection; Golub & Pereyra 1973). The
    first camera and the length of the first baseline are held, because without offsets they define the unit.

    Args:
        bundle: an adjusted bundle with offsets.
        loss: the loss of the adjustment.
        scale_rad: the scale of that loss.
        neighbour: position of the camera whose distance to the first is held.

    Raises:
        UsageError: if the bundle has no offsets.
    """
    if bundle.offsets_m is None:
        raise UsageError("a bundle without offsets of its rays has no unit of length")
    held = held_cameras(bundle, loss=loss, scale_rad=scale_rad, neighbour=neighbour)
    derivatives = ray_derivatives(held.bundle)
    assert held.bundle.offsets_m is not None
    by_unit = -np.einsum("tij,tj->ti", derivatives.by_ray, held.bundle.offsets_m)
    try:
        own = unexplained(held, derivatives, by_unit)
    except LinAlgError:
        return OffsetScale(bundle.units_per_m, float("inf"))
    information = float(np.sum(held.weights[:, None] * own**2))
    if not information > 0:
        return OffsetScale(bundle.units_per_m, float("inf"))
    step = -float(np.sum(held.weights[:, None] * own * derivatives.residuals)) / information
    return OffsetScale(bundle.units_per_m + step, float(np.sqrt(held.variance / information)))


@dataclass(frozen=True, slots=True, eq=False)
class RayDerivatives:
    """Residuals (T, 2), and their derivatives by ray (T, 2, 3), camera (T, 2, 6) and point (T, 2, 3)."""

    residuals: FloatArray
    by_ray: FloatArray
    by_camera: FloatArray
    by_point: FloatArray


def ray_derivatives(bundle: Bundle) -> RayDerivatives:
    """Return the residuals of a bundle on the tangent planes of its bearings, with their derivatives."""
    rays = bundle.rays_in_cam()
    lengths = np.linalg.norm(rays, axis=1)
    unit = rays / lengths[:, None]
    bases = np.swapaxes(tangent_basis(bundle.bearings), 1, 2)
    residuals = np.einsum("tij,tj->ti", bases, unit)
    by_ray = (bases - residuals[..., None] * unit[:, None]) / lengths[:, None, None]
    by_point = by_ray @ bundle.rotations[bundle.image_idx]
    # R ← exp(ω) R turns y = R (X − C), which is the ray and its origin together.
    by_turn = np.cross((rays + bundle.origins)[:, None], by_ray)
    return RayDerivatives(residuals, by_ray, np.concatenate([by_turn, -by_point], axis=2), by_point)


def unexplained(held: HeldCameras, derivatives: RayDerivatives, by_parameter: FloatArray) -> FloatArray:
    """Return the part of the derivatives by a parameter that no movement of cameras and points explains, (T, 2).

    Args:
        held: the system of the cameras.
        derivatives: those of the bundle of the system.
        by_parameter: (T, 2) derivatives of the residuals by the parameter.

    Raises:
        LinAlgError: if the system is singular.
    """
    bundle, system = held.bundle, held.system
    weighted = held.weights[:, None] * by_parameter
    point_right = np.zeros((len(bundle.points), 3))
    np.add.at(point_right, bundle.point_idx, np.einsum("tij,ti->tj", derivatives.by_point, weighted))
    through_points = np.einsum("pij,pj->pi", system.inverses, point_right)
    right = np.zeros((len(bundle.centers), 6))
    np.add.at(right, bundle.image_idx, np.einsum("tij,ti->tj", derivatives.by_camera, weighted))
    np.add.at(right, bundle.image_idx, -np.einsum("tij,tj->ti", system.couplings, through_points[bundle.point_idx]))
    right[held.place[0]] = 0.0
    right[held.unseen] = 0.0
    cameras = camera_solver(held.band)(right.reshape(-1)).reshape(-1, 6)
    coupled = np.zeros_like(point_right)
    np.add.at(coupled, bundle.point_idx, np.einsum("tij,ti->tj", system.couplings, cameras[bundle.image_idx]))
    points = np.einsum("pij,pj->pi", system.inverses, point_right - coupled)
    explained = np.einsum("tij,tj->ti", derivatives.by_camera, cameras[bundle.image_idx])
    explained += np.einsum("tij,tj->ti", derivatives.by_point, points[bundle.point_idx])
    remaining: FloatArray = by_parameter - explained
    return remaining
