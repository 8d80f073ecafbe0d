"""From the world of a run to the coordinates of a survey (z up), on a map where GPS says where it is."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from pano_mvs.api import Poses, UsageError, lla_from_local, world_up, z_up_from_world
from pyproj import CRS, Transformer
from pyproj.exceptions import CRSError

FloatArray = NDArray[np.float64]

_WGS84_3D = 4979


@dataclass(frozen=True)
class Placement:
    """How points and directions of the world are written.

    Attributes:
        origin_lla: latitude, longitude (degrees) and altitude (m) of the world's origin; None: not known.
        crs: of the written coordinates; None: they are the world's own, turned so that z is up.
        file_from_world: that turn, (3, 3): x east, y north, z up from x east, y down, z north on a map.
    """

    origin_lla: tuple[float, float, float] | None = None
    crs: CRS | None = None
    file_from_world: FloatArray = field(default_factory=z_up_from_world)

    def points(self, points_in_world: NDArray[np.floating]) -> FloatArray:
        """Return points (N, 3) as coordinates of the file."""
        world = points_in_world.astype(np.float64)
        if self.crs is None or self.origin_lla is None:
            return np.asarray(world @ self.file_from_world.T)
        latitude, longitude, altitude = lla_from_local(world, self.origin_lla).T
        return np.stack(self._on_map.transform(longitude, latitude, altitude), axis=-1)

    def directions(self, directions_in_world: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return unit vectors (N, 3) along east, north and up, which a map's axes differ from by a degree or two."""
        turned: NDArray[np.float32] = directions_in_world @ self.file_from_world.T.astype(np.float32)
        return turned

    def rotation_at(self, point_in_world: FloatArray) -> FloatArray:
        """Return the rotation (3, 3) that the written coordinates of the surroundings of a point have.

        On a map it includes the angle between its north and the true one; without a map it is `file_from_world`.
        """
        steps = np.concatenate([np.eye(3), -np.eye(3)])
        moved = self.points(point_in_world + steps)
        left, _, right = np.linalg.svd((moved[:3] - moved[3:]).T)
        return np.asarray(left @ right)

    @cached_property
    def _on_map(self) -> Transformer:
        return Transformer.from_crs(_WGS84_3D, self.crs, always_xy=True)


def placement_of(poses: Poses, epsg: int | None) -> Placement:
    """Return how a world is written: on the map of `epsg`, or of the UTM zone, if GPS says where its origin is.

    Heights are those of the GPS, above the ellipsoid.

    Args:
        poses: of the run; those of `poses.scale` with `align: gps` know their place.
        epsg: code of a projected coordinate system in metres; None: WGS 84 / UTM; 0: no map, as if there were no GPS.

    Raises:
        UsageError: if a map is asked for and the place is not known, or there is no such map.
    """
    origin = poses.origin_lla
    if epsg == 0 or (origin is None and epsg is None):
        return Placement(origin, file_from_world=z_up_from_world(world_up(poses)))
    if origin is None:
        raise UsageError(
            f"epsg: {epsg} needs cameras that GPS has placed: a stage poses.scale with `gps: true` and "
            "`align: gps` before"
        )
    try:
        crs = CRS.from_epsg(_utm_epsg(origin[0], origin[1]) if epsg is None else epsg)
    except CRSError as error:
        raise UsageError(f"epsg: {epsg} is not a coordinate system that PROJ knows") from error
    if not crs.is_projected:
        raise UsageError(
            f"epsg: {epsg} ({crs.name}) is not projected: its unit is not a length. Take a map's, such as "
            f"{_utm_epsg(origin[0], origin[1])}"
        )
    return Placement(origin, crs)


def _utm_epsg(latitude_deg: float, longitude_deg: float) -> int:
    """Return the code of the zone of WGS 84 / UTM; the exceptions around Norway and Svalbard are left out."""
    zone = int((longitude_deg + 180) // 6) % 60 + 1
    return (32600 if latitude_deg >= 0 else 32700) + zone
