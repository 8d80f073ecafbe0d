"""Compiled: the equirectangular camera for single pixels and rays, for use in other kernels.

The conventions are those of `pano_mvs.geometry`, the arithmetic that of `sphere` and `resample`. All functions but
`fill_positions` take and return plain numbers and are inlined where they are called. The `fast_` functions are for
float32 in vectorised loops, the `even_` functions for float64 in vectorised loops.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.kernels import inlined, kernel

_F = np.float32
_HALF_PI, _TINY = _F(np.pi / 2), _F(1e-30)
_BLOCK = 256


@inlined
def azimuth_from_x(x: float, width: int) -> float:
    """Return the azimuth θ of a column position, in radians."""
    return 2 * math.pi * (x / width - 0.5)


@inlined
def elevation_from_y(y: float, height: int) -> float:
    """Return the elevation φ of a row position, in radians."""
    return math.pi * (0.5 - y / height)


@inlined
def pixel_from_ray(x: float, y: float, z: float, height: int, width: int) -> tuple[float, float]:
    """Return the position (x, y) in pixels of a ray of any length but zero, x in [0, w], y in [0, h]."""
    azimuth = math.atan2(x, z)
    elevation = math.atan2(-y, math.sqrt(x * x + z * z))  # hypot costs as much as an arc tangent
    return (azimuth / (2 * math.pi) + 0.5) * width, (0.5 - elevation / math.pi) * height


@inlined
def pixel_at(x: float, y: float, height: int, width: int) -> tuple[int, int]:
    """Return (row, column) of the pixel that contains a position; x wraps, y is clipped."""
    return min(max(math.floor(y), 0), height - 1), math.floor(x) % width


@inlined
def wrapped_row(row: int, height: int) -> int:
    """Return the row, in the panorama, of a pixel at most one height outside of it: reflected at the poles."""
    if row < 0:
        return -1 - row
    if row >= height:
        return 2 * height - 1 - row
    return row


@inlined
def wrapped_column(row: int, column: int, height: int, width: int) -> int:
    """Return the column, in the panorama, of a pixel: wrapped at the seam, half a turn further beyond a pole."""
    if row < 0 or row >= height:
        column += width // 2
    return column % width


@inlined
def corners_at(x: float, y: float, height: int, width: int) -> tuple[int, int, int, int, int, int, float, float]:
    """Return the four pixels around a position, and the weights of the right and of the lower ones.

    Returns:
        upper row, lower row, columns of the upper left, upper right, lower left and lower right pixel, weight_x,
        weight_y.
    """
    left, top = math.floor(x - 0.5), math.floor(y - 0.5)
    return (
        wrapped_row(top, height),
        wrapped_row(top + 1, height),
        wrapped_column(top, left, height, width),
        wrapped_column(top, left + 1, height, width),
        wrapped_column(top + 1, left, height, width),
        wrapped_column(top + 1, left + 1, height, width),
        x - 0.5 - left,
        y - 0.5 - top,
    )


@inlined
def bilinear(v00: float, v01: float, v10: float, v11: float, weight_x: float, weight_y: float) -> float:
    """Return the bilinear mean of values upper left, upper right, lower left and lower right."""
    upper = (1 - weight_x) * v00 + weight_x * v01
    lower = (1 - weight_x) * v10 + weight_x * v11
    return (1 - weight_y) * upper + weight_y * lower


@inlined
def angle_between(ax: float, ay: float, az: float, bx: float, by: float, bz: float) -> float:
    """Return the angle between two vectors, in radians in [0, π], by atan2(|a × b|, a · b)."""
    x, y, z = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    return math.atan2(math.sqrt(x * x + y * y + z * z), ax * bx + ay * by + az * bz)


@inlined
def _fast_atan(a: np.float32) -> np.float32:
    """Return atan of a float32 in [0, 1]."""
    # Abramowitz and Stegun, Handbook of Mathematical Functions, 4.4.49: |error| ≤ 2e-8 on [0, 1].
    s = a * a
    tail = _F(-0.0752896400) + s * (_F(0.0429096138) + s * (_F(-0.0161657367) + s * _F(0.0028662257)))
    tail = _F(-0.1420889944) + s * (_F(0.1065626393) + s * tail)
    return a * (_F(1) + s * (_F(-0.3333314528) + s * (_F(0.1999355085) + s * tail)))


@inlined
def fast_azimuth(x: np.float32, z: np.float32) -> np.float32:
    """Return atan2(x, z), the azimuth, float32."""
    ax, az = abs(x), abs(z)
    small = ax if ax < az else az
    large = az if ax < az else ax
    turn: np.float32 = _fast_atan(small / (large + _TINY))
    turn = _HALF_PI - turn if ax > az else turn
    turn = _F(np.pi) - turn if z < _F(0) else turn
    return -turn if x < _F(0) else turn


@inlined
def fast_dip(y: np.float32, level: np.float32) -> np.float32:
    """Return atan2(y, level), the angle below the horizon, for level = hypot(x, z), float32."""
    ay = abs(y)
    small = ay if ay < level else level
    large = level if ay < level else ay
    dip: np.float32 = _fast_atan(small / (large + _TINY))
    dip = _HALF_PI - dip if ay > level else dip
    return -dip if y < _F(0) else dip


@inlined
def even_atan2(y: float, x: float) -> float:
    """Return atan2(y, x) in float64, without branches; 0 for (0, 0)."""
    ay, ax = abs(y), abs(x)
    small = ay if ay < ax else ax
    large = ax if ay < ax else ay
    # atan(a) = π/4 + atan((a − 1) / (a + 1))
    reduced = small > 0.66 * large
    above = small - large if reduced else small
    below = small + large if reduced else large
    a = above / (below + 1e-300)
    s = a * a
    # S. L. Moshier's Cephes library, atan.c: |error| ≤ 2e-16 on [-0.66, 0.66].
    p = (-8.750608600031904122785e-1 * s - 1.615753718733365076637e1) * s - 7.500855792314704667340e1
    p = (p * s - 1.228866684490136173410e2) * s - 6.485021904942025371773e1
    q = ((s + 2.485846490142306297962e1) * s + 1.650270098316988542046e2) * s + 4.328810604912902668951e2
    q = (q * s + 4.853903996359136964868e2) * s + 1.945506571482613964425e2
    angle = a + a * (s * p / q)
    angle = angle + math.pi / 4 if reduced else angle
    angle = math.pi / 2 - angle if ay > ax else angle
    angle = math.pi - angle if x < 0 else angle
    return -angle if y < 0 else angle


@inlined
def _write_positions(
    block: NDArray[np.float64], size: tuple[int, int], shift: float, positions: NDArray[np.float32]
) -> None:
    """Write the positions (N, 2) of rays, whose components are the rows of `block`, which changes."""
    for n in range(len(positions)):
        x, y, z = block[0, n], block[1, n], block[2, n]
        block[0, n] = (even_atan2(x, z) / (2 * math.pi) + 0.5) * size[1] + shift
        block[1, n] = (0.5 - even_atan2(-y, math.sqrt(x * x + z * z)) / math.pi) * size[0] + shift
    for n in range(len(positions)):
        positions[n, 0] = block[0, n]
        positions[n, 1] = block[1, n]


@kernel
def fill_positions(
    rays: NDArray[np.float64], size: tuple[int, int], shift: float, positions: NDArray[np.float32]
) -> None:
    """Write the position in pixels of each ray (N, 3), (N, 2), plus `shift`, as `pixel_from_ray` of `sphere` does."""
    block = np.empty((3, _BLOCK))  # loops over arrays of one component are vectorised
    for start in range(0, len(rays), _BLOCK):
        count = min(_BLOCK, len(rays) - start)
        for n in range(count):
            for axis in range(3):
                block[axis, n] = rays[start + n, axis]
        _write_positions(block, size, shift, positions[start : start + count])


@kernel
def fill_view_positions(
    plane: tuple[NDArray[np.float64], NDArray[np.float64]],
    view_from_cam: NDArray[np.float64],
    size: tuple[int, int],
    shift: float,
    positions: NDArray[np.float32],
) -> None:
    """Write the positions (h, w, 2) of the rays (x, y, 1) of a pinhole view, x and y the vectors of `plane`."""
    columns, rows = plane
    block = np.empty((3, len(columns)))
    for row in range(len(rows)):
        for axis in range(3):
            ahead = rows[row] * view_from_cam[1, axis] + view_from_cam[2, axis]
            for n in range(len(columns)):
                block[axis, n] = columns[n] * view_from_cam[0, axis] + ahead
        _write_positions(block, size, shift, positions[row])
