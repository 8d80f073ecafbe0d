"""Resampling of panoramas: the seam wraps, the poles reflect with a half-turn, no border exists."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pano_mvs.core.errors import UsageError
from pano_mvs.geometry.sphere import pixel_from_ray, ray_grid

Scalar = TypeVar("Scalar", bound=np.generic)


def pad_panorama(panorama: NDArray[Scalar], pad_px: int) -> NDArray[Scalar]:
    """Return a panorama with a margin in which it goes on over the seam and over the poles.

    Args:
        panorama: (H, W, ...) with even W, the full sphere.
        pad_px: width of the margin on all four sides, at most H.

    Returns:
        (H + 2 pad, W + 2 pad, ...), of the same type.

    Raises:
        UsageError: if W is odd (then no column lies exactly half a turn away) or the margin is wider than H.

    >>> pad_panorama(np.array([[1, 2, 3, 4], [5, 6, 7, 8]]), 1)
    array([[2, 3, 4, 1, 2, 3],
           [4, 1, 2, 3, 4, 1],
           [8, 5, 6, 7, 8, 5],
           [6, 7, 8, 5, 6, 7]])
    """
    height, width = panorama.shape[:2]
    if width % 2 or not 0 <= pad_px <= min(height, width):
        raise UsageError(
            f"cannot pad a {width}×{height} panorama by {pad_px} px: the width must be even, the margin "
            f"at most the height"
        )
    padded = np.empty((height + 2 * pad_px, width + 2 * pad_px, *panorama.shape[2:]), panorama.dtype)
    inner = slice(pad_px, pad_px + width)
    padded[pad_px : pad_px + height, inner] = panorama
    padded[:pad_px, inner] = np.roll(panorama[:pad_px], width // 2, axis=1)[::-1]
    padded[pad_px + height :, inner] = np.roll(panorama[height - pad_px :], width // 2, axis=1)[::-1]
    padded[:, :pad_px] = padded[:, width : width + pad_px]
    padded[:, pad_px + width :] = padded[:, pad_px : 2 * pad_px]
    return padded


def sample_panorama(panorama: NDArray[np.generic], pixels_px: ArrayLike) -> NDArray[np.float64]:
    """Return a panorama's values between its pixels, bilinear, over the seam and over the poles.

    Args:
        panorama: (H, W) or (H, W, C), any real type, even W. A NaN neighbour with a weight makes the sample NaN.
        pixels_px: (..., 2) positions (x, y), (0, 0) the upper-left corner; any x (it wraps), y in [0, H], beyond which
            the poles are sampled.

    Returns:
        (...,) or (..., C) float64.

    >>> sample_panorama(np.array([[1.0, 2.0, 3.0, 4.0]]), np.array([[1.5, 0.5], [2.0, 0.5], [0.0, 0.5]])).tolist()
    [2.0, 2.5, 2.5]
    """
    pixels = np.asarray(pixels_px, dtype=np.float64)
    height, width = panorama.shape[:2]
    padded: NDArray[Any] = pad_panorama(panorama, 1)
    x = np.mod(pixels[..., 0], width) + 0.5
    y = np.clip(pixels[..., 1], 0, height) + 0.5
    column, row = np.floor(x).astype(np.intp), np.floor(y).astype(np.intp)
    weight_x, weight_y = x - column, y - row
    if panorama.ndim == 3:
        weight_x, weight_y = weight_x[..., None], weight_y[..., None]
    flat, first = padded.reshape(-1, *panorama.shape[2:]), row * padded.shape[1] + column
    finite = padded.dtype.kind != "f" or bool(np.isfinite(padded).all())
    result = np.zeros(np.broadcast_shapes(weight_x.shape, (*pixels.shape[:-1], *panorama.shape[2:])))
    for d_row, w_row in ((0, 1 - weight_y), (1, weight_y)):
        for d_column, w_column in ((0, 1 - weight_x), (1, weight_x)):
            weight = w_row * w_column
            value = weight * np.take(flat, first + (d_row * padded.shape[1] + d_column), axis=0)
            result += value if finite else np.where(weight > 0, value, 0.0)
    return result


def rotate_panorama(panorama: NDArray[Scalar], new_from_old: ArrayLike) -> NDArray[Scalar]:
    """Return the panorama as the same camera would see it after a turn about its centre (bilinear).

    Args:
        panorama: (H, W) or (H, W, C), the full sphere.
        new_from_old: (3, 3) rotation; a ray r of the old frame appears as new_from_old @ r in the new one.

    Returns:
        An array of the same shape and type; integers are rounded.
    """
    rotation = np.asarray(new_from_old, dtype=np.float64)
    height, width = panorama.shape[:2]
    rays_in_old = ray_grid((height, width)) @ rotation
    sampled = sample_panorama(panorama, pixel_from_ray(rays_in_old, (height, width)))
    if np.issubdtype(panorama.dtype, np.integer):
        sampled = np.rint(sampled)  # bilinear weights sum to 1, so no clipping is needed
    return sampled.astype(panorama.dtype)


def roll_panorama(panorama: NDArray[Scalar], columns: int) -> tuple[NDArray[Scalar], NDArray[np.float64]]:
    """Return a panorama rolled to the right by whole columns, and the rotation new_from_old (3, 3) that this is.

    A camera known as cam_from_world becomes new_from_old @ cam_from_world (rotation and translation).

    >>> panorama, new_from_old = roll_panorama(np.array([[1, 2, 3, 4]]), 1)
    >>> panorama.tolist(), (new_from_old @ [0, 0, 1]).round(6).tolist()
    ([[4, 1, 2, 3]], [1.0, 0.0, 0.0])
    """
    width = panorama.shape[1]
    angle = 2 * np.pi * columns / width
    cosine, sine = np.cos(angle), np.sin(angle)
    new_from_old = np.array([[cosine, 0.0, sine], [0.0, 1.0, 0.0], [-sine, 0.0, cosine]])
    return np.roll(panorama, columns, axis=1), new_from_old
