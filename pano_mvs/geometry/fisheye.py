"""The Kannala–Brandt camera of fisheye lenses: COLMAP's OPENCV_FISHEYE, OpenCV's `cv2.fisheye`, Kalibr's pinhole-equi.

A ray at the angle θ from the lens's axis (z) has the pixel

    x = fx d(θ) cos ψ + cx,  y = fy d(θ) sin ψ + cy,  d(θ) = θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸),

with ψ = atan2(Y, X). θ may exceed 90°. Kannala & Brandt, "A Generic Camera Model and Calibration Method for
Conventional, Wide-Angle, and Fish-Eye Lenses", 2006, equation 6.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.errors import UsageError

_ITERATIONS = 20
_EXACT = 1e-14


@dataclass(frozen=True, slots=True)
class FisheyeLens:
    """A lens of the Kannala–Brandt model with its picture.

    Attributes:
        size_hw: (height, width) of the picture.
        focal_xy: (fx, fy) in pixels per radian at the axis.
        principal_xy: (cx, cy), the pixel of the axis; (0, 0) is the upper-left corner of the picture.
        distortion: k1, k2, k3, k4.
        max_angle_rad: largest angle from the axis that the lens sees, half of its field of view.
    """

    size_hw: tuple[int, int]
    focal_xy: tuple[float, float]
    principal_xy: tuple[float, float]
    distortion: tuple[float, float, float, float]
    max_angle_rad: float

    def __post_init__(self) -> None:
        """Raise UsageError if the lens is impossible, or its pixels are not unique within the field of view."""
        if min(self.size_hw) < 1 or min(self.focal_xy) <= 0:
            raise UsageError("the image size and the focal lengths of a lens must be positive")
        if not 0 < self.max_angle_rad <= np.pi:
            raise UsageError("the field of view of a lens must be more than 0° and at most 360°")
        limit = self.monotonic_limit_rad
        if limit <= self.max_angle_rad:
            raise UsageError(
                f"the distortion is not invertible: the radius in the picture stops growing {np.degrees(limit):.1f}° "
                f"from the axis, but the field of view reaches {np.degrees(self.max_angle_rad):.1f}°"
            )

    @property
    def monotonic_limit_rad(self) -> float:
        """The angle up to which d(θ) grows: the smallest positive root of d′(θ), inf if there is none."""
        k1, k2, k3, k4 = self.distortion
        roots = np.roots([9 * k4, 7 * k3, 5 * k2, 3 * k1, 1.0])  # in θ²
        real = roots.real[(np.abs(roots.imag) <= 1e-9 * np.abs(roots)) & (roots.real > 0)]
        return float(np.sqrt(real.min())) if len(real) else float("inf")

    def radius_from_angle(self, angles_rad: ArrayLike) -> FloatArray:
        """Return d(θ), (...,): the distance from the principal point divided by the focal length."""
        angles = np.asarray(angles_rad, dtype=np.float64)
        squared = angles**2
        k1, k2, k3, k4 = self.distortion
        radius: FloatArray = angles * (1 + squared * (k1 + squared * (k2 + squared * (k3 + squared * k4))))
        return radius

    def radius_slope(self, angles_rad: ArrayLike) -> FloatArray:
        """Return d′(θ), (...,): pixels per radian away from the axis, divided by the focal length."""
        squared = np.asarray(angles_rad, dtype=np.float64) ** 2
        k1, k2, k3, k4 = self.distortion
        slope: FloatArray = 1 + squared * (3 * k1 + squared * (5 * k2 + squared * (7 * k3 + squared * 9 * k4)))
        return slope

    def angle_from_radius(self, radii: ArrayLike) -> FloatArray:
        """Return θ, (...,), by Newton's method within the field of view; NaN for radii beyond it."""
        wanted = np.asarray(radii, dtype=np.float64)
        outermost = float(self.radius_from_angle(self.max_angle_rad))
        inside = (wanted >= 0) & (wanted <= outermost * (1 + 1e-12))
        target = np.where(inside, wanted, 0.0)
        low, high = np.zeros_like(target), np.full_like(target, self.max_angle_rad)
        angles = np.minimum(target / outermost, 1.0) * self.max_angle_rad
        for _ in range(_ITERATIONS):
            excess = self.radius_from_angle(angles) - target
            high, low = np.where(excess > 0, angles, high), np.where(excess > 0, low, angles)
            steps = excess / self.radius_slope(angles)
            # A step that leaves the bracket becomes a bisection.
            newton = angles - steps
            angles = np.where((newton >= low) & (newton <= high), newton, (low + high) / 2)
            if np.abs(steps).max(initial=0.0) < _EXACT:
                break
        return np.where(inside, angles, np.nan)

    def pixel_from_ray(self, rays_in_lens: ArrayLike) -> FloatArray:
        """Return the pixels (..., 2) of rays (..., 3) of any length; NaN beyond the field of view.

        Pixels outside of the picture's borders are returned as they are; see `contains`.
        """
        rays = np.asarray(rays_in_lens, dtype=np.float64)
        across = np.hypot(rays[..., 0], rays[..., 1])
        angles = np.arctan2(across, rays[..., 2])
        seen = angles <= self.max_angle_rad * (1 + 1e-12)
        # d(θ) / sin θ, which is 1 on the axis.
        factor = self.radius_from_angle(angles) / np.where(across > 0, across, 1.0)
        factor = np.where(seen, factor, np.nan)
        plane = rays[..., :2] * factor[..., None]
        pixels: FloatArray = plane * np.array(self.focal_xy) + np.array(self.principal_xy)
        return pixels

    def ray_from_pixel(self, pixels_px: ArrayLike) -> FloatArray:
        """Return the unit rays (..., 3) in the lens's frame of pixels (..., 2); NaN beyond the field of view."""
        plane = (np.asarray(pixels_px, dtype=np.float64) - np.array(self.principal_xy)) / np.array(self.focal_xy)
        radii = np.hypot(plane[..., 0], plane[..., 1])
        angles = self.angle_from_radius(radii)
        factor = np.where(
            radii > 0, np.sin(angles) / np.where(radii > 0, radii, 1.0), np.where(np.isnan(angles), angles, 1.0)
        )
        return np.concatenate([plane * factor[..., None], np.cos(angles)[..., None]], axis=-1)

    def angle_from_axis(self, rays_in_lens: ArrayLike) -> FloatArray:
        """Return the angle of rays (..., 3) from the axis, (...,), in radians."""
        rays = np.asarray(rays_in_lens, dtype=np.float64)
        angles: FloatArray = np.arctan2(np.hypot(rays[..., 0], rays[..., 1]), rays[..., 2])
        return angles

    def contains(self, pixels_px: ArrayLike) -> NDArray[np.bool_]:
        """Return which pixels (..., 2) lie inside the picture, (...,); NaN does not."""
        pixels = np.asarray(pixels_px, dtype=np.float64)
        return np.asarray(((pixels >= 0) & (pixels <= np.array(self.size_hw[::-1]))).all(axis=-1))
