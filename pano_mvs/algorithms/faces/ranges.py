"""Z-depths, normals and confidences of a face of a panorama."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.faces.sampling import nearest_pixels
from pano_mvs.core.bands import for_bands
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import PinholeView

# Four neighbouring pixels with a larger relative difference are two surfaces: do not interpolate between them.
_MAX_SURFACE_STEP = 0.05


def face_z_depth(ranges: NDArray[np.float32], view: PinholeView, *, threads: int = 1) -> NDArray[np.float32]:
    """Return the z-depth of a face, (h, w) float32 in the ranges' unit, NaN if unknown.

    z = range · cos α, where α is the angle between the ray through the face pixel's centre and the face's axis. The
    range is interpolated between the panorama's four nearest pixels, bilinearly in 1 / range, in which planes are
    almost linear, if all four are valid and the farthest is at most 5 % farther than the nearest. Otherwise, at a step
    or a hole, it is the range of the pixel that contains the ray, which may be invalid: surfaces are not mixed across a
    discontinuity, and holes are not closed.

    Args:
        ranges: (H, W) float32 along the rays of the full sphere, NaN invalid.
        view: the face.
        threads: number of threads; the result does not depend on it.

    Raises:
        UsageError: if the ranges are not such an array.
    """
    from pano_mvs.algorithms.faces.kernels_faces import z_depth_rows  # compiles on import

    if ranges.ndim != 2 or ranges.dtype != np.float32 or ranges.shape[1] % 2:
        raise UsageError(f"ranges are (H, W) float32 with even W, got {ranges.shape} {ranges.dtype}")
    x, y = (float(value) for value in view.principal_xy)
    camera = np.ascontiguousarray(view.view_from_cam), float(view.focal_px), x, y
    given = np.ascontiguousarray(ranges)
    result = np.empty(view.size_hw, np.float32)
    for_bands(
        lambda first, rows: z_depth_rows(first, rows, given, camera, _MAX_SURFACE_STEP, result),
        view.size_hw[0],
        threads=threads,
    )
    return result


def face_normals(normals_in_cam: NDArray[np.floating], view: PinholeView) -> NDArray[np.float32]:
    """Return the normals of a face in ITS camera frame, (h, w, 3) float32, from the pixel that contains each ray.

    Args:
        normals_in_cam: (H, W, 3) in the panorama's camera frame, NaN where unknown (and so in the result).
        view: the face.
    """
    at = nearest_pixels(view, (normals_in_cam.shape[0], normals_in_cam.shape[1]))
    turned: NDArray[np.float32] = normals_in_cam[at].astype(np.float32) @ view.view_from_cam.T.astype(np.float32)
    return turned


def face_confidence(confidence: NDArray[np.uint8], view: PinholeView) -> NDArray[np.uint8]:
    """Return the confidences of a face, (h, w) uint8, from the pixel that contains each ray.

    Args:
        confidence: (H, W) uint8 of the panorama.
        view: the face.
    """
    return confidence[nearest_pixels(view, (confidence.shape[0], confidence.shape[1]))]
