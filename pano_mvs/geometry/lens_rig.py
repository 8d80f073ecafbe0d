"""A rig of two fisheye lenses, and the panorama that is stitched from them.

Frames
    rig         the camera frame of the panorama. Its origin is the mean of the two lens centres.
    lens        x right, y down, z along the axis of the lens.

A pixel of the panorama with the bearing b shows what one of the lenses sees at the point D b of the rig's frame, where
D is the stitching distance. The ray of that pixel therefore starts at the centre c of its lens and goes through D b;
for an infinite D, it is parallel to b. A surface at the range r appears shifted by up to about |c| |1/r − 1/D| radians.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry.transforms import Rigid3


@dataclass(frozen=True, slots=True)
class FisheyeLens:
    """A lens of the Kannala–Brandt model with its picture."""

    size_hw: tuple[int, int]  # (height, width) of the picture
    focal_xy: tuple[float, float]  # (fx, fy) in pixels per radian at the axis
    principal_xy: tuple[float, float]  # (cx, cy), the pixel of the axis; (0, 0) is the upper-left corner of the picture
    distortion: tuple[float, float, float, float]  # k1, k2, k3, k4
    max_angle_rad: float  # largest angle from the axis that the lens sees, half of its field of view

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
        for _ in range(20):
            excess = self.radius_from_angle(angles) - target
            high, low = np.where(excess > 0, angles, high), np.where(excess > 0, low, angles)
            steps = excess / self.radius_slope(angles)
            # A step that leaves the bracket becomes a bisection.
            newton = angles - steps
            angles = np.where((newton >= low) & (newton <= high), newton, (low + high) / 2)
            if np.abs(steps).max(initial=0.0) < 1e-14:
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


@dataclass(frozen=True, slots=True, eq=False)
class LensRig:
    """Two fisheye lenses that are fixed to each other, and the distance at which they are stitched."""

    names: tuple[str, str]
    lenses: tuple[FisheyeLens, FisheyeLens]
    # pose of each lens, in metres; the mean of their centres is the origin of the rig
    lens_from_rig: tuple[Rigid3, Rigid3]
    stitch_distance_m: float = float("inf")  # D, may be inf
    blend_deg: float = 2.0  # width of the strip around the seam in which the panorama mixes both pictures
    metric: bool = True  # whether the distance between the lenses was measured; if not, only its direction is known

    @staticmethod
    def centred(
        names: tuple[str, str],
        lenses: tuple[FisheyeLens, FisheyeLens],
        lens_from_body: tuple[Rigid3, Rigid3],
        *,
        stitch_distance_m: float = float("inf"),
        blend_deg: float = 2.0,
        metric: bool = True,
    ) -> LensRig:
        """Return the rig whose frame has the axes of a body frame, and its origin between the lenses.

        Raises:
            UsageError: if the stitching distance is not greater than the distance of a lens from the origin.
        """
        middle = np.mean([pose.center for pose in lens_from_body], axis=0)
        body_from_rig = Rigid3(np.eye(3), middle)
        first, second = (pose @ body_from_rig for pose in lens_from_body)
        rig = LensRig(names, lenses, (first, second), stitch_distance_m, blend_deg, metric)
        if stitch_distance_m <= 2 * rig.lens_offset_m:
            raise UsageError(
                f"the stitching distance of {stitch_distance_m:g} m is not outside of the rig, whose lens centres are "
                f"{2 * rig.lens_offset_m:g} m apart"
            )
        return rig

    @property
    def centers(self) -> FloatArray:
        """The lens centres in the rig's frame, (2, 3), in metres."""
        return np.array([pose.center for pose in self.lens_from_rig])

    @property
    def lens_offset_m(self) -> float:
        """Distance of a lens centre from the origin of the rig: half of the distance between the lenses."""
        return float(np.linalg.norm(self.centers[0]))

    def points_in_lens(self, bearings: ArrayLike, lens_idx: int) -> FloatArray:
        """Return the rays (..., 3) of a lens, of any length, along which the panorama shows it at bearings (..., 3)."""
        rays = np.asarray(bearings, dtype=np.float64)
        pose = self.lens_from_rig[lens_idx]
        seen: FloatArray = rays @ pose.rotation.T + pose.translation / self.stitch_distance_m
        return seen

    def margins_rad(self, bearings: ArrayLike) -> FloatArray:
        """Return how far bearings (..., 3) are inside the field of view of each lens, (..., 2); −inf if not seen.

        A direction is not seen by a lens either if it is beyond its field of view, or beyond the border of its picture.
        """
        margins = []
        for idx, lens in enumerate(self.lenses):
            rays = self.points_in_lens(bearings, idx)
            margin = lens.max_angle_rad - lens.angle_from_axis(rays)
            margins.append(np.where(lens.contains(lens.pixel_from_ray(rays)), margin, -np.inf))
        return np.stack(margins, axis=-1)

    def angle_from_seam(self, bearings: ArrayLike) -> FloatArray:
        """Return the angle of bearings (..., 3) from the seam, (...,), in radians; inf where one lens or none sees."""
        margins = self.margins_rad(bearings)
        seen = np.isfinite(margins)
        first, second = np.moveaxis(np.where(seen, margins, 0.0), -1, 0)
        apart = np.abs(first - second)
        return np.where(
            seen[..., 0] & seen[..., 1], apart / 2, np.inf
        )  # away from the seam, one margin grows as the other shrinks

    def lens_of_bearings(self, bearings: ArrayLike) -> NDArray[np.int8]:
        """Return the lens that the panorama shows at bearings (..., 3): 0 or 1, or −1 where no lens sees.

        It is the lens in whose field of view the direction lies further inside.
        """
        margins = self.margins_rad(bearings)
        label = np.where(margins[..., 1] > margins[..., 0], np.int8(1), np.int8(0))
        return np.where(np.isfinite(margins).any(axis=-1), label, np.int8(-1)).astype(np.int8)

    def rays_from_bearings(self, bearings: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return the true rays of bearings (..., 3) of the panorama, in the rig's frame.

        Returns:
            origins (..., 3) in metres, the lens centres, and unit directions (..., 3). A direction that no lens sees
            starts at the rig's origin.
        """
        rays = np.asarray(bearings, dtype=np.float64)
        centers = np.concatenate([self.centers, np.zeros((1, 3))])  # the last for the label −1
        origins = centers[self.lens_of_bearings(rays)]
        directions = rays - origins / self.stitch_distance_m
        directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
        return origins, directions

    def bearings_from_rays(self, origins: ArrayLike, directions: ArrayLike) -> FloatArray:
        """Return the bearings (..., 3) at which the panorama shows rays of its lenses; inverts `rays_from_bearings`."""
        rays = np.asarray(directions, dtype=np.float64)
        start = np.asarray(origins, dtype=np.float64) / self.stitch_distance_m
        along = np.sum(start * rays, axis=-1, keepdims=True)
        length = np.sqrt(along**2 + 1 - np.sum(start**2, axis=-1, keepdims=True)) - along
        bearings: FloatArray = start + length * rays
        return bearings

    def to_values(self) -> dict[str, Any]:
        """Return the rig as JSON values, without loss of precision."""
        lenses = [
            {
                "name": name,
                "size_hw": list(lens.size_hw),
                "focal_xy": list(lens.focal_xy),
                "principal_xy": list(lens.principal_xy),
                "distortion": list(lens.distortion),
                "max_angle_rad": lens.max_angle_rad,
                "rotation": pose.rotation.tolist(),
                "translation": pose.translation.tolist(),
            }
            for name, lens, pose in zip(self.names, self.lenses, self.lens_from_rig, strict=True)
        ]
        distance = None if np.isinf(self.stitch_distance_m) else self.stitch_distance_m
        values = {"lenses": lenses, "stitch_distance_m": distance, "blend_deg": self.blend_deg}
        return values if self.metric else values | {"metric": False}

    @classmethod
    def from_values(cls, values: dict[str, Any]) -> Self:
        """Return the rig from the result of `to_values`."""
        lenses = [
            FisheyeLens(
                tuple(given["size_hw"]),
                tuple(given["focal_xy"]),
                tuple(given["principal_xy"]),
                tuple(given["distortion"]),
                given["max_angle_rad"],
            )
            for given in values["lenses"]
        ]
        poses = [Rigid3(np.array(given["rotation"]), np.array(given["translation"])) for given in values["lenses"]]
        distance = values["stitch_distance_m"]
        return cls(
            (values["lenses"][0]["name"], values["lenses"][1]["name"]),
            (lenses[0], lenses[1]),
            (poses[0], poses[1]),
            float("inf") if distance is None else distance,
            values["blend_deg"],
            values.get("metric", True),
        )
