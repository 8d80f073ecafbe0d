"""Convert positions on the Earth to coordinates in a local frame, and back.

WGS 84 (NIMA TR8350.2): semi-major axis and flattening of the ellipsoid. The local frame follows the camera convention:
x east, y DOWN, z north, right-handed.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from pano_mvs.core.arrays import FloatArray

_SEMI_MAJOR_M = 6378137.0
_FLATTENING = 1 / 298.257223563
_ECCENTRICITY_SQ = _FLATTENING * (2 - _FLATTENING)


def local_from_lla(position_lla: ArrayLike, origin_lla: ArrayLike) -> FloatArray:
    """Return (latitude deg, longitude deg, altitude m), (..., 3), as (east, down, north) metres from an origin (3,)."""
    difference = earth_from_lla(position_lla) - earth_from_lla(origin_lla)
    return difference @ earth_from_local(origin_lla)


def lla_from_local(position_in_local: ArrayLike, origin_lla: ArrayLike) -> FloatArray:
    """Return the inverse of `local_from_lla`, (..., 3), to a micrometre.

    The latitude is found by fixed-point iteration (Heiskanen and Moritz, "Physical Geodesy", 1967, section 5-3).

    >>> lla_from_local([0.0, 0.0, 1000.0], (48.0, 11.0, 500.0)).round(3).tolist()  # 1 km to the north
    [48.009, 11.0, 500.078]
    """
    offset = np.asarray(position_in_local, dtype=np.float64) @ earth_from_local(origin_lla).T
    x, y, z = np.moveaxis(earth_from_lla(origin_lla) + offset, -1, 0)
    across = np.hypot(x, y)
    latitude = np.arctan2(z, across * (1 - _ECCENTRICITY_SQ))
    for _ in range(6):
        latitude = np.arctan2(z + _ECCENTRICITY_SQ * _normal_radius_m(latitude) * np.sin(latitude), across)
    sine, cosine = np.sin(latitude), np.cos(latitude)
    altitude = across * cosine + z * sine - _normal_radius_m(latitude) * (1 - _ECCENTRICITY_SQ * sine**2)
    return np.stack([np.rad2deg(latitude), np.rad2deg(np.arctan2(y, x)), altitude], axis=-1)


def _normal_radius_m(latitude_rad: FloatArray) -> FloatArray:
    """Return the radius of curvature in the prime vertical."""
    radius: FloatArray = _SEMI_MAJOR_M / np.sqrt(1 - _ECCENTRICITY_SQ * np.sin(latitude_rad) ** 2)
    return radius


def earth_from_lla(position_lla: ArrayLike) -> FloatArray:
    """Return Earth-centred, Earth-fixed coordinates in metres, (..., 3)."""
    latitude, longitude, altitude = np.moveaxis(np.asarray(position_lla, dtype=np.float64), -1, 0)
    latitude, longitude = np.deg2rad(latitude), np.deg2rad(longitude)
    radius = _normal_radius_m(latitude)
    across = (radius + altitude) * np.cos(latitude)
    height = (radius * (1 - _ECCENTRICITY_SQ) + altitude) * np.sin(latitude)
    return np.stack([across * np.cos(longitude), across * np.sin(longitude), height], axis=-1)


def earth_from_local(origin_lla: ArrayLike) -> FloatArray:
    """Return the rotation (3, 3) whose columns are the east, down and north directions at a position."""
    latitude, longitude = np.deg2rad(np.asarray(origin_lla, dtype=np.float64)[:2])
    sin_lat, cos_lat, sin_lon, cos_lon = np.sin(latitude), np.cos(latitude), np.sin(longitude), np.cos(longitude)
    east = [-sin_lon, cos_lon, 0.0]
    down = [-cos_lat * cos_lon, -cos_lat * sin_lon, -sin_lat]
    north = [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat]
    return np.array([east, down, north]).T
