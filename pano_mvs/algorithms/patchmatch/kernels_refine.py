"""Compiled: the most likely planes of the pixels of some rows, given the pictures and the current planes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.patchmatch.kernels_match import (
    STRETCH,
    SUM_AB,
    SUM_B,
    SUM_BB,
    SUM_G,
    SUM_GA,
    SUM_GB,
    SUM_GG,
    SUMS,
    Sources,
    sum_windows,
    weigh_window,
)
from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.kernels import inlined, kernel
from pano_mvs.geometry.kernels_sphere import azimuth_from_x, elevation_from_y, wrapped_column, wrapped_row

_F = np.float32
_U = np.uint64
# Number of pixels of a row whose planes are fitted together, so that their windows fit the cache.
_FIT_STRETCH = 128


@kernel
def sines_of_columns(width: int) -> FloatArray:
    """Return the sine and the cosine of the azimuth of each column, (2, W)."""
    turned = np.empty((2, width))
    for x in range(width):
        azimuth = azimuth_from_x(x + 0.5, width)
        turned[0, x], turned[1, x] = np.sin(azimuth), np.cos(azimuth)
    return turned


@kernel
def _padded_rows(inverse: NDArray[np.float32], first: int, rows: int, pad: int) -> NDArray[np.float32]:
    """Return some rows of an image with `pad` columns more on either side, beyond the poles and the seam too."""
    height, width = inverse.shape
    padded = np.empty((rows, width + 2 * pad), np.float32)
    for y in range(rows):
        row = wrapped_row(first + y, height)
        for x in range(width + 2 * pad):
            padded[y, x] = inverse[row, wrapped_column(first + y, x - pad, height, width)]
    return padded


@kernel
def _weigh(
    values: FloatArray, k: int, u: float, v: float, reach: float, slopes: FloatArray, products: FloatArray
) -> None:
    """Write Tukey's weights of one neighbour of each pixel, and those times its value, (2, n)."""
    neighbour = _U(k)
    for i in range(_U(values.shape[1])):
        value = values[neighbour, i]
        deviation = (value - slopes[0, i] - slopes[1, i] * u - slopes[2, i] * v) / reach
        rest = 1 - deviation * deviation
        inside = rest > 0  # NaN is not
        products[0, i] = rest * rest if inside else 0.0
        products[1, i] = rest * rest * value if inside else 0.0


@kernel
def _add_first(products: FloatArray, row: int, u: float, v: float, sums: FloatArray, first: int) -> None:
    """Add a row of `products`, alone and times u and v, to three rows of `sums` from `first` on."""
    p, s = _U(row), _U(first)
    for i in range(_U(products.shape[1])):
        value = products[p, i]
        sums[s, i] += value
        sums[s + _U(1), i] += value * u
        sums[s + _U(2), i] += value * v


@kernel
def _add_second(products: FloatArray, u: float, v: float, sums: FloatArray) -> None:
    """Add the weights times u², u v and v² to three rows of `sums`."""
    for i in range(_U(products.shape[1])):
        across = products[0, i] * u
        sums[3, i] += across * u
        sums[4, i] += across * v
        sums[5, i] += products[0, i] * v * v


@kernel
def _solve_slopes(sums: FloatArray, slopes: FloatArray) -> None:
    """Write the weighted means' planes (α, β, γ), (3, n), from the nine sums; ill posed ones stay as they are."""
    for i in range(_U(sums.shape[1])):
        n = max(sums[0, i], 1e-30)
        mu, mv, mq = sums[1, i] / n, sums[2, i] / n, sums[6, i] / n
        suu, suv, svv = sums[3, i] / n - mu * mu, sums[4, i] / n - mu * mv, sums[5, i] / n - mv * mv
        squ, sqv = sums[7, i] / n - mq * mu, sums[8, i] / n - mq * mv
        determinant = suu * svv - suv * suv
        # Minimum weight of the pixels of a plane, and minimum determinant of their covariance in u and v.
        if n >= 5.0 and determinant >= 0.25:
            beta, gamma = (svv * squ - suv * sqv) / determinant, (suu * sqv - suv * squ) / determinant
            slopes[0, i] = mq - beta * mu - gamma * mv
            slopes[1, i] = beta
            slopes[2, i] = gamma


@kernel
def weighted_slopes(
    values: FloatArray,
    offsets: NDArray[np.int64],
    stretch: float,
    tolerance: float,
    growth: float,
    slopes: FloatArray,
    scratch: tuple[FloatArray, FloatArray],
) -> None:
    """Improve the planes (α, β, γ) through the windows of a stretch of pixels.

    Weights are Tukey's biweight of the distance from the present planes, which is 0 from `tolerance` plus `growth` per
    step from the centre. The loops over the pixels are short and many, so that all of them are vectorised.

    `values`: (side², n) float64 of the windows. `offsets`: (side,) columns of the window. `stretch`: columns per step
    in u. `slopes`: (3, n) float64 α, β and γ, updated; those that are ill posed stay as they are. `scratch`: (2, n) and
    (9, n) float64.
    """
    products, sums = scratch
    side = len(offsets)
    radius = side // 2
    sums[:] = 0.0
    for k in range(side * side):
        step, v = k % side, k // side - radius
        u, reach = offsets[step] / stretch, tolerance + growth * max(abs(step - radius), abs(v))
        _weigh(values, k, u, float(v), reach, slopes, products)
        _add_first(products, 0, u, float(v), sums, 0)
        _add_second(products, u, float(v), sums)
        _add_first(products, 1, u, float(v), sums, 6)
    _solve_slopes(sums, slopes)


@kernel
def fit_slopes(
    padded: NDArray[np.float32],
    place: tuple[int, int, int],
    offsets: NDArray[np.int64],
    stretch: float,
    max_step: float,
    slopes: FloatArray,
) -> None:
    """Write (α, β, γ), (3, n), of the planes through the inverse ranges around pixels, robustly, in units of their own.

    First fit the neighbours that differ from the pixel by less than `max_step` per step plus one, then those within
    `max_step` of that plane. With too few neighbours q stays as it is, and the surface faces the camera.

    `padded`: rows of inverse ranges, see `_padded_rows`. `place`: the row, the first pixel and the number of columns
    beyond the seam, in `padded`. `offsets`: (side,) columns of the window. `stretch`: columns per step in u. `slopes`:
    (3, n) float64, written.
    """
    row, first, pad = place
    side, n = len(offsets), slopes.shape[1]
    values, scratch = np.empty((side * side, n)), (np.empty((2, n)), np.empty((9, n)))
    center = _U(first + pad)
    for k in range(side * side):
        y, start = _U(row + k // side - side // 2), _U(first + pad + offsets[k % side])
        for i in range(_U(n)):
            values[_U(k), i] = np.float64(padded[y, start + i]) / np.float64(padded[_U(row), center + i])
    slopes[0] = 1.0
    slopes[1:] = 0.0
    weighted_slopes(values, offsets, stretch, max_step, max_step, slopes, scratch)
    weighted_slopes(values, offsets, stretch, max_step, 0.0, slopes, scratch)


@kernel
def fit_planes(
    inverse: NDArray[np.float32],
    first: int,
    rows: int,
    offsets: NDArray[np.int64],
    stretches: FloatArray,
    max_step: float,
    planes: NDArray[np.float32],
    part: tuple[int, int],
) -> None:
    """Write the planes of some rows, (3, H, W) float32; 0, the plane at infinity, where the range is unknown.

    `inverse`: (H, W) float32 1 / range, NaN where unknown. `first`: the first row. `rows`: number of rows. `offsets`:
    (H, side) int64 columns of the window. `stretches`: (H,) float64 columns per step in u. `max_step`: see
    `fit_slopes`. `planes`: (3, H, W) float32, written. `part`: the row of the panorama with which the arrays begin, and
    the number of its rows; (0, H) if the arrays are whole.
    """
    width, (top, height) = inverse.shape[1], part
    radius, pad = offsets.shape[1] // 2, offsets[first : first + rows].max()
    padded = _padded_rows(inverse, first - radius, rows + 2 * radius, pad)
    turned = sines_of_columns(width)
    for row in range(first, first + rows):
        elevation = elevation_from_y(top + row + 0.5, height)
        level, dip, stretch = np.cos(elevation), np.sin(elevation), stretches[row]
        # The lengths of the ray's derivatives by u and v: (cos θ, 0, −sin θ) and (sin φ sin θ, cos φ, sin φ cos θ).
        across, down = 2 * np.pi / width * level * stretch, np.pi / height
        for start in range(0, width, _FIT_STRETCH):
            slopes = np.empty((3, min(_FIT_STRETCH, width - start)))
            fit_slopes(padded, (row - first + radius, start, pad), offsets[row], stretch, max_step, slopes)
            for i in range(_U(slopes.shape[1])):
                x = _U(start) + i
                q = np.float64(inverse[row, x])
                s, c = turned[0, x], turned[1, x]
                alpha, beta, gamma = q * slopes[0, i], q * slopes[1, i] / across, q * slopes[2, i] / down
                ahead = alpha * level + gamma * dip
                known = np.isfinite(q)
                planes[0, row, x] = _F(ahead * s + beta * c) if known else _F(0)
                planes[1, row, x] = _F(gamma * level - alpha * dip) if known else _F(0)
                planes[2, row, x] = _F(ahead * c - beta * s) if known else _F(0)


Reference = tuple[NDArray[np.float32], NDArray[np.float32], int, FloatArray, NDArray[np.int64], NDArray[np.int64]]
Numbers = tuple[np.float32, np.float32, float, float, float, np.float32]


@kernel
def correlate_sources(
    sums: NDArray[np.float32],
    votes: NDArray[np.bool_],
    variance: NDArray[np.float32],
    noise: np.float32,
    correlations: NDArray[np.float32],
) -> None:
    """Write the correlation of each source with the reference, (S, n); −2 where it does not count."""
    for s in range(correlations.shape[0]):
        for i in range(_U(correlations.shape[1])):
            b = sums[s, SUM_B, i]
            spread = sums[s, SUM_BB, i] - b * b + noise
            correlation = sums[s, SUM_AB, i] / np.sqrt(spread * (variance[i] + noise))
            correlations[s, i] = correlation if votes[s, i] else _F(-2)


@kernel
def least_of_best(correlations: NDArray[np.float32], i: int, held: NDArray[np.float32]) -> np.float32:
    """Return the least correlation of the better half of the sources that count (rounded up); 1 if there is none."""
    votes = 0
    for s in range(correlations.shape[0]):
        value = correlations[s, i]
        if value >= _F(-1.5):
            place = votes
            while place > 0 and held[place - 1] < value:
                held[place] = held[place - 1]
                place -= 1
            held[place] = value
            votes += 1
    return held[(votes + 1) // 2 - 1] if votes else _F(2)


@kernel
def add_source(
    sums: NDArray[np.float32],
    i: int,
    correlation: float,
    variance: np.float32,
    noise: np.float32,
    samples: float,
    normal: FloatArray,
    right: FloatArray,
) -> None:
    """Add one source's measurement of pixel i to the normal equations of (α, β, γ).

    With ã and b̃ the samples over their spread and J = ∂b̃ / ∂(α, β, γ), less its mean and its component along b̃ (which
    makes both invariant to brightness and contrast): Σ w J Jᵀ and Σ w J ã, over the variance of ã that b̃ leaves
    unexplained.
    """
    mean = np.float64(sums[SUM_B, i])
    spread = sums[SUM_BB, i] - mean * mean + noise
    information = samples * spread / (noise + spread * (1 - correlation * correlation))
    both = np.sqrt(np.float64(variance + noise) * spread)
    along = (
        (sums[SUM_GB, i] - sums[SUM_G, i] * mean) / spread,
        (sums[SUM_GB + 1, i] - sums[SUM_G + 1, i] * mean) / spread,
        (sums[SUM_GB + 2, i] - sums[SUM_G + 2, i] * mean) / spread,
    )
    entry = 0
    for a in range(3):
        right[a] += information * (sums[SUM_GA + a, i] / both - correlation * along[a])
        for b in range(a, 3):
            moment = sums[SUM_GG + entry, i] - np.float64(sums[SUM_G + a, i]) * sums[SUM_G + b, i]
            normal[entry] += information * (moment / spread - along[a] * along[b])
            entry += 1


@inlined
def solve_first(a: FloatArray, b: FloatArray) -> float:
    """Return the first unknown of a positive definite 3×3 system, a = (xx, xy, xz, yy, yz, zz)."""
    c00, c01, c02 = a[3] * a[5] - a[4] * a[4], a[2] * a[4] - a[1] * a[5], a[1] * a[4] - a[2] * a[3]
    determinant = a[0] * c00 + a[1] * c01 + a[2] * c02
    first: float = (c00 * b[0] + c01 * b[1] + c02 * b[2]) / determinant
    return first


@kernel
def most_likely_steps(
    sums: NDArray[np.float32],
    correlations: NDArray[np.float32],
    variance: NDArray[np.float32],
    noise: np.float32,
    prior: tuple[float, float],
    samples: float,
    weights: NDArray[np.float32],
    weighted: bool,
    steps: NDArray[np.float32],
) -> None:
    """Write the most likely step of α, (n,), given the pictures and the current planes.

    `sums`: (S, SUMS, STRETCH) float32 of the windows, see `sum_windows`. `correlations`: (S, n) float32. `variance`:
    (n,) float32 of the reference's windows. `noise`: variance of a grey level. `prior`: information on α, and on β and
    γ, of the current planes, in 1 / q². `samples`: number of independent samples that a window counts for. `weights`:
    (S, n) float32 of the sources, if `weighted`. `weighted`: False: the better half of the sources counts, as the
    others may be occluded. `steps`: (n,) float32, written.
    """
    normal, right = np.empty(6), np.empty(3)
    held = np.empty(correlations.shape[0], np.float32)
    for i in range(steps.shape[0]):
        normal[:] = 0.0
        right[:] = 0.0
        normal[0], normal[3], normal[5] = prior[0], prior[1], prior[1]
        least = _F(0.2)  # windows with a lower correlation show different surfaces
        if not weighted:
            least = max(least_of_best(correlations, i, held), least)
        for s in range(correlations.shape[0]):
            if correlations[s, i] >= least:
                count = samples * weights[s, i] if weighted else samples
                add_source(sums[s], i, np.float64(correlations[s, i]), variance[i], noise, count, normal, right)
        steps[i] = _F(solve_first(normal, right))


@kernel
def refine_rows(
    first_row: int,
    rows: int,
    planes: NDArray[np.float32],
    reference: Reference,
    sources: Sources,
    numbers: Numbers,
    weighted: bool,
    inverse: NDArray[np.float32],
    views: NDArray[np.float32],
    part: tuple[int, int],
) -> None:
    """Write the refined inverse ranges of some rows.

    `first_row`: the first row. `rows`: number of rows. `planes`: (3, H, W) float32, the current planes, which are also
    the prior. `reference`: of the reference picture: (H + 2 pad, W + 2 pad) float32 grey, (2, W + 2 pad) float32 sin θ
    and cos θ of the columns, pad, (H,) columns per step in u, (side,) int64 rows of the window, (H, side) int64 columns
    of the window. `sources`: see `sum_windows`. `numbers`: 1 / width in grey levels of the window's weights, noise,
    information of the prior on α, the same on β and γ, samples, maximum step in q. `weighted`: whether `views` holds
    weights; otherwise the better half of the sources counts. `inverse`: (H, W) float32, written. `views`: (S, H, W)
    float32 weights of the sources, replaced by their correlations; −2 where one does not count. `part`: as of
    `fit_planes`.
    """
    grey, azimuth, pad, stretches, window_rows, window_columns = reference
    color_scale, noise, prior_q, prior_slope, samples, largest = numbers
    width, (top, height) = planes.shape[2], part
    count, side = len(sources[1]), len(window_rows)
    prior, turned = (prior_q, prior_slope), sines_of_columns(width)
    for row in range(first_row, first_row + rows):
        elevation = elevation_from_y(top + row + 0.5, height)
        level, dip = np.cos(elevation), np.sin(elevation)
        for first in range(0, width, STRETCH):
            n = min(STRETCH, width - first)
            weights, centred = np.empty((side * side, n), np.float32), np.empty((side * side, n), np.float32)
            moments, sums = np.empty((2, n), np.float32), np.empty((count, SUMS, STRETCH), np.float32)
            votes, correlations = np.empty((count, n), np.bool_), np.empty((count, n), np.float32)
            steps, own = np.empty(n, np.float32), planes[:, row, first : first + n].copy()
            shared = first, height, stretches[row], pad, window_rows, window_columns[row]
            weigh_window(grey, (row, *shared), color_scale, weights, centred, moments)
            sum_windows(own, (top + row, *shared), azimuth, (weights, centred, moments[0]), sources, sums, votes)
            correlate_sources(sums, votes, moments[1], noise, correlations)
            given = views[:, row, first : first + n].copy()
            most_likely_steps(sums, correlations, moments[1], noise, prior, samples, given, weighted, steps)
            views[:, row, first : first + n] = correlations
            for i in range(_U(n)):
                x = _U(first) + i
                q = own[0, i] * (level * turned[0, x]) + own[1, i] * -dip + own[2, i] * (level * turned[1, x])
                inverse[row, x] = max(q + min(max(steps[i], -largest), largest), q / 2)
