"""Which elevations panoramas cover, from how their rays fit: 90° above and below, unless they were cropped.

A panorama that was cropped above and below and stretched to twice as wide as high shows its elevations too large. The
elevation φ that the picture claims is then a φ + c in truth. Both follow from the rays of an adjusted bundle like any
other parameter of a camera, by one Gauss–Newton step that leaves out what cameras and points explain themselves.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import LinAlgError

from pano_mvs.algorithms.poses.adjustment.bundle import Bundle, Loss
from pano_mvs.algorithms.poses.adjustment.offset_scale import ray_derivatives, unexplained
from pano_mvs.algorithms.poses.adjustment.uncertainty import held_cameras
from pano_mvs.algorithms.two_view.refinement import tangent_basis
from pano_mvs.core.arrays import FloatArray


@dataclass(frozen=True, slots=True)
class ElevationRange:
    """The elevations of the upper and the lower edge of the panoramas."""

    top_deg: float  # of the upper edge; 90 for a full sphere
    bottom_deg: float  # of the lower edge; −90 for a full sphere
    stds_deg: tuple[float, float]  # standard deviations of both from noise in the rays; inf if they cannot be estimated

    @property
    def is_full(self) -> bool:
        """Return whether both edges may be the poles, within four standard deviations."""
        return self.deviations <= 4.0

    @property
    def deviations(self) -> float:
        """The larger distance of an edge from its pole, in standard deviations."""
        off_deg = np.abs([self.top_deg - 90.0, self.bottom_deg + 90.0])
        # Beyond the noise in the rays: on six captures of full spheres, real and rendered, the edges were at most 0.23°
        # off.
        return float((off_deg / np.hypot(self.stds_deg, 0.25)).max())

    def elevations_rad(self, elevations_rad: FloatArray) -> FloatArray:
        """Return the true elevations of what images that were read as full spheres show at some elevations."""
        middle, half = 0.5 * (self.top_deg + self.bottom_deg), 0.5 * (self.top_deg - self.bottom_deg)
        elevations: FloatArray = np.radians(middle) + elevations_rad * half / 90.0
        return elevations

    def bearings(self, bearings: FloatArray) -> FloatArray:
        """Return the true rays (T, 3) of images that were read as full spheres."""
        x, y, z = bearings.T
        azimuths, elevations = np.arctan2(x, z), self.elevations_rad(np.arcsin(np.clip(-y, -1, 1)))
        level = np.cos(elevations)
        return np.stack([level * np.sin(azimuths), -np.sin(elevations), level * np.cos(azimuths)], axis=1)

    def then(self, step: ElevationRange) -> ElevationRange:
        """Return the range whose true elevations are those of a further step."""
        edges = np.degrees(step.elevations_rad(np.radians([self.top_deg, self.bottom_deg])))
        return ElevationRange(float(edges[0]), float(edges[1]), step.stds_deg)


def estimate_elevation_range(bundle: Bundle, *, loss: Loss, scale_rad: float, neighbour: int) -> ElevationRange:
    """Return the elevations of the edges that fit the rays best.

    Args:
        bundle: an adjusted bundle of panoramas that all cover the same elevations.
        loss: the loss of the adjustment.
        scale_rad: the scale of that loss.
        neighbour: position of the camera whose distance to the first is held.
    """
    unknown = ElevationRange(90.0, -90.0, (float("inf"), float("inf")))
    held = held_cameras(bundle, loss=loss, scale_rad=scale_rad, neighbour=neighbour)
    derivatives = ray_derivatives(held.bundle)
    x, y, z = held.bundle.bearings.T
    elevations, level = np.arcsin(np.clip(-y, -1, 1)), np.maximum(np.hypot(x, z), 1e-12)
    upwards = np.stack([y * x / level, -level, y * z / level], axis=1)
    by_shift = -np.einsum("tij,tj->ti", np.swapaxes(tangent_basis(held.bundle.bearings), 1, 2), upwards)
    try:
        own = np.stack(
            [unexplained(held, derivatives, by) for by in (elevations[:, None] * by_shift, by_shift)], axis=-1
        )
        information = np.einsum("t,tik,til->kl", held.weights, own, own)
        covariance = held.variance * np.linalg.inv(information)
    except LinAlgError:
        return unknown
    step = -np.linalg.solve(information, np.einsum("t,tik,ti->k", held.weights, own, derivatives.residuals))
    edges = np.array([[np.pi / 2, 1.0], [-np.pi / 2, 1.0]])
    variances = np.einsum("ek,kl,el->e", edges, covariance, edges)
    if not (np.isfinite(variances).all() and (variances > 0).all()):
        return unknown
    top, bottom = np.degrees(edges @ (np.array([1.0, 0.0]) + step))
    stds = np.degrees(np.sqrt(variances))
    return ElevationRange(float(top), float(bottom), (float(stds[0]), float(stds[1])))
