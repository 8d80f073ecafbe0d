"""Draw what moves with the camera into panoramas: a tripod, a selfie stick with the hand that holds it, a helmet."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import ray_grid
from pano_mvs.testing.room import noise

Drawn = tuple[FloatArray, NDArray[np.bool_]]


def tripod(size_hw: tuple[int, int]) -> Drawn:
    """Return the colours (H, W, 3) and the pixels (H, W) of a grey head at the nadir, and three legs."""
    rays = ray_grid(size_hw)
    off_nadir_deg = np.degrees(np.arccos(np.clip(rays[..., 1], -1, 1)))
    azimuth = np.arctan2(rays[..., 0], rays[..., 2])
    pixels = off_nadir_deg < 9
    for number in range(3):
        from_axis = np.abs(np.angle(np.exp(1j * (azimuth - 0.4 - 2 * np.pi * number / 3))))
        across_deg = np.degrees(np.sin(np.minimum(from_axis, np.pi / 2))) * np.sin(np.radians(off_nadir_deg))
        pixels |= (from_axis < np.pi / 2) & (off_nadir_deg < 36) & (across_deg < 1.6)
    shade = 70 + 25 * np.cos(6 * azimuth) + 20 * np.sign(np.sin(np.radians(40 * off_nadir_deg)))
    return np.repeat(shade[..., None], 3, axis=-1), pixels


def stick_and_hand(size_hw: tuple[int, int]) -> Drawn:
    """Return the colours and the pixels of a plain black stick from the nadir, with a hand and a sleeve at its end."""
    rays = ray_grid(size_hw)
    off_nadir_deg = np.degrees(np.arccos(np.clip(rays[..., 1], -1, 1)))
    sideways_deg = np.degrees(np.arcsin(np.clip(rays[..., 0], -1, 1)))
    stick = (np.abs(sideways_deg) < 1.2) & (off_nadir_deg < 40) & (rays[..., 2] > -0.05)
    center = np.array([0.05, 0.72, 0.69]) / np.linalg.norm([0.05, 0.72, 0.69])
    hand = np.degrees(np.arccos(np.clip(rays @ center, -1, 1))) < 9
    sleeve = (np.abs(sideways_deg - 8) < 7) & (off_nadir_deg > 47) & (off_nadir_deg < 62) & (rays[..., 2] > 0)
    grain = noise(rays.reshape(-1, 3), cells=((0.03, 1.0),), seed=7).reshape(size_hw)[..., None]
    colors = np.where(sleeve[..., None], (60.0, 70.0, 110.0), 25.0) + np.where(sleeve[..., None], 25.0, 2.0) * grain
    colors = np.where(hand[..., None], np.array([205.0, 150.0, 125.0]) + 8 * grain, colors)
    return colors, stick | hand | sleeve


def helmet(size_hw: tuple[int, int]) -> Drawn:
    """Return the colours and the pixels of a glossy helmet below the camera, plain except for a stripe and a badge."""
    rays = ray_grid(size_hw)
    azimuth = np.arctan2(rays[..., 0], rays[..., 2])
    off_nadir_deg = np.degrees(np.arccos(np.clip(rays[..., 1], -1, 1)))
    pixels = off_nadir_deg < 27 + 5 * np.cos(2 * azimuth)
    shade = 190 + 30 * np.cos(azimuth - 1)
    shade = np.where(np.abs(rays[..., 0]) < 0.04, 60.0, shade)
    badge = (np.abs(azimuth - 0.9) < 0.25) & (np.abs(off_nadir_deg - 18) < 4)
    colors = np.repeat(shade[..., None], 3, axis=-1)
    return np.where(badge[..., None], (180.0, 30.0, 40.0), colors), pixels


RIGS: dict[str, Callable[[tuple[int, int]], Drawn]] = {rig.__name__: rig for rig in (tripod, stick_and_hand, helmet)}


def with_rig(
    picture: NDArray[np.uint8], drawn: Drawn, *, gain: float = 1.0, rng: np.random.Generator | None = None
) -> NDArray[np.uint8]:
    """Return a panorama with what moves with the camera drawn over it, from the result of a function of `RIGS`.

    Args:
        picture: (H, W, 3) uint8.
        drawn: colours and pixels of the same size.
        gain: brightness of this view, which scales what is drawn.
        rng: draws sensor noise of one grey level; None for none.
    """
    colors, pixels = drawn
    levels = colors * gain
    if rng is not None:
        levels = levels + rng.normal(0, 1, levels.shape)
    return np.where(pixels[..., None], np.clip(np.rint(levels), 0, 255), picture).astype(np.uint8)
