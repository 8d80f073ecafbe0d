"""Gaussian smoothing of a panorama, isotropic on the sphere."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft

from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import pad_panorama

_PIXEL_STD = np.sqrt(1 / 12)  # standard deviation of a box one pixel wide


def smooth_panorama(panorama: NDArray[np.uint8], sigmas_px: FloatArray) -> list[NDArray[np.uint8]]:
    """Smooth a panorama by Gaussians, with one result for each width.

    Rows are smoothed by 1 / cos φ times as many pixels as columns. Towards the poles, the pixels of a row are narrower
    than at the equator; the additional sharpness along the row is removed as well, so that noise and detail are
    isotropic. Only within about two standard deviations of a pole is the smoothing weaker, because the rows are such
    small circles there.

    Args:
        panorama: (H, W) uint8, the full sphere.
        sigmas_px: (S,) standard deviations in pixels at the equator, not negative.

    Returns:
        S arrays (H, W) uint8.
    """
    height, width = panorama.shape
    spectrum = fft.rfft(panorama.astype(np.float32), axis=1)
    elevation = np.pi * (0.5 - (np.arange(height) + 0.5) / height)
    frequency = np.arange(spectrum.shape[1]) * (2 * np.pi / width)
    cosine = np.cos(elevation)[:, None]
    smoothed = []
    for sigma_px in sigmas_px:
        spread = (sigma_px**2 + (_PIXEL_STD * np.sin(elevation[:, None])) ** 2) / cosine**2
        decay = np.exp(-0.5 * spread * frequency**2).astype(np.float32)
        rows = fft.irfft(spectrum * decay, n=width, axis=1)
        smoothed.append(np.rint(_smooth_columns(rows, float(sigma_px))).clip(0, 255).astype(np.uint8))
    return smoothed


def _smooth_columns(panorama: NDArray[np.float32], sigma_px: float) -> NDArray[np.float32]:
    reach = min(int(np.ceil(4 * sigma_px)), *panorama.shape)
    if reach == 0:
        return panorama
    kernel = cv2.getGaussianKernel(2 * reach + 1, sigma_px)
    padded = pad_panorama(panorama, reach)
    smoothed = cv2.sepFilter2D(padded, -1, np.ones(1), kernel)
    return np.asarray(smoothed[reach:-reach, reach:-reach], np.float32)
