"""Smoothing a panorama by the same angle in all directions and everywhere."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft

from pano_mvs.geometry import pad_panorama

FloatArray = NDArray[np.float64]

_PIXEL_STD = np.sqrt(1 / 12)  # of a box one pixel wide


def smooth_panorama(panorama: NDArray[np.uint8], sigmas_px: FloatArray) -> list[NDArray[np.uint8]]:
    """Return a panorama smoothed by Gaussians, one picture for each width.

    Rows are smoothed by 1 / cos φ as many pixels as columns. Towards the poles a row's pixels are narrower than those
    of the equator; what that adds in sharpness along the row is taken away as well, so that noise and detail are alike
    in all directions. Only within about two standard deviations of a pole is the smoothing weaker than elsewhere, for
    there the rows are circles so small that they are smoothed towards no other place.

    Args:
        panorama: (H, W) uint8, the full sphere.
        sigmas_px: (S,) standard deviations in pixels at the equator, 0 or more.

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
