"""SIFT and ORB on tangent tiles: key points as bearings, unaffected by the seam and the poles."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Annotated, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.faces.layout import beyond_face_rad, tangent_tiles
from pano_mvs.algorithms.faces.sampling import sample_view
from pano_mvs.algorithms.features.selection import MaxKeypoints, distinct_keypoints, spread_keypoints
from pano_mvs.algorithms.ranges.agreement import pixels_containing
from pano_mvs.core.errors import UsageError
from pano_mvs.core.settings import Setting, checks_settings
from pano_mvs.geometry import PinholeView, pad_panorama
from pano_mvs.geometry.positions import view_in_padded
from pano_mvs.scene import Features

_ORB_SCALE = 1.2


@dataclass(frozen=True, slots=True, eq=False)
class _Found:
    """Key points on a tile: pixels (N, 2), (0, 0) at its corner; sizes and strengths (N,); descriptors (N, D)."""

    pixels_px: NDArray[np.float64]
    sizes_px: NDArray[np.float64]
    scores: NDArray[np.float32]
    descriptors: NDArray[np.generic]

    def __getitem__(self, keep: NDArray[np.generic]) -> _Found:
        return _Found(self.pixels_px[keep], self.sizes_px[keep], self.scores[keep], self.descriptors[keep])


_Detector = Callable[[NDArray[np.uint8], NDArray[np.uint8]], _Found]


@checks_settings
def extract_sift(
    image: NDArray[np.uint8],
    mask: NDArray[np.bool_],
    *,
    max_keypoints: MaxKeypoints = 8000,
    contrast_threshold: Annotated[float, Setting("lower values find more key points on plain walls", ge=0)] = 0.004,
    root: Annotated[bool, Setting("use RootSIFT descriptors")] = True,
    max_width: Annotated[int, Setting("wider panoramas are reduced to this width to find key points", ge=16)] = 2560,
) -> Features:
    """Extract the SIFT key points of a panorama (Lowe 2004, on the tangent tiles of an icosahedron).

    Descriptors are integers in float32, so that their products are exact and matching does not depend on the order in
    which a BLAS adds.

    Args:
        image: (H, W, 3) uint8 RGB, the full sphere.
        mask: (H, W) bool; masked (False) pixels and their border have no key points.
        max_keypoints: maximum number of key points, spread evenly over the sphere.
        contrast_threshold: minimum contrast of a blob, in OpenCV's scale (lower values find more on plain walls).
        root: whether to take the square root of the L1-normalised descriptors (Arandjelović & Zisserman 2012).
        max_width: wider panoramas are reduced to this width; of all their key points, most would be left out:
            21 of 22 at 5376 columns.

    Raises:
        UsageError: if the shapes of image and mask do not match.
    """
    _check(image, mask)
    size_hw = (image.shape[0], image.shape[1])
    if size_hw[1] > max_width:
        reduced_xy = (max_width // 2 * 2, max_width // 2)
        image = np.asarray(cv2.resize(image, reduced_xy, interpolation=cv2.INTER_AREA), np.uint8)
        # A pixel that is masked in part is masked.
        mask = cv2.resize(np.where(mask, np.uint8(255), np.uint8(0)), reduced_xy, interpolation=cv2.INTER_AREA) == 255
    detector = sift_detector(contrast_threshold)

    def detect(tile_image: NDArray[np.uint8], owned: NDArray[np.uint8]) -> _Found:
        # Descriptors take half of the time, and three of four key points belong to another tile.
        keypoints, descriptors = detector.detectAndCompute(tile_image, owned)
        pixels = np.array([k.pt for k in keypoints]).reshape(-1, 2) + 0.5
        described = np.zeros((0, 128), np.float32) if descriptors is None else descriptors
        return _Found(pixels, *_sizes_and_scores(keypoints), root_sift(described) if root else described)

    # SIFT's patch extends three sizes from its centre, with less than a quarter of its weight beyond this distance.
    found = _extract(image, mask, detect, max_keypoints=max_keypoints, metric="l2", clearance=1.5)
    return replace(found, size_hw=size_hw)


@checks_settings
def extract_orb(
    image: NDArray[np.uint8],
    mask: NDArray[np.bool_],
    *,
    max_keypoints: MaxKeypoints = 8000,
    fast_threshold: int = 7,
) -> Features:
    """Extract the ORB key points of a panorama (Rublee et al. 2011, on the tangent tiles of an icosahedron).

    Args:
        image: (H, W, 3) uint8 RGB, the full sphere.
        mask: (H, W) bool; masked (False) pixels and their border have no key points.
        max_keypoints: maximum number of key points, spread evenly over the sphere.
        fast_threshold: minimum brightness difference of a FAST corner.

    Raises:
        UsageError: if the shapes of image and mask do not match.
    """
    detector = cv2.ORB.create(
        nfeatures=max(500, max_keypoints // 5),
        scaleFactor=_ORB_SCALE,
        nlevels=8,
        edgeThreshold=24,
        fastThreshold=fast_threshold,
    )

    def detect(tile_image: NDArray[np.uint8], _owned: NDArray[np.uint8]) -> _Found:
        # A mask would change which key points ORB keeps as the best of each level.
        keypoints, descriptors = detector.detectAndCompute(tile_image, None)
        described = np.zeros((0, 32), np.uint8) if descriptors is None else descriptors
        points = np.array([k.pt for k in keypoints]).reshape(-1, 2)
        levels = np.array([k.octave for k in keypoints], np.intp)
        pixels = np.empty_like(points)
        size_xy = np.array(tile_image.shape[1::-1], np.float64)
        for level in np.unique(levels):
            here = levels == level
            nominal = _ORB_SCALE**level
            level_size = np.rint(size_xy / nominal)
            picture = cv2.resize(tile_image, [int(size) for size in level_size], interpolation=cv2.INTER_AREA)
            whole = np.rint(points[here] / nominal).astype(np.intp)
            smooth = cv2.GaussianBlur(picture, (0, 0), 1.2)
            strength = np.abs(cv2.Laplacian(smooth, cv2.CV_64F))
            x, y = whole.T
            tops = [
                _parabola_top(strength[y - dy, x - dx], strength[y, x], strength[y + dy, x + dx])
                for dx, dy in ((1, 0), (0, 1))
            ]
            pixels[here] = ((whole.astype(np.float64) + np.stack(tops, axis=-1)) + 0.5) * (size_xy / level_size)
        return _Found(pixels, *_sizes_and_scores(keypoints), described)

    _check(image, mask)
    # ORB's patch extends half a size, plus a tenth for smoothing.
    return _extract(image, mask, detect, max_keypoints=max_keypoints, metric="hamming", clearance=0.6)


def _extract(
    image: NDArray[np.uint8],
    mask: NDArray[np.bool_],
    detect: _Detector,
    *,
    max_keypoints: int,
    metric: Literal["l2", "hamming"],
    clearance: float,
) -> Features:
    size_hw = (image.shape[0], image.shape[1])
    gray: NDArray[np.uint8] = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    valid = np.where(mask, np.uint8(255), np.uint8(0))
    tiles = tangent_tiles(size_hw)
    detected = [detect(sample_tile(gray, idx), owned_pixels(size_hw, idx)) for idx in range(len(tiles))]
    found = [
        _owned(_unmasked(f, valid, i, clearance=clearance), t, i)
        for i, (f, t) in enumerate(zip(detected, tiles, strict=True))
    ]
    bearings = np.concatenate([t.bearings_from_pixels(f.pixels_px) for t, f in zip(tiles, found, strict=True)])
    sizes = np.concatenate([_angular_sizes(t, f) for t, f in zip(tiles, found, strict=True)])
    scores = np.concatenate([f.scores for f in found])
    descriptors = np.concatenate([f.descriptors for f in found])
    pixel_rad = 2 * np.pi / size_hw[1]
    y, x = pixels_containing(bearings, size_hw)
    keep = np.flatnonzero(mask[y, x])
    keep = keep[distinct_keypoints(bearings[keep], scores[keep], radius_rad=0.5 * pixel_rad)]
    keep = keep[spread_keypoints(bearings[keep], scores[keep], max_keypoints=max_keypoints)]
    return Features(
        bearings=bearings[keep],
        descriptors=np.ascontiguousarray(descriptors[keep]),
        sizes_rad=sizes[keep].astype(np.float32),
        scores=scores[keep],
        colors_rgb=image[y[keep], x[keep]],
        metric=metric,
        size_hw=size_hw,
    )


def _check(image: NDArray[np.uint8], mask: NDArray[np.bool_]) -> None:
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or mask.shape != image.shape[:2]:
        raise UsageError(
            f"features need an (H, W, 3) uint8 image and an (H, W) mask, got {image.shape} {image.dtype} and "
            f"{mask.shape}"
        )


def _unmasked(found: _Found, valid: NDArray[np.uint8], tile_idx: int, *, clearance: float) -> _Found:
    """Drop key points that are masked, or closer to the mask than `clearance` sizes; `valid` is 255 or 0."""
    if valid.all() or not len(found.scores):
        return found
    valid_in_tile = (sample_tile(valid, tile_idx, interpolation=cv2.INTER_LINEAR) == 255).astype(np.uint8)
    if valid_in_tile.all():
        return found
    # The border of the tile does not count, only the distance to masked pixels.
    distance_px = cv2.distanceTransform(valid_in_tile, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    x, y = np.floor(found.pixels_px).astype(np.intp).T
    height, width = distance_px.shape
    distance_px = distance_px[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)]
    return found[distance_px > 1.0 + clearance * found.sizes_px]


def _owned(found: _Found, tile: PinholeView, tile_idx: int) -> _Found:
    """Keep the key points whose nearest tile centre is that of this tile.

    Two tiles locate a key point on their common edge slightly differently, and each might assign it to the other. So
    each tile also keeps key points just beyond the edge, and the weaker duplicates are dropped later.
    """
    return found[beyond_face_rad(tile.bearings_from_pixels(found.pixels_px), tile_idx) < 0.5 / tile.focal_px]


def _angular_sizes(tile: PinholeView, found: _Found) -> NDArray[np.float64]:
    """Return patch diameters in radians; off the centre, a gnomonic pixel shrinks by cos² along, cos across."""
    cosine = tile.bearings_from_pixels(found.pixels_px) @ tile.view_from_cam[2]
    sizes: NDArray[np.float64] = found.sizes_px / tile.focal_px * cosine**1.5
    return sizes


def _sizes_and_scores(keypoints: Sequence[cv2.KeyPoint]) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    return np.array([k.size for k in keypoints]), np.array([k.response for k in keypoints], np.float32)


def sift_detector(contrast_threshold: float = 0.004) -> cv2.SIFT:
    """Return OpenCV's detector with the settings of `extract_sift`."""
    # Twice the usual edge ratio: on plain walls many key points are on edges, and geometric verification rejects those
    # that slide. Without the precise upscale, all key points of the first octave are shifted by a quarter of a pixel.
    return cv2.SIFT.create(contrastThreshold=contrast_threshold, edgeThreshold=20, enable_precise_upscale=True)


def root_sift(descriptors: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return RootSIFT descriptors as integers: 512 √(d / Σd), whose squared length is 512²."""
    total = np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-9)
    rooted: NDArray[np.float32] = np.rint(512 * np.sqrt(descriptors / total)).astype(np.float32)
    return rooted


def _parabola_top(
    before: NDArray[np.float64], center: NDArray[np.float64], after: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the position of the maximum of a parabola through three values, in −0.5 … 0.5; 0 if there is none."""
    curvature = before + after - 2 * center
    peaked = curvature < 0
    top = 0.5 * (before - after) / np.where(peaked, curvature, -1.0)
    return np.where(peaked, np.clip(top, -0.5, 0.5), 0.0)


_TILES = 20
_PAD_PX = 4
_MAX_WIDTH = 2560  # maximum width of panoramas whose maps are cached: 78 MB, 8 bytes a pixel plus one for the mask


def sample_tile(
    panorama: NDArray[np.uint8], tile_idx: int, *, interpolation: int = cv2.INTER_CUBIC
) -> NDArray[np.uint8]:
    """Return the result of `sample_view` for a tangent tile of a panorama (H, W)."""
    size_hw = (panorama.shape[0], panorama.shape[1])
    if size_hw[1] > _MAX_WIDTH:
        return sample_view(panorama, tangent_tiles(size_hw)[tile_idx], interpolation=interpolation)
    padded = pad_panorama(panorama, min(_PAD_PX, *size_hw))
    return np.asarray(cv2.remap(padded, *_kept_map(size_hw, tile_idx), interpolation), np.uint8)


def owned_pixels(size_hw: tuple[int, int], tile_idx: int) -> NDArray[np.uint8]:
    """Return 255 for pixels that may contain key points of the tile's own face, and 0 elsewhere, (h, w) of the tile."""
    if size_hw[1] > _MAX_WIDTH:
        return _owned_pixels(tangent_tiles(size_hw)[tile_idx], tile_idx)
    return _kept_mask(size_hw, tile_idx)


@lru_cache(maxsize=_TILES)
def _kept_map(size_hw: tuple[int, int], tile_idx: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    pixels = view_in_padded(tangent_tiles(size_hw)[tile_idx], size_hw, min(_PAD_PX, *size_hw))
    x, y = np.ascontiguousarray(pixels[..., 0]), np.ascontiguousarray(pixels[..., 1])
    x.setflags(write=False)
    y.setflags(write=False)
    return x, y


@lru_cache(maxsize=_TILES)
def _kept_mask(size_hw: tuple[int, int], tile_idx: int) -> NDArray[np.uint8]:
    mask = _owned_pixels(tangent_tiles(size_hw)[tile_idx], tile_idx)
    mask.setflags(write=False)
    return mask


def _owned_pixels(tile: PinholeView, tile_idx: int) -> NDArray[np.uint8]:
    mask = np.empty(tile.size_hw, np.uint8)
    for first in range(0, len(mask), 256):
        rays = tile.rays(slice(first, first + 256))
        bearings = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
        # Key points just beyond the edge are kept, and may be in a pixel with a more distant centre.
        near = beyond_face_rad(bearings, tile_idx) < 2.0 / tile.focal_px
        mask[first : first + 256] = np.where(near, np.uint8(255), np.uint8(0))
    return mask


@dataclass(frozen=True, slots=True, eq=False)
class PhotographKeypoints:
    """Key points of a photograph, strongest first."""

    pixels_px: NDArray[np.float64]  # (N, 2) float64 in pixels of the photograph as stored, (0, 0) its upper-left corner
    descriptors: NDArray[np.float32]  # (N, 128) float32, RootSIFT as in `extract_sift`


def photograph_keypoints(picture: NDArray[np.uint8], *, max_keypoints: int = 6000) -> PhotographKeypoints:
    """Return the strongest SIFT key points of a photograph.

    Args:
        picture: (H, W, 3) uint8 RGB.
        max_keypoints: maximum number of key points.
    """
    gray = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
    # Photographs are reduced to this size: panoramas have fewer pixels per degree anyway.
    scale = min(1.0, 1600 / max(gray.shape))
    if scale < 1:
        size_xy = [max(1, round(side * scale)) for side in gray.shape[::-1]]
        gray = cv2.resize(gray, size_xy, interpolation=cv2.INTER_AREA)
    keypoints, descriptors = sift_detector().detectAndCompute(gray, None)
    if descriptors is None:
        return PhotographKeypoints(np.zeros((0, 2)), np.zeros((0, 128), np.float32))
    strongest = np.argsort([-k.response for k in keypoints], kind="stable")[:max_keypoints]
    pixels = np.array([keypoints[idx].pt for idx in strongest]).reshape(-1, 2) + 0.5
    back = np.array(picture.shape[1::-1]) / np.array(gray.shape[::-1])
    return PhotographKeypoints(pixels * back, root_sift(descriptors[strongest]))
