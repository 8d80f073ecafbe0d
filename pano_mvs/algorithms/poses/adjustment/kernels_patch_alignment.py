"""Compiled: sampling of patches of a panorama, and their alignment by Lucas–Kanade with an affine warp."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.kernels import kernel
from pano_mvs.geometry.kernels_sphere import pixel_from_ray

_PARAMETERS = 6
_ITERATIONS, _CONVERGED = 12, 0.003


@kernel
def _cubic(t: float, weights: FloatArray) -> None:
    """Write the weights of cubic convolution (a = −1/2) of four neighbours, at a position t past the second."""
    weights[0] = t * (-0.5 + t * (1.0 - 0.5 * t))
    weights[1] = 1.0 + t * t * (-2.5 + 1.5 * t)
    weights[2] = t * (0.5 + t * (2.0 - 1.5 * t))
    weights[3] = t * t * (-0.5 + 0.5 * t)


@kernel
def _sample(image: NDArray[np.float32], column: float, row: float, across: FloatArray, down: FloatArray) -> float:
    """Return the value at a position, in rows and columns of the array; overwrites the weights `across` and `down`."""
    left, top = int(np.floor(column)), int(np.floor(row))
    _cubic(column - left, across)
    _cubic(row - top, down)
    value = 0.0
    for v in range(4):
        line = 0.0
        for u in range(4):
            line += across[u] * image[top - 1 + v, left - 1 + u]
        value += down[v] * line
    return value


@kernel
def sample_patches(
    padded: NDArray[np.float32],
    pad_px: int,
    middles: FloatArray,
    first_axes: FloatArray,
    second_axes: FloatArray,
    patches: NDArray[np.float32],
) -> None:
    """Fill patches (M, n, n) from a panorama with a margin, by cubic convolution.

    Entry (j, i) of patch m is the panorama along the ray middles[m] + (i − k) first_axes[m] + (j − k) second_axes[m],
    k = (n − 1) / 2, in the camera frame.
    """
    height, width = padded.shape[0] - 2 * pad_px, padded.shape[1] - 2 * pad_px
    size = patches.shape[1]
    half = (size - 1) // 2
    across, down = np.empty(4), np.empty(4)
    for m in range(len(middles)):
        for j in range(size):
            for i in range(size):
                a, b = i - half, j - half
                x = middles[m, 0] + a * first_axes[m, 0] + b * second_axes[m, 0]
                y = middles[m, 1] + a * first_axes[m, 1] + b * second_axes[m, 1]
                z = middles[m, 2] + a * first_axes[m, 2] + b * second_axes[m, 2]
                x_px, y_px = pixel_from_ray(x, y, z, height, width)
                patches[m, j, i] = _sample(padded, x_px - 0.5 + pad_px, y_px - 0.5 + pad_px, across, down)


@kernel
def _factorise(matrix: FloatArray) -> None:
    """Replace a symmetric positive definite matrix by its Cholesky factor L; entries above the diagonal stay."""
    size = len(matrix)
    for j in range(size):
        for k in range(j):
            matrix[j, j] -= matrix[j, k] * matrix[j, k]
        matrix[j, j] = np.sqrt(matrix[j, j])
        for i in range(j + 1, size):
            for k in range(j):
                matrix[i, j] -= matrix[i, k] * matrix[j, k]
            matrix[i, j] /= matrix[j, j]


@kernel
def _substitute(factor: FloatArray, vector: FloatArray) -> None:
    """Replace a vector v by the solution of L Lᵀ x = v."""
    size = len(vector)
    for i in range(size):
        for k in range(i):
            vector[i] -= factor[i, k] * vector[k]
        vector[i] /= factor[i, i]
    for i in range(size - 1, -1, -1):
        for k in range(i + 1, size):
            vector[i] -= factor[k, i] * vector[k]
        vector[i] /= factor[i, i]


@kernel
def _normalised(values: FloatArray, window: FloatArray, total: float) -> float:
    """Normalise values to weighted mean 0 and variance 1; return their original standard deviation."""
    mean = 0.0
    for k in range(len(values)):
        mean += window[k] * values[k]
    mean /= total
    variance = 0.0
    for k in range(len(values)):
        values[k] -= mean
        variance += window[k] * values[k] * values[k]
    deviation: float = np.sqrt(variance / total)
    for k in range(len(values)):
        values[k] /= deviation + 1e-12
    return deviation


@kernel
def _warped(patch: NDArray[np.float32], warp: FloatArray, size: int, margin: int, values: FloatArray) -> bool:
    """Write the inner size × size samples of a patch under an affine warp; return False if it leaves the patch."""
    outer = patch.shape[0]
    half = (size - 1) // 2
    across, down = np.empty(4), np.empty(4)
    for j in range(size):
        for i in range(size):
            a, b = i - half, j - half
            column = warp[0] + warp[2] * a + warp[3] * b + half + margin
            row = warp[1] + warp[4] * a + warp[5] * b + half + margin
            left, top = int(np.floor(column)), int(np.floor(row))
            if left < 1 or top < 1 or left + 2 >= outer or top + 2 >= outer:
                return False
            values[j * size + i] = _sample(patch, column, row, across, down)
    return True


@kernel
def _prepare(
    reference: NDArray[np.float32],
    size: int,
    margin: int,
    weights: FloatArray,
    total: float,
    template: FloatArray,
    columns: FloatArray,
) -> float:
    """Write the normalised template and its derivatives by the warp, less gain and offset; return its contrast."""
    half = (size - 1) // 2
    for j in range(size):
        for i in range(size):
            template[j * size + i] = reference[j + margin, i + margin]
    contrast: float = _normalised(template, weights, total)
    for j in range(size):
        for i in range(size):
            row, column, k = j + margin, i + margin, j * size + i
            du = 0.5 * (reference[row, column + 1] - reference[row, column - 1]) / (contrast + 1e-12)
            dv = 0.5 * (reference[row + 1, column] - reference[row - 1, column]) / (contrast + 1e-12)
            a, b = i - half, j - half
            columns[k, 0], columns[k, 2], columns[k, 3] = du, du * a, du * b
            columns[k, 1], columns[k, 4], columns[k, 5] = dv, dv * a, dv * b
    for p in range(_PARAMETERS):
        mean, along = 0.0, 0.0
        for k in range(size * size):
            mean += weights[k] * columns[k, p]
            along += weights[k] * columns[k, p] * template[k]
        for k in range(size * size):
            columns[k, p] -= mean / total + along / total * template[k]
    return contrast


@kernel
def _normal_matrix(columns: FloatArray, weights: FloatArray, stiffness: float, matrix: FloatArray) -> None:
    """Write Jᵀ W J plus the prior on the linear part of the warp."""
    for p in range(_PARAMETERS):
        for q in range(p + 1):
            entry = 0.0
            for k in range(len(weights)):
                entry += weights[k] * columns[k, p] * columns[k, q]
            matrix[p, q] = entry
            matrix[q, p] = entry
        matrix[p, p] += stiffness if p > 1 else 1e-9


@kernel
def _largest_deviation(factor: FloatArray, unit: FloatArray) -> float:
    """Return the root of the largest eigenvalue of the shift's block of the inverse of L Lᵀ."""
    unit[:] = 0.0
    unit[0] = 1.0
    _substitute(factor, unit)
    first, mixed = unit[0], unit[1]
    unit[:] = 0.0
    unit[1] = 1.0
    _substitute(factor, unit)
    second = unit[1]
    deviation: float = np.sqrt(0.5 * (first + second) + np.sqrt(0.25 * (first - second) ** 2 + mixed * mixed))
    return deviation


@kernel
def _compose(warp: FloatArray, step: FloatArray) -> bool:
    """Replace W by W ∘ Δ⁻¹, Δ x = (I + E) x + e with the step (e, E); return False if Δ folds the patch."""
    e00, e01, e10, e11 = 1.0 + step[2], step[3], step[4], 1.0 + step[5]
    determinant = e00 * e11 - e01 * e10
    if not determinant > 0.1:
        return False
    i00, i01, i10, i11 = e11 / determinant, -e01 / determinant, -e10 / determinant, e00 / determinant
    s0, s1 = -(i00 * step[0] + i01 * step[1]), -(i10 * step[0] + i11 * step[1])
    w0, w1, w2, w3 = warp[2], warp[3], warp[4], warp[5]
    warp[0] += w0 * s0 + w1 * s1
    warp[1] += w2 * s0 + w3 * s1
    warp[2], warp[3] = w0 * i00 + w1 * i10, w0 * i01 + w1 * i11
    warp[4], warp[5] = w2 * i00 + w3 * i10, w2 * i01 + w3 * i11
    return True


@kernel
def _align(
    target: NDArray[np.float32],
    size: int,
    margin: int,
    weights: FloatArray,
    total: float,
    stiffness: float,
    factor: FloatArray,
    template: FloatArray,
    columns: FloatArray,
    values: FloatArray,
    step: FloatArray,
    warp: FloatArray,
) -> float:
    """Write the warp that aligns a patch with the template; return their correlation, 0 if it leaves the patch."""
    warp[:] = 0.0
    warp[2], warp[5] = 1.0, 1.0
    for _ in range(_ITERATIONS):
        if not _warped(target, warp, size, margin, values):
            return 0.0
        _normalised(values, weights, total)
        for p in range(_PARAMETERS):
            entry = 0.0
            for k in range(len(weights)):
                entry += weights[k] * columns[k, p] * (values[k] - template[k])
            step[p] = entry
        step[2] += stiffness * (warp[2] - 1.0)
        step[3] += stiffness * warp[3]
        step[4] += stiffness * warp[4]
        step[5] += stiffness * (warp[5] - 1.0)
        _substitute(factor, step)
        if not _compose(warp, step):
            return 0.0
        if abs(step[0]) < _CONVERGED and abs(step[1]) < _CONVERGED:
            break
    if not _warped(target, warp, size, margin, values):
        return 0.0
    _normalised(values, weights, total)
    correlation = 0.0
    for k in range(len(weights)):
        correlation += weights[k] * values[k] * template[k]
    return correlation / total


@kernel
def align_patches(
    patches: NDArray[np.float32],
    reference_idx: NDArray[np.intp],
    target_idx: NDArray[np.intp],
    window: FloatArray,
    stiffness: float,
    shifts: FloatArray,
    correlations: FloatArray,
    deviations: FloatArray,
) -> None:
    """Align patches with reference patches by inverse compositional Gauss–Newton, invariant to gain and offset.

    Baker & Matthews, "Lucas–Kanade 20 Years On: A Unifying Framework", 2004, section 3.2. `patches`
    (T, n + 2 m, n + 2 m) have a margin of m samples around the n × n that the `window` (n, n) weights. `stiffness` is
    the weight of the prior that keeps the linear part of the warp near the identity, for a contrast of 1.

    Writes for every target: shifts (M, 2) of its centre in samples; correlations (M,) after alignment, 0 without
    contrast or if the warp left the patch; and standard deviations (M,) of the shift along its least certain axis, for
    noise as large as the contrast.
    """
    size = window.shape[0]
    margin = (patches.shape[1] - size) // 2
    weights = window.ravel()
    total = weights.sum()
    template, values = np.empty(size * size), np.empty(size * size)
    columns, factor = np.empty((size * size, _PARAMETERS)), np.empty((_PARAMETERS, _PARAMETERS))
    step, warp = np.empty(_PARAMETERS), np.empty(_PARAMETERS)
    for m in range(len(target_idx)):
        shifts[m, :] = 0.0
        correlations[m], deviations[m] = 0.0, np.inf
        contrast = _prepare(patches[reference_idx[m]], size, margin, weights, total, template, columns)
        if contrast < 0.5:  # grey levels
            continue
        _normal_matrix(columns, weights, stiffness, factor)
        _factorise(factor)
        deviations[m] = _largest_deviation(factor, step)
        correlations[m] = _align(
            patches[target_idx[m]],
            size,
            margin,
            weights,
            total,
            stiffness,
            factor,
            template,
            columns,
            values,
            step,
            warp,
        )
        if correlations[m] != 0.0:
            shifts[m, 0], shifts[m, 1] = warp[0], warp[1]
