"""Render a mesh as a panorama, with the colours of its vertices or with its texture."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.mesh.atlas import Atlas
from pano_mvs.algorithms.mesh.visibility import SurfaceView
from pano_mvs.core.arrays import Picture

_ROWS_AT_ONCE = 256


def picture_from_vertices(view: SurfaceView, faces: NDArray[np.int32], colors_rgb: Picture) -> Picture:
    """Return the picture (H, W, 3) of a mesh with coloured vertices, interpolated linearly; black without a surface.

    Args:
        view: what the panorama sees of the mesh.
        faces: (F, 3) positions of vertices.
        colors_rgb: (V, 3) uint8.
    """
    picture = np.zeros((*view.triangle.shape, 3), np.uint8)
    for rows in _bands(view):
        seen = view.triangle[rows] >= 0
        corners = colors_rgb.astype(np.float32)[faces[view.triangle[rows][seen]]]
        picture[rows][seen] = np.rint(_interpolated(corners, view.weights[rows][seen]))
    return picture


def picture_from_texture(view: SurfaceView, atlas: Atlas, texture: Picture) -> Picture:
    """Return the picture (H, W, 3) of a textured mesh, looked up bilinearly; black without a surface.

    Args:
        view: what the panorama sees of the mesh.
        atlas: the unwrapped mesh, with the triangles of the mesh in their order.
        texture: (H, W, 3) uint8, in the size of the atlas.
    """
    picture = np.zeros((*view.triangle.shape, 3), np.uint8)
    corners_px = atlas.uv_px.astype(np.float32)
    for rows in _bands(view):
        seen = view.triangle[rows] >= 0
        at = _interpolated(corners_px[np.maximum(view.triangle[rows], 0)], view.weights[rows]) - np.float32(0.5)
        looked_up = cv2.remap(texture, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        picture[rows][seen] = looked_up[seen]
    return picture


def reduced_picture(picture: Picture, covered: NDArray[np.bool_], *, factor: int) -> tuple[Picture, NDArray[np.bool_]]:
    """Return a picture, and where it is covered, averaged over blocks of `factor` × `factor` pixels.

    A pixel is covered if more than half of its block is; its colour is the mean of the covered part.
    """
    if factor == 1:
        return picture, covered
    height, width = covered.shape[0] // factor, covered.shape[1] // factor
    blocks = (height, factor, width, factor)
    share = covered.reshape(blocks).mean(axis=(1, 3))
    sums = (picture * covered[..., None]).reshape(*blocks, 3).mean(axis=(1, 3))
    mean = sums / np.maximum(share, 1e-9)[..., None]
    return np.rint(mean).astype(np.uint8), share > 0.5


def _bands(view: SurfaceView) -> list[slice]:
    return [slice(first, first + _ROWS_AT_ONCE) for first in range(0, len(view.triangle), _ROWS_AT_ONCE)]


def _interpolated(corners: NDArray[np.float32], weights: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return values (..., C) between those of three corners (..., 3, C)."""
    second, third = weights[..., 0, None], weights[..., 1, None]
    first = 1 - second - third
    return np.asarray(first * corners[..., 0, :] + second * corners[..., 1, :] + third * corners[..., 2, :])
