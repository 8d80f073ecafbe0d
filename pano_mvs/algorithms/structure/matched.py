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

from pano_mvs.algorithms.patchmatch.window_matches import Offers, WindowMatcher, rays_of
from pano_mvs.algorithms.ranges.agreement import pixels_containing
from pano_mvs.algorithms.structure.laid import OtherView
from pano_mvs.algorithms.structure.view import grid_rows, on_grid, plane_ranges
from pano_mvs.core.arrays import Mask, Picture
from pano_mvs.geometry import Rigid3
from pano_mvs.scene import RangeMap
from pano_mvs.scene.surfaces import Structure

# Correlations above this one say no more: the pictures are noisy, and sampled.
_LARGEST_CORRELATION = 0.99
# A pixel is not matched on a plane whose range differs from its own by more than this logarithm.
_FARTHEST = 0.5
# Other views must be farther away than this share of the median range: nearer ones match on every plane.
_LEAST_BASELINE = 0.01
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
    range_map: RangeMap,
    picture: Picture,
    structure: Structure,
    *,
    planes: NDArray[np.intp],
    cam_from_world: Rigid3,
    sources: Sequence[OtherView],
) -> Mismatch | None:
    """Return how well pictures match on planes; None if there is no plane, or no other view from another place.

    Windows are nine pixels wide, of pictures twice as fine as the grid, or of the pictures themselves if these have
    less than 512 rows.

    Args:
        range_map: (H, W) of the view.
        picture: (H, W, 3) RGB.
        structure: planes in the world.
        planes: (P,) positions of those that are tried.
        cam_from_world: pose of the view.
        sources: other views.
    """
    seen = range_map.range[range_map.valid]
    least = _LEAST_BASELINE * float(np.median(seen)) if seen.size else 0.0
    apart = [np.linalg.norm(source.cam_from_world.center - cam_from_world.center) > least for source in sources]
    used = [source for source, is_apart in zip(sources, apart, strict=True) if is_apart]
    if not used or not len(planes):
        return None
    rows = grid_rows(picture.shape[0])
    scale = max(1, min(2, picture.shape[0] // rows))
    size = scale * rows, 2 * scale * rows
    matcher = WindowMatcher(
        _reduced(picture, size),
        [_reduced(source.picture, size) for source in used],
        from_reference=[source.cam_from_world @ cam_from_world.inverse() for source in used],
        masks=[None if source.valid is None else _reduced_mask(source.valid, size) for source in used],
    )
    pixels = on_grid(np.arange(size[0] * size[1]).reshape(size), rows)
    # Of larger panoramas, pixels of the grid and of the reduced picture are not at the same places.
    rays = rays_of(pixels.ravel(), size).reshape(*pixels.shape, 3)
    there = pixels_containing(rays, range_map.range.shape)
    own = range_map.range[there]
    known = np.isfinite(own)
    normals_in_cam = range_map.normals_in_cam
    own_normals = None if normals_in_cam is None else normals_in_cam[there][known]
    values = np.zeros((len(planes) + 1, *own.shape), np.float32)
    values[0][known] = _lack(matcher.correlation(Offers(pixels[known], own[known], own_normals)))
    rays_in_world = rays @ cam_from_world.rotation
    for value, idx in zip(values[1:], planes, strict=True):
        normal = structure.normals_in_world[idx]
        plane = plane_ranges(rays_in_world, cam_from_world.center, normal=normal, offset=float(structure.offsets[idx]))
        with np.errstate(invalid="ignore", divide="ignore"):
            tried = np.isfinite(plane) & ~(np.abs(np.log(own / plane)) > _FARTHEST)
        in_cam = np.broadcast_to((cam_from_world.rotation @ normal).astype(np.float16), (int(tried.sum()), 3))
        value[tried] = _lack(matcher.correlation(Offers(pixels[tried], plane[tried].astype(np.float32), in_cam)))
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
