"""Render the data of a face of a panorama: colours, mask, z-depths, normals and confidences."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.faces.sampling import nearest_pixels, sample_view
from pano_mvs.algorithms.fusion.view import normals_from_range
from pano_mvs.algorithms.ranges.agreement import MAX_SURFACE_STEP
from pano_mvs.core.bands import for_bands
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import PinholeView, pad_panorama, ray_from_pixel
from pano_mvs.scene import RangeMap


def face_image(panorama: NDArray[np.uint8], view: PinholeView) -> NDArray[np.uint8]:
    """Render the image of a face, (h, w, 3) uint8 RGB.

    The interpolation is bicubic. If a face is coarser than the panorama, each of its pixels is the average of several
    samples, spaced by at most a pixel of the panorama's equator, so that fine texture does not alias.

    `panorama`: (H, W, 3) uint8 RGB, the full sphere. `view`: the face.

    Raises:
        UsageError: if the panorama is not such an array.
    """
    if panorama.ndim != 3 or panorama.dtype != np.uint8 or panorama.shape[1] % 2:
        raise UsageError(f"a panorama is (H, W, 3) uint8 with even W, got {panorama.shape} {panorama.dtype}")
    return sample_view(panorama, view, samples=_samples(panorama.shape[1], view))


def face_mask(valid: NDArray[np.bool_], view: PinholeView) -> NDArray[np.bool_]:
    """Return the valid pixels of a face, (h, w) bool: pixels of `face_image` without any contribution of masked pixels.

    The mask grows by the two pixels of the interpolation's support, and by the width of a face's pixel.

    `valid`: (H, W) bool of the panorama; False is ignored. `view`: the face.
    """
    if valid.all():
        return np.ones(view.size_hw, np.bool_)
    # Bicubic interpolation uses no pixel farther away than this from the one that contains the position.
    reach = min(2, *valid.shape)
    window = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    padded = cv2.erode(pad_panorama(valid.astype(np.uint8), reach), window)
    clear = padded[reach:-reach, reach:-reach] > 0
    result = np.ones(view.size_hw, np.bool_)
    samples = _samples(valid.shape[1], view)
    for y in range(samples):
        for x in range(samples):
            offset_xy = ((x + 0.5) / samples, (y + 0.5) / samples)
            result &= clear[nearest_pixels(view, (valid.shape[0], valid.shape[1]), offset_xy=offset_xy)]
    return result


def _samples(width: int, view: PinholeView) -> int:
    """Return the number of samples in each pixel of a face, along each direction."""
    return max(1, int(np.ceil(width / (2 * np.pi) / view.focal_px - 1e-6)))


def face_z_depth(ranges: NDArray[np.float32], view: PinholeView, *, threads: int = 1) -> NDArray[np.float32]:
    """Return the z-depth of a face, (h, w) float32 in the ranges' unit, NaN if unknown.

    z = range · cos α, where α is the angle between the ray through the face pixel's centre and the face's axis. The
    range is interpolated between the panorama's four nearest pixels, bilinearly in 1 / range, in which planes are
    almost linear, if all four are valid and the farthest is at most 5 % farther than the nearest. Otherwise, at a step
    or a hole, it is the range of the pixel that contains the ray, which may be invalid: surfaces are not mixed across a
    discontinuity, and holes are not closed.

    `ranges`: (H, W) float32 along the rays of the full sphere, NaN invalid. `view`: the face. `threads`: number of
    threads; the result does not depend on it.

    Raises:
        UsageError: if the ranges are not such an array.
    """
    from pano_mvs.algorithms.ranges.kernels_agreement import z_depth_rows  # compiles on import

    if ranges.ndim != 2 or ranges.dtype != np.float32 or ranges.shape[1] % 2:
        raise UsageError(f"ranges are (H, W) float32 with even W, got {ranges.shape} {ranges.dtype}")
    x, y = (float(value) for value in view.principal_xy)
    camera = np.ascontiguousarray(view.view_from_cam), float(view.focal_px), x, y
    given = np.ascontiguousarray(ranges)
    result = np.empty(view.size_hw, np.float32)
    for_bands(
        lambda first, rows: z_depth_rows(first, rows, given, camera, MAX_SURFACE_STEP, result),
        view.size_hw[0],
        threads=threads,
    )
    return result


def face_normals(normals_in_cam: NDArray[np.floating], view: PinholeView) -> NDArray[np.float32]:
    """Return the normals of a face in ITS camera frame, (h, w, 3) float32, from the pixel that contains each ray.

    `normals_in_cam`: (H, W, 3) in the panorama's camera frame, NaN where unknown (and so in the result). `view`: the
    face.
    """
    at = nearest_pixels(view, (normals_in_cam.shape[0], normals_in_cam.shape[1]))
    turned: NDArray[np.float32] = normals_in_cam[at].astype(np.float32) @ view.view_from_cam.T.astype(np.float32)
    return turned


def face_confidence(confidence: NDArray[np.uint8], view: PinholeView) -> NDArray[np.uint8]:
    """Return the confidences of a face, (h, w) uint8, from the pixel that contains each ray.

    `confidence`: (H, W) uint8 of the panorama. `view`: the face.
    """
    return confidence[nearest_pixels(view, (confidence.shape[0], confidence.shape[1]))]


@dataclass(frozen=True, slots=True, eq=False)
class FaceRender:
    """Data of one face; where its mask is True, nothing comes from a masked pixel of the panorama.

    `image`: (h, w, 3) uint8 RGB; masked pixels show the content of the given image. `mask`: (h, w) bool, False where
    masked. `z_depth`: (h, w) float32 in scene units, NaN where unknown or masked. `normals_in_face`: (h, w, 3) float32
    unit normals in the face's camera frame, towards the camera; NaN exactly where the z-depth is NaN. `confidence`: (h,
    w) uint8, 0 exactly where the z-depth is NaN.
    """

    image: NDArray[np.uint8]
    mask: NDArray[np.bool_]
    z_depth: NDArray[np.float32]
    normals_in_face: NDArray[np.float32]
    confidence: NDArray[np.uint8]


@dataclass(frozen=True, slots=True, eq=False)
class FaceSource:
    """A panorama with its range map, prepared for the rendering of faces.

    `image`: (H, W, 3) uint8 RGB, for example from `Panorama.load`, which hides masked content. `valid`: (H, W) bool,
    False is masked. `ranges`: (H, W) float32, NaN if unknown, masked or of low confidence. `normals_in_cam`: (H, W, 3)
    float32, NaN where unknown. `confidence`: (H, W) uint8, 0 where the ranges are NaN.
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

    `image`: (H, W, 3) uint8 RGB. `valid`: (H, W) bool; False is ignored. `range_map`: of the same size.
    `min_confidence`: minimum confidence of ranges. `threads`: number of threads; the result does not depend on it.

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

    `source`: the panorama. `view`: the face. `depth_view`: the view of the z-depths, normals and confidences, for
    example `colmap_depth_view(view)`; None: the face itself. `threads`: number of threads; the result does not depend
    on it.
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
