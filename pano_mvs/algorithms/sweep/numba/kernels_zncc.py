"""Compiled: zero-mean normalised cross-correlation by running sums."""

from __future__ import annotations

import numpy as np

from pano_mvs.algorithms.sweep.costs.kernels_constants import ZNCC_NOISE_VARIANCE
from pano_mvs.algorithms.sweep.numba.kernels_cost import box_rows
from pano_mvs.algorithms.sweep.numba.kernels_records import F32, I32, I64, U8, U16
from pano_mvs.core.kernels import kernel

_F = np.float32
_U = np.uint64


@kernel
def zncc_rows(
    first: int, reference: U8, warped: U8, reach: I64, radius: int, pad: int, products: U16, scratch: I32, means: F32
) -> None:
    """Write 1 − ρ of a band, ρ the correlation of reference and warped source over each pixel's window.

    ρ = cov(r, w) / √((var r + ν)(var w + ν)), ν the variance of noise: what is bare correlates with nothing.

    Args:
        first: the first row of the band.
        reference: (H + 2 pad, W + 2 pad) uint8 grey, padded over seam and poles.
        warped: (rows + 2 radius, W + 2 pad) uint8.
        reach: (rows,) int64 columns of each row's window on either side.
        radius: rows of the window on either side.
        pad: the margin.
        products: (rows + 2 radius, W + 2 pad) uint16, scratch.
        scratch: (2, W + 2 pad) int32.
        means: (rows, W) float32, written.
    """
    rows, width = means.shape
    ours = reference[first + pad - radius : first + pad + radius + rows]
    sums = np.empty((4, rows, width), np.float32)
    pairs = ((ours, ours), (warped, warped), (ours, warped))
    for k in range(3):
        _multiply(pairs[k][0], pairs[k][1], products)
        box_rows(products, reach, radius, pad, scratch[0], scratch[1], sums[k])
    _copy(ours, products)
    box_rows(products, reach, radius, pad, scratch[0], scratch[1], sums[3])
    _copy(warped, products)
    box_rows(products, reach, radius, pad, scratch[0], scratch[1], means)
    noise = _F(ZNCC_NOISE_VARIANCE)
    for y in range(_U(rows)):
        for i in range(_U(width)):
            r, w = sums[3, y, i], means[y, i]
            var_r, var_w = max(sums[0, y, i] - r * r, _F(0)), max(sums[1, y, i] - w * w, _F(0))
            rho = (sums[2, y, i] - r * w) / np.sqrt((var_r + noise) * (var_w + noise))
            means[y, i] = _F(1) - min(max(rho, _F(-1)), _F(1))


@kernel
def _copy(one: U8, products: U16) -> None:
    for j in range(_U(products.shape[0])):
        for i in range(_U(products.shape[1])):
            products[j, i] = np.uint16(one[j, i])


@kernel
def _multiply(one: U8, other: U8, products: U16) -> None:
    for j in range(_U(products.shape[0])):
        for i in range(_U(products.shape[1])):
            products[j, i] = np.uint16(np.uint16(one[j, i]) * np.uint16(other[j, i]))
