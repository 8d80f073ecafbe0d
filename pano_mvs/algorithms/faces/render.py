"""Render all data of a dense workspace for one face."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.faces.pictures import face_image, face_mask
from pano_mvs.algorithms.faces.ranges import face_confidence, face_normals, face_z_depth
from pano_mvs.algorithms.fusion.normals import normals_from_range
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import PinholeView, ray_from_pixel
from pano_mvs.scene import RangeMap


@dataclass(frozen=True, slots=True, eq=False)
class FaceRender:
    """Data of one face; where its mask is True, nothing comes from a masked pixel of the panorama.

    Attributes:
        image: (h, w, 3) uint8 RGB; masked pixels show the content of the given image.
        mask: (h, w) bool, False where masked.
        z_depth: (h, w) float32 in scene units, NaN where unknown or masked.
        normals_in_face: (h, w, 3) float32 unit normals in the face's camera frame, towards the camera; NaN exactly
            where the z-depth is NaN.
        confidence: (h, w) uint8, 0 exactly where the z-depth is NaN.
    """

    image: NDArray[np.uint8]
    mask: NDArray[np.bool_]
    z_depth: NDArray[np.float32]
    normals_in_face: NDArray[np.float32]
    confidence: NDArray[np.uint8]


@dataclass(frozen=True, slots=True, eq=False)
class FaceSource:
    """A panorama with its range map, prepared for the rendering of faces.

    Attributes:
        image: (H, W, 3) uint8 RGB, for example from `Panorama.load`, which hides masked content.
        valid: (H, W) bool, False is masked.
        ranges: (H, W) float32, NaN if unknown, masked or of low confidence.
        normals_in_cam: (H, W, 3) float32, NaN where unknown.
        confidence: (H, W) uint8, 0 where the ranges are NaN.
    """

    image: NDArray[np.uint8]
    valid: NDArray[np.bool_]
    ranges: NDArray[np.float32]
    normals_in_cam: NDArray[np.float32]
    confidence: NDArray[np.uint8]


def face_source(
    image: NDArray[np.uint8],
    valid: NDArray[np.bool_],
    range_map: RangeMap,
    *,
    min_confidence: int = 64,
    threads: int = 1,
) -> FaceSource:
    """Prepare a panorama for `render_face`: masked and unreliable pixels have no range.

    Normals are those of the range map; otherwise they are fitted to the ranges (`normals_from_range`); where that is
    impossible, the surface is assumed to face the camera.

    Args:
        image: (H, W, 3) uint8 RGB.
        valid: (H, W) bool; False is ignored.
        range_map: of the same size.
        min_confidence: minimum confidence of ranges.
        threads: number of threads; the result does not depend on it.

    Raises:
        UsageError: if the sizes differ.
    """
    ranges = range_map.range
    if image.shape[:2] != ranges.shape or valid.shape != ranges.shape:
        raise UsageError(f"image {image.shape[:2]}, mask {valid.shape} and range map {ranges.shape} differ in size")
    kept = valid & (range_map.confidence >= min_confidence) & range_map.valid
    given = None if range_map.normals_in_cam is None else range_map.normals_in_cam.astype(np.float32)
    seen = np.where(kept, ranges, np.float32(np.nan))
    normals = normals_from_range(seen, given=given, threads=threads)
    row, column = np.nonzero(kept & ~np.isfinite(normals[..., 0]))
    size_hw = (ranges.shape[0], ranges.shape[1])
    normals[row, column] = -ray_from_pixel(np.stack([column + 0.5, row + 0.5], axis=-1), size_hw)
    return FaceSource(image, valid, seen, normals, np.where(kept, range_map.confidence, np.uint8(0)))


def render_face(
    source: FaceSource, view: PinholeView, *, depth_view: PinholeView | None = None, threads: int = 1
) -> FaceRender:
    """Render one face of a panorama.

    Args:
        source: the panorama.
        view: the face.
        depth_view: the view of the z-depths, normals and confidences, for example `colmap_depth_view(view)`; None: the
            face itself.
        threads: number of threads; the result does not depend on it.
    """
    depth_view = view if depth_view is None else depth_view
    mask = face_mask(source.valid, view)
    z_depth = face_z_depth(source.ranges, depth_view, threads=threads)
    z_depth[~mask] = np.nan
    known = np.isfinite(z_depth)
    normals = face_normals(source.normals_in_cam, depth_view)
    normals[~known] = np.nan
    confidence = face_confidence(source.confidence, depth_view)
    confidence[~known] = 0
    return FaceRender(face_image(source.image, view), mask, z_depth, normals, confidence)


def colmap_depth_view(view: PinholeView) -> PinholeView:
    """Return the view whose pixel centres are where COLMAP's dense code assumes a face's pixels.

    For its fusion and patch matching, the pixel in column c and row r is the ray K⁻¹ (c, r, 1): the pixel's upper left
    corner, since (0, 0) is a corner everywhere else in COLMAP. Depth maps for the pixel centres would be fused with an
    offset of half a pixel.
    """
    return replace(view, principal_xy=view.principal_xy + 0.5)
