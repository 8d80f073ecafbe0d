"""What of a mesh a panorama sees, and how much each of its pixels is worth for the texture."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.panoramas import filtered
from pano_mvs.core.arrays import FloatArray, FloatImage, Mask
from pano_mvs.core.bands import for_bands
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3, pad_panorama
from pano_mvs.scene import RangeMap
from pano_mvs.scene.range_map import CONSISTENT_CONFIDENCE, WEAK_CONFIDENCE

_CONSISTENT, _WEAK, _FILLED, _UNKNOWN = 1.0, 0.6, 0.4, 0.3
# The panorama measured something in front of the mesh, or behind it, by more than this share of the range.
_MAX_DIFFERENCE = 0.1
_OCCLUDED, _CARVED = 0.02, 0.2


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
    inverse = pad_panorama((1 / surface_ranges).astype(np.float32), 1)  # 0 without a surface
    here = inverse[1:-1, 1:-1]
    along = np.abs(inverse[1:-1, :-2] - 2 * here + inverse[1:-1, 2:])
    across = np.abs(inverse[:-2, 1:-1] - 2 * here + inverse[2:, 1:-1])
    border = np.asarray(np.maximum(along, across) > 0.03 * here)
    worth = np.full(shape, _UNKNOWN, np.float32)
    if view.range_map is not None:
        if view.range_map.range.shape != shape:
            raise UsageError(f"ranges of {view.range_map.range.shape} for a picture of {shape}")
        worth = _range_worth(view.range_map, surface_ranges)
    near = _distance_px(border | ~view.valid, limit=int(np.ceil(feather_px)) + 1)
    # Near a border, the pixel may show the other surface, but it is better than none.
    feather = np.maximum(np.square(np.minimum(near / feather_px, 1)), 1e-3)
    return np.where(view.valid, worth * feather, np.float32(0)).astype(np.float32)


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
    margin = min(5, len(worth))
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


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceView:
    """The nearest surface of a mesh along the ray of each pixel.

    `ranges`: (H, W) float32 distance along the ray through the pixel's centre; infinite without a surface. `triangle`:
    (H, W) int32 index of the triangle; −1 without a surface. `weights`: (H, W, 2) float32 barycentric weights of the
    triangle's second and third corner.
    """

    ranges: NDArray[np.float32]
    triangle: NDArray[np.int32]
    weights: NDArray[np.float32]


def surface_view(
    vertices_in_world: NDArray[np.float32],
    faces: NDArray[np.int32],
    cam_from_world: Rigid3,
    *,
    size_hw: tuple[int, int],
    threads: int = 1,
) -> SurfaceView:
    """Return what a panorama sees of a mesh; triangles hide each other from both sides.

    Each triangle is drawn on the sphere: a ray d meets the triangle (a, b, c) if d · (b × c), d · (c × a) and
    d · (a × b) have the sign of a · (b × c), so that no projection plane and no clipping is needed (M. Olano and
    T. Greer, "Triangle scan conversion using 2D homogeneous coordinates", 1997).

    `vertices_in_world`: (V, 3). `faces`: (F, 3) positions of vertices. `cam_from_world`: pose of the panorama.
    `size_hw`: (height, width) of the panorama. `threads`: number of threads; the result does not depend on it.

    Raises:
        UsageError: if the size is not that of a full sphere.
    """
    from pano_mvs.algorithms.mesh.kernels_mesh import draw_triangles, pixel_bounds  # compiles on import

    height, width = size_hw
    if width != 2 * height or height < 1:
        raise UsageError(f"a panorama is twice as wide as high, got {width}×{height} pixels")
    corners = np.ascontiguousarray(cam_from_world.apply(vertices_in_world)[faces])
    bounds = np.zeros((len(faces), 4), np.int32)
    pixel_bounds(corners, (height, width), bounds)
    elevation = np.pi * (0.5 - (np.arange(height) + 0.5) / height)
    azimuth = 2 * np.pi * ((np.arange(width) + 0.5) / width - 0.5)
    directions = np.cos(elevation), np.sin(elevation), np.cos(azimuth), np.sin(azimuth)
    targets = (
        np.full(size_hw, np.inf, np.float32),
        np.full(size_hw, -1, np.int32),
        np.zeros((*size_hw, 2), np.float32),
    )

    def draw(first: int, rows: int) -> None:
        draw_triangles(corners, bounds, directions, (first, first + rows), targets)

    for_bands(draw, height, threads=threads)
    return SurfaceView(*targets)


def face_normals(vertices: NDArray[np.float32], faces: NDArray[np.int32]) -> FloatArray:
    """Return the unit normals of triangles, (F, 3); 0 for one without an area."""
    corners = vertices.astype(np.float64)[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.asarray(normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30))
