"""Repeating textures: a drawing printed periodically on surfaces, filtered to the width of a pixel."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs.testing.surfaces import Vector
from tests.synthetic.paints import WHITE
from tools.benchmarks.repeating.drawings import Drawing, Image, pyramid

_ROW = 1024
# Side of a print of the wear, and scale of its second layer: together they do not repeat within a hall.
_WEAR_SIZE, _WEAR_SCALE = 9.1, 3.37
_WEAR = Drawing("wear", WHITE, texels=1024)


@dataclass(frozen=True)
class Print:
    """A drawing printed periodically on a surface, without gaps.

    Attributes:
        drawing: the drawing.
        size: (width, height) of one print in scene units; if it is wound, the width is in turns.
        origin: a point where four prints meet; the axis of a wound print goes through it.
        wound: whether it is wound about a vertical axis (a column). Otherwise its height is along y on walls, and its
            width along x on floors and ceilings.
        half_turn: whether it is rotated by half a turn about the vertical axis through the world's origin.
        wear: share in [0, 1] of non-repeating texture.
        seed: seed of the wear.
    """

    drawing: Drawing
    size: tuple[float, float]
    origin: Vector = (0.0, 0.0, 0.0)
    wound: bool = False
    half_turn: bool = False
    wear: float = 0.0
    seed: int = 0

    def albedo(self, points: FloatArray, normals: FloatArray, *, footprint: FloatArray) -> FloatArray:
        """Return the unlit colours (N, 3) of points (N, 3) of surfaces with these normals.

        Args:
            points: in world coordinates.
            normals: (N, 3) of the surface at each.
            footprint: (N,) width of a pixel at each point.
        """
        levels = pyramid(self.drawing)
        turn = np.array([-1, 1, -1] if self.half_turn else [1, 1, 1])
        home = points * turn - np.array(self.origin)
        texel = (self.size[1] if self.wound else float(np.sqrt(self.size[0] * self.size[1]))) / len(levels[0])
        colors = sampled(levels, self._prints(home, normals * turn), footprint / texel)
        if self.wear:
            colors = colors * (1 + self.wear * self._worn(points, footprint)[:, None])
        return colors

    def _prints(self, home: FloatArray, normals: FloatArray) -> FloatArray:
        """Return the positions of points in the drawing, (N, 2) in prints."""
        if self.wound:
            turns = np.arctan2(home[:, 0], home[:, 2]) / (2 * np.pi)
            return np.stack([turns, home[:, 1]], axis=1) / self.size
        x, y, z = np.abs(normals).T
        level, faces_x = (y > x) & (y > z), x > z
        u = np.where(faces_x & ~level, home[:, 2], home[:, 0])
        v = np.where(level, home[:, 2], home[:, 1])
        return np.stack([u, v], axis=1) / self.size

    def _worn(self, points: FloatArray, footprint: FloatArray) -> FloatArray:
        """Return the non-repeating wear (N,), with standard deviation ⅓, less far away."""
        rng = np.random.default_rng([self.seed, 0x3EA7])
        total = np.zeros(len(points))
        for size in (_WEAR_SIZE, _WEAR_SIZE * _WEAR_SCALE):
            axes = np.linalg.qr(rng.normal(size=(3, 3)))[0][:2] * np.sqrt(1.5)
            uv = points @ axes.T / size + rng.uniform(0, 1, 2)
            levels = pyramid(_WEAR)
            total += sampled(levels, uv, footprint / size * len(levels[0]))[:, 0] - 0.5
        return np.asarray(np.sqrt(2) * total)


def sampled(levels: tuple[Image, ...], prints: FloatArray, blur: FloatArray) -> FloatArray:
    """Return the colours (N, 3) of a periodically repeated image.

    Args:
        levels: the image and its smaller copies, as returned by `pyramid`.
        prints: (N, 2) x and y in images; the fraction is the position within one.
        blur: (N,) width in texels over which the colour is averaged.
    """
    colors = np.empty((len(prints), 3))
    within = (prints - np.floor(prints)).astype(np.float32)
    level = np.clip(np.log2(np.maximum(blur, 1.0)), 0, len(levels) - 1)
    low = np.minimum(level.astype(np.int64), len(levels) - 2)
    for number in np.unique(low):
        on = low == number
        share = (level[on] - number)[:, None]
        fine, coarse = (_bilinear(levels[number + k], within[on]) for k in (0, 1))
        colors[on] = fine + share * (coarse - fine)
    return colors


def _bilinear(image: Image, within: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the colours (N, 3) at positions (N, 2) in [0, 1] of a periodic image."""
    if len(image) == 1:
        return np.broadcast_to(image[0], (len(within), 3))
    rows = -(-len(within) // _ROW)
    pixels = np.zeros((rows * _ROW, 2), np.float32)
    pixels[: len(within)] = within * np.float32(len(image)) - np.float32(0.5)
    found = cv2.remap(image, pixels.reshape(rows, _ROW, 2), None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    return np.asarray(found.reshape(-1, 3)[: len(within)])
