"""How well windows of a panorama match other views, on surfaces that are supposed there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.patchmatch.refine import SOURCE_REACH, reference_arrays, source_arrays
from pano_mvs.algorithms.sweep.windows import column_offsets, column_stretch
from pano_mvs.core.arrays import Mask, Picture
from pano_mvs.core.bands import for_bands
from pano_mvs.geometry import Rigid3, sines_of_grid
from pano_mvs.scene import RangeMap

_WINDOW = 5
"""Samples along each side of a window, two pixels apart."""


@dataclass(frozen=True, eq=False)
class Offers:
    """Ranges that are offered to pixels of the reference, (N,): flat positions, ranges, and normals (N, 3) or None."""

    pixels: NDArray[np.int64]
    ranges: NDArray[np.float32]
    normals: NDArray[np.float16] | None

    @staticmethod
    def of(range_map: RangeMap, pixels: NDArray[np.int64]) -> Offers:
        """Return the ranges of some pixels of a map as offers to them."""
        normals = range_map.normals_in_cam
        normals = None if normals is None else normals.reshape(-1, 3)[pixels]
        return Offers(pixels, range_map.range.ravel()[pixels], normals)

    @staticmethod
    def joined(offers: Sequence[Offers]) -> Offers:
        """Return the offers of all sources, one after the other; normals are NaN where they are not known."""
        normals = [
            np.full((len(offer.pixels), 3), np.nan, np.float16) if offer.normals is None else offer.normals
            for offer in offers
        ]
        return Offers(
            np.concatenate([offer.pixels for offer in offers]),
            np.concatenate([offer.ranges for offer in offers]),
            np.concatenate(normals),
        )

    def chosen(self, which: NDArray[Any]) -> Offers:
        """Return some of the offers."""
        return Offers(self.pixels[which], self.ranges[which], None if self.normals is None else self.normals[which])


class WindowMatcher:
    """Correlations of windows of the reference, on surfaces, with the sources."""

    def __init__(
        self,
        reference: Picture,
        sources: Sequence[Picture],
        *,
        from_reference: Sequence[Rigid3],
        masks: Sequence[Mask | None],
    ) -> None:
        """Prepare the pictures.

        Args:
            reference: (H, W, 3) uint8 RGB.
            sources: one or more such pictures.
            from_reference: their poses: x_in_source = R x_in_reference + t.
            masks: (H, W) of each source, False where it is ignored, or None.
        """
        height, width = reference.shape[:2]
        self.size_hw = height, width
        offsets = column_offsets((height, width), 2 * (_WINDOW // 2), spherical=True)[:, ::2].copy()
        self.reference = reference_arrays(reference, offsets, column_stretch(height, spherical=True))
        reach = SOURCE_REACH * (_WINDOW // 2) / height
        self.sources = source_arrays(sources, from_reference, masks, reach=reach)
        self.count = len(sources)

    def correlation(self, offers: Offers) -> NDArray[np.float32]:
        """Return the mean of the two best correlations of each offer, at least 0, (N,)."""
        import numba  # slow to import

        from pano_mvs.algorithms.patchmatch.kernels_exchange import correlate_pixels  # compiles on import

        height, width = self.size_hw
        order = np.argsort(offers.pixels, kind="stable")
        offers = offers.chosen(order)
        rows, columns = np.divmod(offers.pixels, width)
        planes = surface_planes(offers.ranges, offers.normals, rays_of(offers.pixels, (height, width)))
        starts = np.searchsorted(rows, np.arange(height + 1))
        found = np.empty((self.count, len(order)), np.float32)
        numbers = np.float32(1 / 25.0), np.float32(0.4**2)  # as in `refine_range`

        def match(first: int, rows: int) -> None:
            correlate_pixels(
                *((first, first + rows), starts, columns, planes, self.reference, self.sources, numbers, found)
            )

        for_bands(match, height, threads=numba.get_num_threads())
        best = min(2, self.count)  # these decide
        some = np.partition(found, self.count - best, axis=0)[-best:]
        correlations = np.empty(len(order), np.float32)
        correlations[order] = np.maximum(some, 0).mean(axis=0)
        return correlations


def surface_planes(
    ranges: NDArray[np.float32], normals: NDArray[np.float16] | None, rays: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Return the planes p with p · X = 1, (3, N), through points on surfaces.

    A plane faces the camera where the normal is unknown or the surface is seen at a grazing angle.

    `ranges`: (N,) of the points. `normals`: (N, 3) of the surfaces, NaN where unknown; or None. `rays`: (N, 3) unit
    vectors to the points.
    """
    normal = np.full_like(rays, np.nan) if normals is None else normals.astype(np.float64)
    cosine = np.sum(normal * rays, axis=-1)
    # Surfaces that are seen at a more grazing angle than this cosine are matched as if they faced the camera.
    steep = np.abs(cosine) >= 0.1  # False for NaN
    normal, cosine = np.where(steep[:, None], normal, rays), np.where(steep, cosine, 1.0)
    return np.ascontiguousarray((normal / (cosine * ranges)[:, None]).T, np.float32)


def rays_of(pixels: NDArray[np.int64], size_hw: tuple[int, ...]) -> NDArray[np.float64]:
    """Return the unit rays (N, 3) of pixels at flat positions."""
    height, width = size_hw
    turns, elevations = sines_of_grid((height, width))
    rows, columns = np.divmod(pixels, width)
    sine, cosine = elevations[:, rows]
    return np.stack([cosine * turns[0, columns], -sine, cosine * turns[1, columns]], axis=-1)
