"""Compiled: how clear the edges of walls around a view are."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.kernels import kernel


@kernel
def edge_clarities(
    differences: NDArray[np.float32],
    distances: FloatArray,
    heights: FloatArray,
    apart_rad: float,
    half_window: int,
    full_levels: float,
    clarities: NDArray[np.float32],
) -> None:
    """Write how clear edges of walls are, (K, L, A), from 0 to 1; 0 where a wall is not seen.

    Args:
        differences: (E, A, 3) differences of colours, from the nadir to the zenith.
        distances: (L, A) level distances of walls, NaN where they are not seen.
        heights: (K,) of edges above the camera.
        apart_rad: least angle from the first edge at which another one counts.
        half_window: azimuths to either side over which colours are averaged, fewer than half of all.
        full_levels: a difference of colours that could not be clearer.
        clarities: the square roots of the shares of this difference.
    """
    count, window = differences.shape[1], 2 * half_window + 1
    last, step = len(differences) - 2, math.pi / (len(differences) - 1)
    first_edge, seen = np.empty(count), np.empty((count + 2 * half_window, 3))
    for wall in range(len(distances)):
        for azimuth in range(count):
            first_edge[azimuth] = math.atan2(heights[0], distances[wall, azimuth])  # NaN if the wall is not seen
        for idx in range(len(heights)):
            for azimuth in range(count):
                to = azimuth + half_window
                elevation = first_edge[azimuth]
                if idx > 0 and math.isfinite(elevation):
                    elevation = math.atan2(heights[idx], distances[wall, azimuth])
                if not math.isfinite(elevation) or (idx > 0 and abs(elevation - first_edge[azimuth]) <= apart_rad):
                    seen[to, 0] = seen[to, 1] = seen[to, 2] = 0.0
                    continue
                place = (elevation + math.pi / 2) / step
                below = min(max(int(place), 0), last)
                part = place - below
                for channel in range(3):
                    lower, upper = differences[below, azimuth, channel], differences[below + 1, azimuth, channel]
                    seen[to, channel] = lower * (1 - part) + upper * part
            for k in range(half_window):
                for channel in range(3):
                    seen[k, channel] = seen[count + k, channel]
                    seen[count + half_window + k, channel] = seen[half_window + k, channel]
            red, green, blue = 0.0, 0.0, 0.0
            for k in range(len(seen)):
                red, green, blue = red + seen[k, 0], green + seen[k, 1], blue + seen[k, 2]
                azimuth = k - window + 1
                if azimuth >= 0:
                    size = math.sqrt(red * red + green * green + blue * blue) / window
                    clarities[idx, wall, azimuth] = math.sqrt(min(size / full_levels, 1.0))
                    red, green, blue = red - seen[azimuth, 0], green - seen[azimuth, 1], blue - seen[azimuth, 2]
