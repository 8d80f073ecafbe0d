"""Pictures of two-lens cameras: recognise raw recordings, and stitch calibrated fisheye pictures to a panorama."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray, Picture
from pano_mvs.core.bands import for_bands
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import FisheyeLens, LensRig, ray_from_pixel, ray_grid

_SIZE_HW = (128, 256)


def is_dual_fisheye(picture: NDArray[np.uint8]) -> bool:
    """Return whether an image with aspect ratio 2:1 shows two fisheye circles side by side instead of a panorama.

    Such an image is black outside of the two circles, at the top and the bottom, but not inside of them. In a panorama,
    the same areas are bands around the seam and the middle from pole to pole, and contain sky and floor.

    `picture`: (H, 2 H, 3) uint8.
    """
    grey = cv2.cvtColor(cv2.resize(picture, _SIZE_HW[::-1], interpolation=cv2.INTER_AREA), cv2.COLOR_BGR2GRAY)
    rows, columns = np.mgrid[: _SIZE_HW[0], : _SIZE_HW[0]]
    radius = np.hypot(rows + 0.5 - _SIZE_HW[0] / 2, columns + 0.5 - _SIZE_HW[0] / 2) / (_SIZE_HW[0] / 2)
    inside, outside = np.tile(radius < 0.9, 2), np.tile(radius > 1.1, 2)
    upper, lower = outside.copy(), outside.copy()
    upper[_SIZE_HW[0] // 2 :] = lower[: _SIZE_HW[0] // 2] = False
    dark = grey < 24
    is_dark_around = min(dark[upper].mean(), dark[lower].mean()) > 0.97
    return bool(is_dark_around and np.median(grey[inside]) > 40)


def stitch_lenses(
    pictures: Sequence[Picture], rig: LensRig, *, size_hw: tuple[int, int], threads: int = 1
) -> tuple[Picture, NDArray[np.bool_]]:
    """Return the panorama of a rig and its valid pixels.

    Each pixel shows what a lens sees at the stitching distance of the rig in that direction (see `LensRig`). The seam
    is where both lenses see equally far inside their fields of view. In a strip around it, as wide as `blend_deg` of
    the rig, their pictures are mixed.

    `pictures`: the picture of each lens, (H, W, 3) uint8. `rig`: the rig. `size_hw`: (height, width) of the panorama.
    `threads`: number of threads.

    Returns:
        (H, W, 3) uint8, black where no lens sees, and (H, W) bool, False there.

    Raises:
        UsageError: if a picture does not have the size of its lens.
    """
    for name, lens, picture in zip(rig.names, rig.lenses, pictures, strict=True):
        if picture.shape[:2] != lens.size_hw:
            raise UsageError(f"the picture of the lens {name} is {picture.shape[:2]}, its calibration {lens.size_hw}")
    height, width = size_hw
    sources = [_reduced(picture, lens, width) for lens, picture in zip(rig.lenses, pictures, strict=True)]
    panorama, valid = np.zeros((height, width, 3), np.uint8), np.zeros(size_hw, np.bool_)

    def stitch_rows(first: int, rows: int) -> None:
        pixels = np.stack(
            np.broadcast_arrays(np.arange(width) + 0.5, np.arange(first, first + rows)[:, None] + 0.5), -1
        )
        bearings = ray_from_pixel(pixels, size_hw)
        weights = lens_weights(rig.margins_rad(bearings), blend_rad=float(np.radians(rig.blend_deg)))
        mixed = np.zeros((rows, width, 3))
        for idx, (lens, source) in enumerate(zip(rig.lenses, sources, strict=True)):
            if weights[..., idx].any():
                seen = _sampled(source, lens, rig.points_in_lens(bearings, idx))
                mixed += weights[..., idx, None] * seen
        panorama[first : first + rows] = np.rint(mixed)
        valid[first : first + rows] = weights.any(axis=-1)

    for_bands(stitch_rows, height, threads=threads)
    return panorama, valid


def lens_panorama(
    picture: Picture, lens: FisheyeLens, *, size_hw: tuple[int, int]
) -> tuple[Picture, NDArray[np.bool_]]:
    """Return the panorama that one lens sees, its axis in the middle, (H, W, 3) uint8, and its valid pixels (H, W)."""
    rays = ray_grid(size_hw)
    pixels = lens.pixel_from_ray(rays)
    valid = np.isfinite(pixels[..., 0]) & lens.contains(pixels)
    seen = np.clip(np.rint(_sampled(_reduced(picture, lens, size_hw[1]), lens, rays)), 0, 255).astype(np.uint8)
    return np.where(valid[..., None], seen, np.uint8(0)), valid


def lens_weights(margins_rad: FloatArray, *, blend_rad: float) -> FloatArray:
    """Return the weight of each lens, (..., 2): they sum to 1 where a lens sees, and are 0 elsewhere.

    `margins_rad`: (..., 2) angle by which the direction is inside of each field of view, −inf if it is not seen.
    `blend_rad`: width of the strip around the seam in which both weights are positive.
    """
    seen = np.isfinite(margins_rad)
    first, second = np.moveaxis(np.where(seen, margins_rad, 0.0), -1, 0)
    # Away from the seam, one margin grows as the other shrinks.
    share = np.clip(0.5 + (second - first) / (2 * max(blend_rad, 1e-9)), 0.0, 1.0)
    share = np.where(seen[..., 0], np.where(seen[..., 1], share, 0.0), 1.0)
    return np.where((seen[..., 0] | seen[..., 1])[..., None], np.stack([1 - share, share], axis=-1), 0.0)


def _reduced(picture: Picture, lens: FisheyeLens, width: int) -> tuple[Picture, FloatArray]:
    """Return the picture at about the resolution of the panorama, and its scale in x and y."""
    density = max(lens.focal_xy) / (width / (2 * np.pi))
    # Pictures with more pixels per radian than this times those of the panorama are reduced first, against aliasing.
    if density <= 1.25:
        return picture, np.ones(2)
    height, columns = (max(1, round(side / density)) for side in picture.shape[:2])
    reduced = np.asarray(cv2.resize(picture, (columns, height), interpolation=cv2.INTER_AREA), np.uint8)
    return reduced, np.array([columns / picture.shape[1], height / picture.shape[0]])


def _sampled(source: tuple[Picture, FloatArray], lens: FisheyeLens, rays: FloatArray) -> FloatArray:
    """Return the colours of a lens along rays, (h, w, 3); arbitrary where it does not see."""
    picture, scale = source
    pixels = lens.pixel_from_ray(rays) * scale - 0.5
    places = np.where(np.isfinite(pixels), pixels, -1.0).astype(np.float32)
    sampled = cv2.remap(
        picture, places[..., 0], places[..., 1], interpolation=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(sampled, np.float64)
