"""Windows on the sphere: their width in columns for each row."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.geometry import pad_panorama

Scalar = TypeVar("Scalar", bound=np.generic)


def column_stretch(height: int, *, spherical: bool) -> NDArray[np.float64]:
    """Return how many columns make the width of one pixel at the equator, (H,): 1/cos of the elevation, at most 8.

    At a pole one column has no width at all; the cap keeps the window from becoming the whole row, which would
    smooth over everything around the pole.
    """
    if not spherical:
        return np.ones(height)
    elevation = np.pi * (0.5 - (np.arange(height) + 0.5) / height)
    return np.minimum(1 / np.cos(elevation), 8.0)


def column_offsets(size_hw: tuple[int, int], radius: int, *, spherical: bool) -> NDArray[np.int64]:
    """Return the columns of a window's pixels against its centre, (H, 2 radius + 1), for a centre in each row.

    A window never reaches further than a quarter of the way around.
    """
    height, width = size_hw
    stretch = column_stretch(height, spherical=spherical)
    offsets = np.rint(np.arange(-radius, radius + 1) * stretch[:, None]).astype(np.int64)
    return np.clip(offsets, -(width // 4), width // 4)


def neighbours(picture: NDArray[Scalar], rows: int, columns: NDArray[np.int64]) -> NDArray[Scalar]:
    """Return for every pixel the one that lies `rows` below and `columns` (H,) to its right, (H, W)."""
    height, width = picture.shape
    pad = abs(rows)
    shifted = pad_panorama(picture, pad)[pad + rows : pad + rows + height, pad : pad + width]
    found = np.empty_like(shifted)
    for step in np.unique(columns):  # few steps: rows of one are moved at once
        here = columns == step
        found[here] = np.roll(shifted[here], -step, axis=1)
    return found


@dataclass(frozen=True, eq=False)
class CostWindow:
    """The window around every pixel of the reference, on the sphere: over the seam and over the poles.

    Attributes:
        radius: rows on either side of the centre.
        columns: (H, 2 radius + 1) int64 columns of its pixels against its centre, for a centre in each row.
    """

    radius: int
    columns: NDArray[np.int64]

    @staticmethod
    def of(size_hw: tuple[int, int], radius: int, *, spherical: bool) -> CostWindow:
        """Return the windows of a picture; `spherical` ones are widened towards the poles."""
        return CostWindow(radius, column_offsets(size_hw, radius, spherical=spherical))

    def neighbours(self, picture: NDArray[Scalar]) -> Iterator[NDArray[Scalar]]:
        """Yield, for each place in the window row by row, the picture's pixel there for every centre, (H, W) each."""
        bands = WindowBands(self.radius, self.columns, picture.shape[1])
        padded, places = bands.pad(picture), list(bands.places())
        for place in range((2 * self.radius + 1) ** 2):
            found = np.empty_like(picture)
            for rows, of_band in places:
                found[rows] = padded[of_band[place]]
            yield found


@dataclass(frozen=True, eq=False)
class WindowBands:
    """The rows of a picture in bands within which all windows are equally wide, to be worked on by slices."""

    radius: int  # rows on either side of a window's centre
    columns: NDArray[np.int64]  # (H, 2 radius + 1) columns of a window's pixels against its centre
    width: int

    @staticmethod
    def of(size_hw: tuple[int, int], radius: int, *, spherical: bool) -> WindowBands:
        """Return the bands of a picture."""
        return WindowBands(radius, column_offsets(size_hw, radius, spherical=spherical), size_hw[1])

    @property
    def margin(self) -> int:
        """The columns that `pad` adds on either side."""
        return int(np.abs(self.columns).max())

    def pad(self, picture: NDArray[Scalar]) -> NDArray[Scalar]:
        """Return a picture (H, W) with `radius` rows more at either pole and `margin` columns more at the seam."""
        rows = pad_panorama(picture, self.radius)[:, self.radius : self.radius + picture.shape[1]]
        return np.pad(rows, ((0, 0), (self.margin, self.margin)), mode="wrap")

    def reaches(self) -> Iterator[tuple[slice, int]]:
        """Yield the rows of each band, and the columns of its windows on either side."""
        starts = np.flatnonzero(np.any(np.diff(self.columns, axis=0, prepend=self.columns[:1] - 1), axis=1))
        for start, stop in zip(starts, [*starts[1:], len(self.columns)], strict=True):
            yield slice(int(start), int(stop)), int(self.columns[start, -1])

    def places(self) -> Iterator[tuple[slice, list[tuple[slice, slice]]]]:
        """Yield the rows of each band, and where in a padded picture lies each place of the window, row by row."""
        for rows, _ in self.reaches():
            firsts = [self.margin + int(column) for column in self.columns[rows.start]]
            columns = [slice(first, first + self.width) for first in firsts]
            yield (
                rows,
                [
                    (slice(rows.start + step, rows.stop + step), column)
                    for step in range(2 * self.radius + 1)
                    for column in columns
                ],
            )


def box_mean(picture: NDArray[np.float64], window: CostWindow) -> NDArray[np.float64]:
    """Return the mean over the box that each window spans, all of its columns, (H, W)."""
    width, radius = picture.shape[1], window.radius
    if radius == 0:
        return picture
    bands = WindowBands(radius, window.columns, width)
    padded, result = bands.pad(picture), np.empty_like(picture)
    for rows, reach in bands.reaches():
        size = 2 * reach + 1, 2 * radius + 1
        # Sums of integers are exact, so that means are rounded as in the compiled sweep.
        sums = cv2.boxFilter(padded[rows.start : rows.stop + 2 * radius], -1, size, normalize=False)
        result[rows] = sums[radius:-radius, bands.margin : bands.margin + width] / (size[0] * size[1])
    return result
