"""Images of the tangent tiles, sampled by maps that are cached for panoramas of the same size."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.faces.layout import beyond_face_rad, tangent_tiles
from pano_mvs.algorithms.faces.sampling import sample_view
from pano_mvs.geometry import PinholeView, pad_panorama, pixel_from_ray

_TILES = 20
_PAD_PX = 4
_MAX_WIDTH = 2560  # maximum width of panoramas whose maps are cached: 78 MB, 8 bytes a pixel plus one for the mask
_OWNED_SLACK_PX = 2.0  # key points just beyond the edge are kept, and may be in a pixel with a more distant centre


def sample_tile(panorama: NDArray[np.uint8], tile_idx: int) -> NDArray[np.uint8]:
    """Return the result of `sample_view` for a tangent tile of a panorama (H, W)."""
    size_hw = (panorama.shape[0], panorama.shape[1])
    if size_hw[1] > _MAX_WIDTH:
        return sample_view(panorama, tangent_tiles(size_hw)[tile_idx])
    padded = pad_panorama(panorama, min(_PAD_PX, *size_hw))
    return np.asarray(cv2.remap(padded, *_kept_map(size_hw, tile_idx), cv2.INTER_CUBIC), np.uint8)


def owned_pixels(size_hw: tuple[int, int], tile_idx: int) -> NDArray[np.uint8]:
    """Return 255 for pixels that may contain key points of the tile's own face, and 0 elsewhere, (h, w) of the tile."""
    if size_hw[1] > _MAX_WIDTH:
        return _owned_pixels(tangent_tiles(size_hw)[tile_idx], tile_idx)
    return _kept_mask(size_hw, tile_idx)


@lru_cache(maxsize=_TILES)
def _kept_map(size_hw: tuple[int, int], tile_idx: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    # OpenCV puts (0, 0) at the first pixel's centre.
    shift = min(_PAD_PX, *size_hw) - 0.5
    pixels = (pixel_from_ray(tangent_tiles(size_hw)[tile_idx].rays(), size_hw) + shift).astype(np.float32)
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
        near = beyond_face_rad(bearings, tile_idx) < _OWNED_SLACK_PX / tile.focal_px
        mask[first : first + 256] = np.where(near, np.uint8(255), np.uint8(0))
    return mask
