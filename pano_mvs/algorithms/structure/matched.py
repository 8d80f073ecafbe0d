"""How well the pictures match if the pixels of a view lie on planes, and at their own ranges.

Where a plain wall and what stands before it look alike, ranges say little of which is which. The edges between them do:
in other views, they are where the nearer of the two surfaces puts them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.patchmatch.window_matches import Offers, WindowMatcher
from pano_mvs.algorithms.structure.laid import OtherView
from pano_mvs.algorithms.structure.view import on_grid
from pano_mvs.core.arrays import FloatArray, Mask, Picture
from pano_mvs.geometry import Rigid3

# Correlations above this one say no more: the pictures are noisy, and sampled.
_LARGEST_CORRELATION = 0.99
# A pixel is not matched on a plane whose range differs from its own by more than this logarithm.
_FARTHEST = 0.5
# Share of a reduced pixel that must not be masked.
_SHOWN = 0.999


@dataclass(frozen=True, eq=False)
class Mismatch:
    """Half the logarithm of the share of a window's variance that other views do not explain, 0 where nothing matches.

    It is minus the logarithm of the likelihood for each independent sample of the window, up to a constant.

    Attributes:
        on_planes: (P, h, w) on each plane.
        own: (h, w) at the pixels' own ranges.
    """

    on_planes: NDArray[np.float32]
    own: NDArray[np.float32]


def mismatch(
    ranges: NDArray[np.float32],
    normals_in_cam: NDArray[np.float16] | None,
    picture: Picture,
    *,
    cam_from_world: Rigid3,
    on_planes: Sequence[FloatArray],
    plane_normals_in_world: FloatArray,
    sources: Sequence[OtherView],
) -> Mismatch:
    """Return how well pictures match on planes; windows are nine pixels wide, of pictures twice as fine as the grid.

    Args:
        ranges: (H, W) of the view.
        normals_in_cam: (H, W, 3) of these, or None.
        picture: (H, W, 3) RGB.
        cam_from_world: pose of the view.
        on_planes: (h, w) range of each pixel of the grid on each plane, NaN where it does not meet it.
        plane_normals_in_world: (P, 3).
        sources: one or more other views.
    """
    rows = on_planes[0].shape[0]
    scale = max(1, min(2, picture.shape[0] // rows))
    size = scale * rows, 2 * scale * rows
    matcher = WindowMatcher(
        _reduced(picture, size),
        [_reduced(source.picture, size) for source in sources],
        [source.cam_from_world @ cam_from_world.inverse() for source in sources],
        [None if source.valid is None else _reduced_mask(source.valid, size) for source in sources],
    )
    pixels = on_grid(np.arange(size[0] * size[1]).reshape(size), rows)
    own = on_grid(ranges, rows)
    known = np.isfinite(own)
    own_normals = None if normals_in_cam is None else on_grid(normals_in_cam, rows)[known]
    values = np.zeros((len(on_planes) + 1, *own.shape), np.float32)
    values[0][known] = _lack(matcher.correlation(Offers(pixels[known], own[known], own_normals)))
    normals = (plane_normals_in_world @ cam_from_world.rotation.T).astype(np.float16)
    for value, plane, normal in zip(values[1:], on_planes, normals, strict=True):
        with np.errstate(invalid="ignore", divide="ignore"):
            tried = np.isfinite(plane) & ~(np.abs(np.log(own / plane)) > _FARTHEST)
        count = int(np.count_nonzero(tried))
        offers = Offers(pixels[tried], plane[tried].astype(np.float32), np.broadcast_to(normal, (count, 3)))
        value[tried] = _lack(matcher.correlation(offers))
    return Mismatch(values[1:], values[0])


def _lack(correlation: NDArray[np.float32]) -> NDArray[np.float32]:
    explained = np.minimum(correlation, np.float32(_LARGEST_CORRELATION)) ** 2
    return np.asarray(np.log1p(-explained) / 2, np.float32)


def _reduced(picture: Picture, size_hw: tuple[int, int]) -> Picture:
    if picture.shape[:2] == size_hw:
        return picture
    return np.asarray(cv2.resize(picture, size_hw[::-1], interpolation=cv2.INTER_AREA), np.uint8)


def _reduced_mask(mask: Mask, size_hw: tuple[int, int]) -> Mask:
    shares = cv2.resize(mask.astype(np.float32), size_hw[::-1], interpolation=cv2.INTER_AREA)
    return np.asarray(shares >= _SHOWN)
