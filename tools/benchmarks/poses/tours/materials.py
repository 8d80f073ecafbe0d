"""Procedural materials of rendered houses: what colour a point of a surface has.

Coordinates on a surface are metres from its corner. Patterns finer than the footprint of a pixel are left out, so that
four rays a pixel suffice.
"""

from __future__ import annotations

import numpy as np
from numba import njit

PLAIN, PLASTER, PLANKS, TILES, CARPET, WOOD, FABRIC, POSTER, BOOKS, PANELS, STONE, LEAVES = range(12)
LAMP, MIRROR, PANE, SCREEN = range(12, 16)


@njit(nogil=True, error_model="numpy", inline="always")
def hashed(x, y, seed):  # type: ignore[no-untyped-def]
    """Return an even number in [0, 1) for a lattice point."""
    h = (x * 374761393 + y * 668265263 + seed * 2147483647 + 1013904223) & 0xFFFFFFFF
    h = ((h ^ (h >> 13)) * 1274126177) & 0xFFFFFFFF
    h = ((h ^ (h >> 16)) * 2246822519) & 0xFFFFFFFF
    return ((h ^ (h >> 15)) & 0xFFFFFF) / 16777216.0


@njit(nogil=True, error_model="numpy")
def noise(u, v, seed):  # type: ignore[no-untyped-def]
    """Return smooth noise in [0, 1) with a wavelength of 1."""
    i, j = int(np.floor(u)), int(np.floor(v))
    a, b = u - i, v - j
    a, b = a * a * (3 - 2 * a), b * b * (3 - 2 * b)
    low = hashed(i, j, seed) * (1 - a) + hashed(i + 1, j, seed) * a
    high = hashed(i, j + 1, seed) * (1 - a) + hashed(i + 1, j + 1, seed) * a
    return low * (1 - b) + high * b


@njit(nogil=True, error_model="numpy")
def fractal(u, v, wavelength, seed, octaves, footprint):  # type: ignore[no-untyped-def]
    """Return noise in about [−1, 1] of several octaves, without those that a pixel cannot show."""
    total, weight = 0.0, 1.0
    for octave in range(octaves):
        visible = min(max(0.5 * wavelength / footprint - 0.5, 0.0), 1.0)
        if visible == 0.0:
            break
        total += visible * weight * (2 * noise(u / wavelength, v / wavelength, seed + octave) - 1)
        wavelength, weight = 0.5 * wavelength, 0.65 * weight
    return total


@njit(nogil=True, error_model="numpy")
def line(distance, width, footprint):  # type: ignore[no-untyped-def]
    """Return how much of a pixel a line covers, from the distance to its middle."""
    cover = min(1.0, width / footprint)
    return cover * min(max((0.5 * (width + footprint) - abs(distance)) / footprint, 0.0), 1.0)


@njit(nogil=True, error_model="numpy")
def _factor(material, u, v, wide, high, seed, footprint):  # type: ignore[no-untyped-def]
    """Return the brightness of a material of a single colour."""
    if material == PLASTER:
        return 1 + 0.012 * fractal(u, v, 1.5, seed, 4, footprint) + 0.008 * fractal(u, v, 0.01, seed + 9, 2, footprint)
    if material == PLANKS:
        row = int(np.floor(v / 0.14))
        along = u / 1.3 + hashed(row, 0, seed)
        plank = int(np.floor(along))
        grain = fractal(0.12 * u + 7 * hashed(row, plank, seed + 1), v, 0.03, seed + 2, 3, footprint)
        gap = max(line(v - 0.14 * row, 0.004, footprint), line((along - plank) * 1.3, 0.004, footprint))
        return (0.8 + 0.4 * hashed(row, plank, seed) + 0.12 * grain) * (1 - 0.6 * gap)
    if material == TILES:
        size = 0.3 if seed % 2 else 0.6
        i, j = int(np.floor(u / size)), int(np.floor(v / size))
        gap = max(line(u - size * i, 0.006, footprint), line(v - size * j, 0.006, footprint))
        veins = fractal(u + 13 * hashed(i, j, seed), v, 0.25, seed + 3, 5, footprint)
        return (0.97 + 0.06 * hashed(i, j, seed + 1) + 0.05 * veins) * (1 - 0.35 * gap)
    if material == CARPET:
        return 1 + 0.2 * fractal(u, v, 0.04, seed, 3, footprint) + 0.05 * fractal(u, v, 0.8, seed + 5, 3, footprint)
    if material == WOOD:
        return 1 + 0.16 * fractal(0.12 * u, v, 0.06, seed, 4, footprint)
    if material == FABRIC:
        return 1 + 0.08 * fractal(u, v, 0.03, seed, 3, footprint) + 0.06 * fractal(u, v, 0.4, seed + 4, 3, footprint)
    if material == STONE:
        return 1 + 0.35 * fractal(u, v, 0.05, seed, 4, footprint)
    if material == LEAVES:
        return 1 + 0.6 * fractal(u, v, 0.08, seed, 3, footprint)
    if material == PANELS:
        inset = min(min(u, wide - u), min(min(v, high - v), abs(v - 0.55 * high)))
        handle = 1.0 if abs(u - 0.92 * wide) < 0.02 and abs(v - 0.5 * high) < 0.06 else 0.0
        return (1 - 0.35 * line(inset - 0.1, 0.012, footprint)) * (1 - 0.7 * handle)
    return 1.0


@njit(nogil=True, error_model="numpy")
def _hue(number, red, green, blue):  # type: ignore[no-untyped-def]
    """Return a colour drawn by an even number, mixed with another."""
    return (
        0.25 * red + 0.7 * abs(np.sin(9.1 * number)),
        0.25 * green + 0.7 * abs(np.sin(17.3 * number + 1)),
        0.25 * blue + 0.7 * abs(np.sin(27.7 * number + 2)),
    )


@njit(nogil=True, error_model="numpy")
def albedo(material, color, place, size, seed, footprint):  # type: ignore[no-untyped-def]
    """Return the colour of a point of a surface.

    Args:
        material: one of the constants of this module.
        color: (3,) colour of the material.
        place: the point in metres from the corner of the surface.
        size: width and height of the surface in metres.
        seed: seed of the pattern.
        footprint: size of a pixel on the surface in metres.
    """
    u, v = place
    wide, high = size
    red, green, blue = color[0], color[1], color[2]
    if material == POSTER:
        edge = min(min(u, wide - u), min(v, high - v))
        if edge < 0.03:
            return 0.12, 0.1, 0.09
        tone = fractal(u, v, 0.3, seed, 5, footprint)
        red, green, blue = _hue(hashed(seed, 0, 5), red, green, blue)
        red, green, blue = red * (1 + 0.3 * tone), green * (1 + 0.2 * tone), blue * (1 + 0.25 * tone)
        for shape in range(9):
            x, y = hashed(shape, 1, seed) * wide, hashed(shape, 2, seed) * high
            radius = (0.05 + 0.16 * hashed(shape, 3, seed)) * wide
            reach = max(abs(u - x), 1.6 * abs(v - y)) if shape % 2 else np.hypot(u - x, v - y)
            if reach < radius:
                red, green, blue = _hue(hashed(shape, 4, seed), 0.5, 0.5, 0.5)
        return red, green, blue
    if material == BOOKS:
        row = int(np.floor(v / 0.34))
        volume = int(np.floor(u / 0.035))
        top = 0.2 + 0.1 * hashed(volume, row, seed + 1)
        above = v - 0.34 * row
        if above < 0.025:
            return 0.45, 0.33, 0.22
        if above > top:
            return 0.08, 0.07, 0.06
        red, green, blue = _hue(hashed(volume, row, seed), red, green, blue)
        title = 1.4 if abs(above - 0.15) < 0.03 and abs(u - 0.035 * (volume + 0.5)) < 0.008 else 1.0
        return red * title, green * title, blue * title
    if material == PLASTER and high > 2.0 and v < 0.09:
        return 0.75 - 0.3 * line(v - 0.09, 0.008, footprint), 0.73, 0.7
    factor = _factor(material, u, v, wide, high, seed, footprint)
    return red * factor, green * factor, blue * factor


@njit(nogil=True, error_model="numpy")
def outdoors(origin, ray, seed):  # type: ignore[no-untyped-def]
    """Return the light from outside: sky, a hedge with houses behind it, and a lawn."""
    flat = np.hypot(ray[0], ray[1])
    azimuth = np.arctan2(ray[1], ray[0])
    rise = ray[2] / max(flat, 1e-6)
    distance = 16.0
    height = origin[2] + rise * distance
    x, y = 8 * (azimuth + origin[0] / 40), height
    skyline = 2.5 + 1.2 * fractal(x, 0.0, 3.0, seed, 5, 0.02)
    if rise < 0 and height < 0.0:
        reach = -(origin[2] + 0.2) / ray[2] if origin[2] > -0.2 else 0.0
        u, v = origin[0] + reach * ray[0], origin[1] + reach * ray[1]
        tone = 1 + 0.25 * fractal(u, v, 1.0, seed + 3, 5, 0.01 + 0.004 * reach)
        return 1.1 * tone, 1.5 * tone, 0.7 * tone
    block = int(np.floor(x / 3.0))
    if hashed(block, 7, seed) < 0.4 and height < 3.5 + 3 * hashed(block, 8, seed):
        window = (x / 0.9) % 1 < 0.5 and (y / 1.5) % 1 > 0.4 and height > 1.0
        bright = 0.5 if window else 1.8 + 0.5 * hashed(block, 9, seed)
        return bright, 0.95 * bright, 0.85 * bright
    if height < skyline:
        tone = 1 + 0.7 * fractal(x, y, 0.8, seed + 1, 5, 0.02)
        return 0.7 * tone, 1.0 * tone, 0.45 * tone
    cloud = max(0.0, fractal(x / (1 + abs(rise)), y / (1 + abs(rise)), 6.0, seed + 2, 4, 0.05))
    return 2.6 + 1.5 * cloud, 3.2 + 1.0 * cloud, 4.2 + 0.2 * cloud
