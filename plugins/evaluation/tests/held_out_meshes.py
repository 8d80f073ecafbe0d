"""Scores of a mesh at the pose of a panorama that was not used to make it."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.mesh.atlas import Atlas
from pano_mvs.algorithms.mesh.surface import Mesh
from pano_mvs.algorithms.mesh.texture import TexturedMesh
from pano_mvs.algorithms.mesh.view_quality import SurfaceView, surface_view
from pano_mvs.core.arrays import Picture
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3, pad_panorama, pixel_solid_angle

# Of Z. Wang et al., section III C: a window of 11 × 11 pixels, and the constants for 8 bits.
_SIGMA_PX, _RADIUS_PX = 1.5, 5
_C1, _C2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2
_LUMA = np.array([0.299, 0.587, 0.114], np.float32)


@dataclass(frozen=True, slots=True)
class PictureScores:
    """The similarity of two pictures.

    Attributes:
        psnr_db: peak signal-to-noise ratio of all channels; infinite if the pictures are equal.
        ssim: structural similarity of the luma, at most 1.
        share: share of the sphere that was compared.
    """

    psnr_db: float
    ssim: float
    share: float


def picture_scores(picture: Picture, truth: Picture, *, compared: NDArray[np.bool_] | None = None) -> PictureScores:
    """Compare two panoramas.

    Z. Wang, A. C. Bovik, H. R. Sheikh, E. P. Simoncelli, "Image quality assessment: from error visibility to structural
    similarity", IEEE Transactions on Image Processing 13(4), 2004. Pixels count by their solid angle, and windows
    continue across the seam and the poles.

    Args:
        picture: (H, W, 3) uint8.
        truth: (H, W, 3) uint8.
        compared: (H, W) pixels that count; None: all. SSIM windows also see the pixels around them.

    Raises:
        UsageError: if the sizes differ, or no pixel counts.
    """
    if picture.shape != truth.shape or picture.ndim != 3:
        raise UsageError(f"pictures of one size are compared, got {picture.shape} and {truth.shape}")
    mask = np.ones(truth.shape[:2], np.bool_) if compared is None else compared
    weights = mask * pixel_solid_angle((truth.shape[0], truth.shape[1]))[:, None]
    total = float(weights.sum())
    if not total > 0:
        raise UsageError("no pixel is compared: the mesh does not cover the panorama")
    squared = np.square(picture.astype(np.float64) - truth).mean(axis=-1)
    error = float((squared * weights).sum() / total)
    psnr = float(10 * np.log10(255.0**2 / error)) if error else float("inf")
    similarity = _ssim_map(picture.astype(np.float32) @ _LUMA, truth.astype(np.float32) @ _LUMA)
    return PictureScores(psnr, float((similarity * weights).sum() / total), total / (4 * np.pi))


def _ssim_map(first: NDArray[np.float32], second: NDArray[np.float32]) -> NDArray[np.float64]:
    a, b = first.astype(np.float64), second.astype(np.float64)
    mean_a, mean_b = _window_mean(a), _window_mean(b)
    variance_a, variance_b = _window_mean(a * a) - mean_a**2, _window_mean(b * b) - mean_b**2
    covariance = _window_mean(a * b) - mean_a * mean_b
    return np.asarray(
        (2 * mean_a * mean_b + _C1)
        * (2 * covariance + _C2)
        / ((mean_a**2 + mean_b**2 + _C1) * (variance_a + variance_b + _C2))
    )


def _window_mean(values: NDArray[np.float64]) -> NDArray[np.float64]:
    margin = min(_RADIUS_PX, values.shape[0])
    side = 2 * _RADIUS_PX + 1
    blurred = cv2.GaussianBlur(pad_panorama(values, margin), (side, side), _SIGMA_PX)
    return np.asarray(blurred[margin:-margin, margin:-margin], np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class HeldOutScores:
    """The comparison of a rendered mesh with a panorama.

    Attributes:
        everywhere: of all valid pixels; the mesh is black where it has a hole.
        covered: of the valid pixels that the mesh covers; None if it covers none.
        picture: (H, W, 3) the rendered mesh.
    """

    everywhere: PictureScores
    covered: PictureScores | None
    picture: Picture


def rendered_panorama(
    mesh: Mesh | TexturedMesh,
    cam_from_world: Rigid3,
    *,
    size_hw: tuple[int, int],
    supersampling: int = 2,
    threads: int = 1,
) -> tuple[Picture, NDArray[np.bool_]]:
    """Return the picture (H, W, 3) of a mesh as a panorama, and the pixels (H, W) that it covers.

    Args:
        mesh: with coloured vertices or with a texture; it is visible from both sides.
        cam_from_world: pose of the panorama.
        size_hw: (height, width) of the panorama.
        supersampling: number of rays per pixel along each side.
        threads: number of threads; the result does not depend on it.
    """
    size = size_hw[0] * supersampling, size_hw[1] * supersampling
    view = surface_view(mesh.vertices_in_world, mesh.faces, cam_from_world, size_hw=size, threads=threads)
    if isinstance(mesh, TexturedMesh):
        picture = picture_from_texture(view, mesh.atlas, mesh.texture)
    else:
        picture = picture_from_vertices(view, mesh.faces, mesh.colors_rgb)
    return reduced_picture(picture, view.triangle >= 0, factor=supersampling)


def held_out_scores(
    mesh: Mesh | TexturedMesh,
    cam_from_world: Rigid3,
    panorama: Picture,
    *,
    valid: NDArray[np.bool_] | None = None,
    threads: int = 1,
) -> HeldOutScores:
    """Render a mesh at the pose of a panorama and compare both.

    Args:
        mesh: with coloured vertices or with a texture.
        cam_from_world: pose of the panorama.
        panorama: (H, W, 3) uint8 RGB.
        valid: (H, W) pixels of the panorama that count; None: all.
        threads: number of threads; the result does not depend on it.
    """
    size_hw = panorama.shape[0], panorama.shape[1]
    picture, covered = rendered_panorama(mesh, cam_from_world, size_hw=size_hw, threads=threads)
    counted = np.ones(size_hw, np.bool_) if valid is None else valid
    both = covered & counted
    everywhere = picture_scores(picture, panorama, compared=counted)
    return HeldOutScores(everywhere, picture_scores(picture, panorama, compared=both) if both.any() else None, picture)


_ROWS_AT_ONCE = 256


def picture_from_vertices(view: SurfaceView, faces: NDArray[np.int32], colors_rgb: Picture) -> Picture:
    """Return the picture (H, W, 3) of a mesh with coloured vertices, interpolated linearly; black without a surface.

    `view`: what the panorama sees of the mesh. `faces`: (F, 3) positions of vertices. `colors_rgb`: (V, 3) uint8.
    """
    picture = np.zeros((*view.triangle.shape, 3), np.uint8)
    for rows in _bands(view):
        seen = view.triangle[rows] >= 0
        corners = colors_rgb.astype(np.float32)[faces[view.triangle[rows][seen]]]
        picture[rows][seen] = np.rint(_interpolated(corners, view.weights[rows][seen]))
    return picture


def picture_from_texture(view: SurfaceView, atlas: Atlas, texture: Picture) -> Picture:
    """Return the picture (H, W, 3) of a textured mesh, looked up bilinearly; black without a surface.

    `view`: what the panorama sees of the mesh. `atlas`: the unwrapped mesh, with the triangles of the mesh in their
    order. `texture`: (H, W, 3) uint8, in the size of the atlas.
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
