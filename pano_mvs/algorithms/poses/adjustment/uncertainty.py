"""Uncertainty of the cameras of an adjusted bundle, and of its unit of length, from the curvature of its cost."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from pano_mvs.algorithms.poses.adjustment.bundle import (
    Bundle,
    ReducedCameras,
    RobustLoss,
    reduced_cameras,
    with_camera_order,
)
from pano_mvs.algorithms.poses.adjustment.camera_system import camera_order, camera_solver, held
from pano_mvs.algorithms.two_view.refinement import tangent_basis
from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.errors import UsageError

_COLUMNS_AT_ONCE = 64  # cameras


@dataclass(frozen=True, slots=True, eq=False)
class HeldCameras:
    """The reduced system of the cameras with the first camera and the length of the first baseline held."""

    bundle: Bundle  # the bundle with its cameras in the order of the system
    place: NDArray[np.intp]  # (N,) position of each camera in that order
    weights: FloatArray  # (T,) of the squared errors
    system: ReducedCameras  # the reduced system, without the constraints
    band: FloatArray  # the matrix with the constraints
    unseen: NDArray[np.bool_]  # (N,) cameras without observations, in the order of the system
    variance: float  # of a residual with weight 1


def held_cameras(bundle: Bundle, loss: RobustLoss, *, neighbour: int) -> HeldCameras:
    """Return the system of an adjusted bundle; the parameters are those of `camera_deviations`."""
    order = camera_order(bundle.point_idx, bundle.image_idx, len(bundle.centers))
    place = np.argsort(order)
    ordered = with_camera_order(bundle, order, place)
    weights = ordered.weights(ordered.scaled_errors_rad(), loss)
    errors = ordered.errors_rad()
    system = reduced_cameras(ordered, weights, damping=0.0)
    band, _ = held(system.band, system.gradient, int(place[0]))
    _hold_length(band, ordered.centers, int(place[0]), neighbour=int(place[neighbour]))
    unseen = system.diagonal.reshape(-1, 6)[:, 0] == 0
    band[np.repeat(unseen, 6), 0] = 1.0
    redundancy = 2 * len(errors) - 6 * len(bundle.centers) - 3 * len(bundle.points) + 7
    variance = float(np.sum(weights * errors**2)) / max(redundancy, 1)
    return HeldCameras(ordered, place, weights, system, band, unseen, variance)


def camera_deviations(bundle: Bundle, loss: RobustLoss, *, neighbour: int) -> tuple[FloatArray, FloatArray]:
    """Return the standard deviations of camera centres and rotations, given the first camera and first baseline.

    The covariance is σ² S⁻¹, where S is the reduced system of the cameras with the robust weights w at the optimum
    (divided by the squared sigmas), and σ² = Σ w r² / (2T − 6N − 3P + 7) is the variance of the residuals r; Triggs et
    al., "Bundle Adjustment — A Modern Synthesis", 2000, sections 4 and 9. It covers noise in the rays only, not
    stitching errors or repeated structure.

    Args:
        bundle: an adjusted bundle.
        loss: the loss of the adjustment.
        neighbour: position of the camera whose distance to the first is the unit of length.

    Returns:
        centers (N,), square roots of the traces of the centres' covariances, in scene units; rotations (N,), likewise,
        in radians. Zero for the first camera; NaN if unknown: for a camera without observations, or if the system is
        singular.
    """
    held_system = held_cameras(bundle, loss, neighbour=neighbour)
    place, band, unseen = held_system.place, held_system.band, held_system.unseen
    variance = held_system.variance
    try:
        diagonal = variance * _inverse_diagonal(band)
    except scipy.linalg.LinAlgError:
        diagonal = np.full(len(band), np.nan)
    deviations = np.sqrt(diagonal.reshape(-1, 2, 3).sum(axis=2))
    deviations[unseen] = np.nan
    deviations[place[0]] = 0.0
    return deviations[place, 1], deviations[place, 0]


def _hold_length(band: FloatArray, centers: FloatArray, first: int, *, neighbour: int) -> None:
    """Constrain the system so that the distance between two cameras does not change."""
    along = centers[neighbour] - centers[first]
    along /= np.linalg.norm(along)
    stiffness = 1e6 * float(band[:, 0].max())  # stiffness of the unit of length, relative to the stiffest camera
    for j in range(3):
        for i in range(j, 3):
            band[6 * neighbour + 3 + j, i - j] += stiffness * along[i] * along[j]


def _inverse_diagonal(band: FloatArray) -> FloatArray:
    """Return the diagonal of the inverse, (6N,)."""
    solve = camera_solver(band)
    size = len(band)
    diagonal = np.empty(size)
    for start in range(0, size, 6 * _COLUMNS_AT_ONCE):
        columns = np.arange(start, min(size, start + 6 * _COLUMNS_AT_ONCE))
        right = np.zeros((size, len(columns)))
        right[columns, np.arange(len(columns))] = 1.0
        diagonal[columns] = solve(right)[columns, np.arange(len(columns))]
    return diagonal


@dataclass(frozen=True, slots=True)
class OffsetScale:
    """An estimate of the units per metre."""

    units_per_m: float  # units of the world per metre
    std: float  # its standard deviation from noise in the rays; inf if it cannot be estimated

    @property
    def relative_std(self) -> float:
        """The standard deviation as a share of the value; inf for a value that is not positive."""
        return self.std / self.units_per_m if self.units_per_m > 0 else float("inf")


def estimate_offset_scale(bundle: Bundle, loss: RobustLoss, *, neighbour: int) -> OffsetScale:
    """Return the units per metre that fit the rays best, by one Gauss–Newton step from the bundle's own value.

    Residuals are r(u) ≈ r + g (u − u₀), where u is the units per metre and g = −Bᵀ (I − x̂ x̂ᵀ) o / |x|. The first
    camera and the length of the first baseline are held, because without offsets they define the unit.

    Args:
        bundle: an adjusted bundle with offsets.
        loss: the loss of the adjustment.
        neighbour: position of the camera whose distance to the first is held.

    Raises:
        UsageError: if the bundle has no offsets.
    """
    if bundle.offsets_m is None:
        raise UsageError("a bundle without offsets of its rays has no unit of length")
    held = held_cameras(bundle, loss, neighbour=neighbour)
    derivatives = ray_derivatives(held.bundle)
    assert held.bundle.offsets_m is not None
    by_unit = -np.einsum("tij,tj->ti", derivatives.by_ray, held.bundle.offsets_m)
    step, covariance = parameter_step(held, derivatives, by_unit[..., None])
    return OffsetScale(bundle.units_per_m + float(step[0]), float(np.sqrt(covariance[0, 0])))


def parameter_step(
    held: HeldCameras, derivatives: RayDerivatives, by_parameters: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the Gauss–Newton step of parameters of all rays, (K,), and its covariance; 0 and inf if it is unknown.

    Of the derivatives, only the part counts that no movement of cameras and points explains (variable projection;
    Golub & Pereyra 1973).

    Args:
        held: the system of the cameras.
        derivatives: those of the bundle of the system.
        by_parameters: (T, 2, K) derivatives of the residuals by the parameters.
    """
    count = by_parameters.shape[2]
    try:
        own = np.stack([unexplained(held, derivatives, by) for by in np.moveaxis(by_parameters, 2, 0)], axis=-1)
        information = np.einsum("t,tik,til->kl", held.weights, own, own)
        covariance = held.variance * np.linalg.inv(information)
    except scipy.linalg.LinAlgError:
        return np.zeros(count), np.full((count, count), np.inf)
    step = -np.linalg.solve(information, np.einsum("t,tik,ti->k", held.weights, own, derivatives.residuals))
    known = np.isfinite(covariance).all() and (np.diagonal(covariance) > 0).all()
    return (step, covariance) if known else (np.zeros(count), np.full((count, count), np.inf))


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
