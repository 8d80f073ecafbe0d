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
from pano_mvs.geometry.fisheye import FisheyeLens
from pano_mvs.geometry.transforms import Rigid3


@dataclass(frozen=True, slots=True, eq=False)
class LensRig:
    """Two fisheye lenses that are fixed to each other, and the distance at which they are stitched.

    Attributes:
        names: names of the lenses.
        lenses: the lenses.
        lens_from_rig: pose of each lens, in metres; the mean of their centres is the origin of the rig.
        stitch_distance_m: D, may be inf.
        blend_deg: width of the strip around the seam in which the panorama mixes both pictures.
    """

    names: tuple[str, str]
    lenses: tuple[FisheyeLens, FisheyeLens]
    lens_from_rig: tuple[Rigid3, Rigid3]
    stitch_distance_m: float = float("inf")
    blend_deg: float = 2.0

    @staticmethod
    def centred(
        names: tuple[str, str],
        lenses: tuple[FisheyeLens, FisheyeLens],
        lens_from_body: tuple[Rigid3, Rigid3],
        *,
        stitch_distance_m: float = float("inf"),
        blend_deg: float = 2.0,
    ) -> LensRig:
        """Return the rig whose frame has the axes of a body frame, and its origin between the lenses.

        Raises:
            UsageError: if the stitching distance is not greater than the distance of a lens from the origin.
        """
        middle = np.mean([pose.center for pose in lens_from_body], axis=0)
        body_from_rig = Rigid3(np.eye(3), middle)
        first, second = (pose @ body_from_rig for pose in lens_from_body)
        rig = LensRig(names, lenses, (first, second), stitch_distance_m, blend_deg)
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
        """Return the bearings (..., 3) at which the panorama shows rays of its lenses: `rays_from_bearings`, inverted.

        Args:
            origins: (..., 3) the lens centres, in metres.
            directions: (..., 3) unit.
        """
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
        return {"lenses": lenses, "stitch_distance_m": distance, "blend_deg": self.blend_deg}

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
        )
