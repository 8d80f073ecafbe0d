"""How much each pixel of a panorama is worth for the texture of a mesh."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.panoramas import filtered
from pano_mvs.core.arrays import FloatImage, Mask
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3, pad_panorama
from pano_mvs.scene import RangeMap
from pano_mvs.scene.range_map import CONSISTENT_CONFIDENCE, WEAK_CONFIDENCE

# The second difference of 1 / range, relative to it, at the border of a surface; on a plane it is 0.
_BORDER_STEP = 0.03
# Near a border, the pixel may show the other surface, but it is better than none.
_LEAST_FEATHER = 1e-3
_CONSISTENT, _WEAK, _FILLED, _UNKNOWN = 1.0, 0.6, 0.4, 0.3
# The panorama measured something in front of the mesh, or behind it, by more than this share of the range.
_MAX_DIFFERENCE = 0.1
_OCCLUDED, _CARVED = 0.02, 0.2
_SMOOTH_PX = 5


@dataclass(frozen=True, slots=True, eq=False)
class PaintView:
    """A panorama that gives its colours to a texture.

    `cam_from_world`: its pose. `picture`: (H, W, 3) uint8 RGB. `valid`: (H, W) bool; the other pixels are masked and
    paint nothing. `range_map`: its ranges, in the size of the picture; None if there are none.
    """

    cam_from_world: Rigid3
    picture: NDArray[np.uint8]
    valid: Mask
    range_map: RangeMap | None = None


def pixel_quality(view: PaintView, surface_ranges: FloatImage, *, feather_px: float) -> FloatImage:
    """Return the worth of each pixel, (H, W), from 0 (masked) to 1.

    It is lower near the border of a surface or of a mask, where ranges are weak, filled or unknown, and much lower
    where the panorama measured something else than the mesh.

    `view`: the panorama. `surface_ranges`: (H, W) ranges of the mesh in the panorama, infinite without a surface.
    `feather_px`: distance from a border beyond which it has no influence, in pixels.

    Raises:
        UsageError: if the sizes differ.
    """
    shape = view.valid.shape
    if view.picture.shape[:2] != shape or surface_ranges.shape != shape:
        raise UsageError(f"a picture of {view.picture.shape[:2]} with a mask of {shape} and {surface_ranges.shape}")
    border = surface_borders(surface_ranges)
    worth = np.full(shape, _UNKNOWN, np.float32)
    if view.range_map is not None:
        if view.range_map.range.shape != shape:
            raise UsageError(f"ranges of {view.range_map.range.shape} for a picture of {shape}")
        worth = _range_worth(view.range_map, surface_ranges)
    near = _distance_px(border | ~view.valid, limit=int(np.ceil(feather_px)) + 1)
    feather = np.maximum(np.square(np.minimum(near / feather_px, 1)), _LEAST_FEATHER)
    return np.where(view.valid, worth * feather, np.float32(0)).astype(np.float32)


def surface_borders(ranges: FloatImage) -> Mask:
    """Return the pixels, (H, W), at the border of a surface: where 1 / range is not linear, or ends."""
    inverse = pad_panorama((1 / ranges).astype(np.float32), 1)  # 0 without a surface
    here = inverse[1:-1, 1:-1]
    along = np.abs(inverse[1:-1, :-2] - 2 * here + inverse[1:-1, 2:])
    across = np.abs(inverse[:-2, 1:-1] - 2 * here + inverse[2:, 1:-1])
    return np.asarray(np.maximum(along, across) > _BORDER_STEP * here)


def _range_worth(range_map: RangeMap, surface_ranges: FloatImage) -> FloatImage:
    confidence = range_map.confidence
    worth = np.full(confidence.shape, _UNKNOWN, np.float32)
    worth[confidence > 0] = _FILLED
    worth[confidence >= WEAK_CONFIDENCE[0]] = _WEAK
    worth[confidence >= CONSISTENT_CONFIDENCE[0]] = _CONSISTENT
    with np.errstate(invalid="ignore"):
        ratio = range_map.range / surface_ranges
        worth[ratio < 1 - _MAX_DIFFERENCE] *= np.float32(_OCCLUDED)
        worth[ratio > 1 + _MAX_DIFFERENCE] *= np.float32(_CARVED)
    margin = min(_SMOOTH_PX, len(worth))
    blurred = filtered(worth, margin, lambda padded: cv2.blur(padded, (2 * margin + 1, 2 * margin + 1)))
    return np.asarray(np.minimum(blurred, np.maximum(worth, 2 * _OCCLUDED)))


def _distance_px(marked: Mask, *, limit: int) -> FloatImage:
    """Return the distance of each pixel to the nearest marked one in pixels, at most `limit`, across the seam."""
    if not marked.any():
        return np.full(marked.shape, limit, np.float32)
    margin = min(limit, len(marked))
    free = np.where(pad_panorama(marked, margin), np.uint8(0), np.uint8(1))
    distance = cv2.distanceTransform(free, cv2.DIST_L2, cv2.DIST_MASK_5)[margin:-margin, margin:-margin]
    return np.asarray(np.minimum(distance, np.float32(limit)))
