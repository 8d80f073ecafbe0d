"""The Fast Bilateral Solver on the sphere: ranges that are smooth where the panorama is, with edges where it has edges.

Barron and Poole, "The Fast Bilateral Solver", ECCV 2016: minimise over the vertices y of a bilateral grid

    λ yᵀ (D_m − D_n B̄ D_n) y + Σ_i c_i ((Sᵀ y)_i − t_i)²

where t are the measured values, c their confidences, S splats pixels to vertices, B̄ is a [1 2 1] blur along each
dimension of the grid and D_n, D_m make it bistochastic; the result is Sᵀ y.

There are two differences from the paper's grid. Its spatial cells lie on the sphere (`sphere_cells`), so that there is
neither a seam nor a pole. And a pixel is interpolated bilinearly between the centres of four spatial cells, where the
paper uses the nearest vertex: otherwise a slanted floor becomes a staircase of cells, and the result depends on where
the first cell begins. Colour bins are hard, as in the paper, to preserve edges. The data term then has the matrix S C
Sᵀ, which is not diagonal but sparse: four vertices by four, summed over the pixels of each element.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from pano_mvs.algorithms.filters.data_term import Domain, MaxHoleDeg, data_term, require_guide
from pano_mvs.algorithms.filters.fill import large_holes
from pano_mvs.algorithms.filters.supported import supported_pixels
from pano_mvs.algorithms.filters.uncertainty import with_ranges
from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.errors import UsageError
from pano_mvs.core.settings import Setting, checks_settings
from pano_mvs.scene import RangeMap
from pano_mvs.scene.range_map import CONSISTENT_CONFIDENCE, FILLED_CONFIDENCE

# Number of cells around a pole: with fewer, half a turn across the pole would end in the same cell.
_MIN_CELLS = 4


@dataclass(frozen=True, slots=True, eq=False)
class SphereCells:
    """Cells of about equal width and height on the sphere, and the interpolation weights of pixels.

    Bands of equal height run around the sphere. A band is divided into equal cells, with half, a quarter … of the
    number of cells at the equator towards the poles, so that a cell is never much narrower than high. Cells are
    neighbours within a band, across the seam, between bands by the length of their common side, and across the poles. A
    pixel lies between four centres, which form an element. All elements of a gap between two bands have the same bands
    above and below.

    `element_of_pixel`: (G, W) int32: element of a pixel by gap and column. `weight_upper`: (G, W) float64 weight of the
    right one of the element's two cells in the band above. `weight_lower`: (G, W) float64 the same in the band below.
    `gap_of_row`: (H,) int32. `weight_row`: (H,) float64 weight of the band below. `corners`: (E, 4) int32 cells of each
    element: upper left, upper right, lower left, lower right. `starts`: (C + 1,) int32: the neighbours of cell c are
    `neighbours[starts[c]:starts[c + 1]]`. `neighbours`: (K,) int32. `strengths`: (K,) float64 common side with each
    neighbour, relative to the shorter cell; symmetric.
    """

    element_of_pixel: NDArray[np.int32]
    weight_upper: NDArray[np.float64]
    weight_lower: NDArray[np.float64]
    gap_of_row: NDArray[np.int32]
    weight_row: NDArray[np.float64]
    corners: NDArray[np.int32]
    starts: NDArray[np.int32]
    neighbours: NDArray[np.int32]
    strengths: NDArray[np.float64]


def sphere_cells(size_hw: tuple[int, int], cell_px: float) -> SphereCells:
    """Divide a panorama into cells, `cell_px` pixels wide and high at the equator.

    `size_hw`: (height, width) of the panorama in pixels, even width. `cell_px`: size of a cell in pixels at the
    equator.
    """
    height, width = size_hw
    counts = _cells_in_band(size_hw, cell_px)
    bands = len(counts)
    first = np.concatenate([[0], np.cumsum(counts)])
    y = (np.arange(height) + 0.5) * bands / height + 0.5
    gap_of_row = np.floor(y).astype(np.int32)
    left, weight = _place_columns(counts, width)
    # Above the first band is the first band again, rotated by half a turn; below the last one likewise.
    upper = np.concatenate([[0], np.arange(bands)])
    lower = np.concatenate([np.arange(bands), [bands - 1]])
    half = width // 2
    left_upper, weight_upper = left[upper], weight[upper]
    left_lower, weight_lower = left[lower], weight[lower]
    left_upper[0], weight_upper[0] = np.roll(left_upper[0], -half), np.roll(weight_upper[0], -half)
    left_lower[-1], weight_lower[-1] = np.roll(left_lower[-1], -half), np.roll(weight_lower[-1], -half)
    element_of_pixel, firsts = _number_elements(left_upper, left_lower)
    gap, column = firsts
    corners = np.stack(
        [
            first[band[gap]] + (start[gap, column] + step) % counts[band[gap]]
            for band, start in ((upper, left_upper), (lower, left_lower))
            for step in (0, 1)
        ],
        axis=1,
    )
    starts, neighbours, strengths = _neighbours(counts)
    return SphereCells(
        element_of_pixel=element_of_pixel,
        weight_upper=weight_upper,
        weight_lower=weight_lower,
        gap_of_row=gap_of_row,
        weight_row=y - gap_of_row,
        corners=corners.astype(np.int32),
        starts=starts,
        neighbours=neighbours,
        strengths=strengths,
    )


def _cells_in_band(size_hw: tuple[int, int], cell_px: float) -> NDArray[np.int64]:
    """Return the number of cells of each band, always even."""
    height, width = size_hw
    bands = max(2, round(height / cell_px))
    elevation = np.pi * (0.5 - (np.arange(bands) + 0.5) / bands)
    equator = max(_MIN_CELLS, 2 * round(width / cell_px / 2))
    halvings = np.rint(np.log2(1 / np.cos(elevation)))
    counts: NDArray[np.int64] = np.maximum(_MIN_CELLS, 2 * np.rint(equator / 2 / 2**halvings)).astype(np.int64)
    return counts


def _place_columns(counts: NDArray[np.int64], width: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return for each band and column the cell to the left and the weight of the one to the right, (B, W) each."""
    position = (np.arange(width) + 0.5) * counts[:, None] / width - 0.5
    left = np.floor(position)
    return left.astype(np.int64) % counts[:, None], position - left


def _number_elements(
    left_upper: NDArray[np.int64], left_lower: NDArray[np.int64]
) -> tuple[NDArray[np.int32], tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Return the index of the element of each (gap, column), and a (gap, column) in each element."""
    starts = (left_upper != np.roll(left_upper, 1, axis=1)) | (left_lower != np.roll(left_lower, 1, axis=1))
    # The element at the seam starts at the end of the row, so a row's indices start before its first column.
    per_gap = starts.sum(axis=1)
    before = np.concatenate([[0], np.cumsum(per_gap)[:-1]])
    inside = (np.cumsum(starts, axis=1) - 1) % per_gap[:, None]
    gap, column = np.nonzero(starts)
    return (before[:, None] + inside).astype(np.int32), (gap, column)


def _neighbours(counts: NDArray[np.int64]) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.float64]]:
    """Return the symmetric graph of the cells as compressed rows: starts, neighbours and strengths."""
    first = np.concatenate([[0], np.cumsum(counts)])
    heads: list[NDArray[np.int64]] = []
    tails: list[NDArray[np.int64]] = []
    sides: list[NDArray[np.float64]] = []
    for band, count in enumerate(counts):
        cell = np.arange(count)
        heads.append(first[band] + cell)
        tails.append(first[band] + (cell + 1) % count)
        sides.append(np.ones(count))
        if band in (0, len(counts) - 1):
            opposite = cell[: count // 2]
            heads.append(first[band] + opposite)
            tails.append(first[band] + opposite + count // 2)
            sides.append(np.ones(count // 2))
        if band + 1 < len(counts):
            upper, lower, side = _common_sides(int(count), int(counts[band + 1]))
            heads.append(first[band] + upper)
            tails.append(first[band + 1] + lower)
            sides.append(side)
    head, tail, side = np.concatenate(heads), np.concatenate(tails), np.concatenate(sides)
    rows, columns, strengths = np.concatenate([head, tail]), np.concatenate([tail, head]), np.concatenate([side, side])
    order = np.lexsort((columns, rows))
    starts = np.searchsorted(rows[order], np.arange(first[-1] + 1))
    return starts.astype(np.int32), columns[order].astype(np.int32), strengths[order]


def _common_sides(
    upper_count: int, lower_count: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Return the pairs of cells of two bands that touch, and their common side relative to the shorter cell."""
    edges = np.unique(np.concatenate([np.arange(upper_count) * lower_count, np.arange(lower_count) * upper_count]))
    lengths = np.diff(np.append(edges, upper_count * lower_count))
    return edges // lower_count, edges // upper_count, lengths / min(upper_count, lower_count)


# [1 2 1] along two spatial and three colour dimensions: the centre counts twice for each.
_BLUR_CENTER = 10.0


@dataclass(frozen=True, slots=True, eq=False)
class BilateralSystem:
    """The linear system A y = b of the solver, and the mapping between its solution and pixels.

    `cells`: spatial cells. `elements`: (H, W) int32 coloured element of each pixel. `vertices`: (E, 4) int32 vertices
    of each coloured element. `mass`: (V,) number of pixels at each vertex, S 1. `gram`: (E, 4, 4) the data term S C Sᵀ
    of each element. `right`: (V,) b = S C t. `graph`: the blur B̄ without its centre, as compressed rows: starts (V +
    1), indices (K), strengths (K). `n`: (V,) diagonal of D_n. `m`: (V,) diagonal of D_m.
    """

    cells: SphereCells
    elements: NDArray[np.int32]
    vertices: NDArray[np.int32]
    mass: FloatArray
    gram: FloatArray
    right: FloatArray
    graph: tuple[NDArray[np.int64], NDArray[np.int32], FloatArray]
    n: FloatArray
    m: FloatArray


@checks_settings
def fast_bilateral_solver(
    range_map: RangeMap,
    guide: NDArray[np.uint8],
    *,
    sigma_spatial: Annotated[float, Setting("size of spatial cells, in pixels at the equator", ge=1)] = 8.0,
    sigma_luma: Annotated[float, Setting("size of luma bins, in grey levels", ge=2.1)] = 8.0,
    sigma_chroma: Annotated[float, Setting("size of chroma bins, in grey levels", ge=2.1)] = 8.0,
    smoothness: Annotated[float, Setting("λ: weight of smoothness relative to a pixel of full confidence", ge=0)] = 1.0,
    iterations: int = 60,
    domain: Domain = "inverse",
    fill: Annotated[bool, Setting("fill pixels without a range (confidence 3–63)")] = True,
    max_hole_deg: MaxHoleDeg = 20.0,
    keep_confidence: Annotated[
        int, Setting("pixels with at least this confidence keep their range; 256: smooth all", ge=1, le=256)
    ] = CONSISTENT_CONFIDENCE[0],
    keep_supported: Annotated[
        bool, Setting("also keep pixels with texture beside such a pixel that has about the same range and colour")
    ] = True,
) -> RangeMap:
    """Smooth a range map within the surfaces of the panorama, and fill invalid pixels.

    The weight of a pixel in the data term is `confidence_weight` relative to the largest weight of the map: if other
    views have confirmed some pixels, the others have little influence, and an unchecked map is solved as it is. Pixels
    keep their confidence; filled ones get 3–63 by the share of weight among pixels with similar position and colour.

    Args:
        range_map: (H, W) with even W, the full sphere.
        guide: (H, W, 3) RGB panorama.
        iterations: maximum number of conjugate-gradient steps.

    Raises:
        UsageError: if guide and range map differ in size, or a parameter is out of bounds.
    """
    height, width = range_map.range.shape
    require_guide(guide, range_map)
    if iterations < 0:
        raise UsageError(f"iterations must not be negative, got {iterations}")
    valid = range_map.valid
    if not valid.any():
        return range_map
    trusted = range_map.confidence
    if keep_supported:
        supported = supported_pixels(range_map, guide, min_confidence=keep_confidence)
        trusted = np.where(supported, np.uint8(min(keep_confidence, 255)), trusted)
    target, weight = data_term(RangeMap(range_map.range, trusted), domain)
    cells = sphere_cells((height, width), sigma_spatial)
    colors = _color_bins(guide, sigma_luma, sigma_chroma)
    smooth, support = solve_bilateral(target, weight, colors, cells=cells, smoothness=smoothness, iterations=iterations)
    # The solution is a weighted mean of the targets up to the tolerance of the solver: clip it to their range.
    smooth = np.clip(smooth, target[valid].min(), target[valid].max())
    ranges = (1 / smooth if domain == "inverse" else smooth).astype(np.float32)
    kept = trusted >= keep_confidence
    ranges[kept] = range_map.range[kept]
    if not fill:
        return with_ranges(range_map, np.where(valid, ranges, np.float32(np.nan)))
    low, high = FILLED_CONFIDENCE
    filled = np.rint(low + (high - low) * np.clip(support, 0, 1)).astype(np.uint8)
    large = large_holes(valid, max_hole_deg)
    ranges[large], filled[large] = np.nan, 0
    return with_ranges(range_map, ranges, np.where(valid, range_map.confidence, filled))


def solve_bilateral(
    target: FloatArray,
    weight: FloatArray,
    colors: NDArray[np.int64],
    *,
    cells: SphereCells,
    smoothness: float,
    iterations: int,
) -> tuple[FloatArray, FloatArray]:
    """Solve for the value and the mean weight of the vertices at each pixel, (H, W) each.

    `target`: (H, W) measured values, any finite value where the weight is 0. `weight`: (H, W) confidences in [0, 1],
    not all 0. `colors`: (H, W) index of the colour bin. `cells`: spatial cells of the panorama. `smoothness`: λ.
    `iterations`: maximum number of conjugate-gradient steps.
    """
    from pano_mvs.algorithms.filters import kernels_bilateral as kernels  # compiles on import

    prior = _blind_guess(target, weight, cells)
    known = weight > 0
    # Weight of a colour-blind initial guess for a pixel without range, so that a colour that only occurs inside a hole
    # has a value.
    pull = np.where(known, weight, 1e-4)
    system = build_system(np.where(known, target, prior), pull, colors, cells=cells)
    count = len(system.mass)
    diagonal_gram = np.ascontiguousarray(np.einsum("eaa->ea", system.gram))
    data = kernels.sum_at_vertices(diagonal_gram, system.vertices, count)
    diagonal = smoothness * (system.m - _BLUR_CENTER * system.n**2) + data
    # S C Sᵀ 1, the weight of a vertex from its pixels.
    pulled = kernels.sum_at_vertices(system.gram.sum(axis=2), system.vertices, count)
    arguments = (float(smoothness), system.n, system.m, *system.graph, _BLUR_CENTER, system.vertices, system.gram)
    # Vertices without pixels are not part of the system: they start at 0 and stay there.
    held = system.mass > 0
    start = np.divide(system.right, pulled, out=np.zeros(count), where=held)
    diagonal[~held] = 1
    solution, _ = kernels.solve(system.right, start, diagonal, 1e-4, iterations, arguments)
    place = cells.gap_of_row, cells.weight_row, cells.weight_upper, cells.weight_lower
    smooth = kernels.slice_pixels(system.elements, system.vertices, solution, *place)
    share = np.divide(pulled, system.mass, out=np.zeros(count), where=held)
    return smooth, kernels.slice_pixels(system.elements, system.vertices, share, *place)


def build_system(
    target: FloatArray, weight: FloatArray, colors: NDArray[np.int64], *, cells: SphereCells
) -> BilateralSystem:
    """Return the linear system for values (H, W), weights (H, W) and colour bins (H, W)."""
    from pano_mvs.algorithms.filters import kernels_bilateral as kernels  # compiles on import

    elements, element_keys = kernels.number_elements(colors, cells.element_of_pixel, cells.gap_of_row)
    vertices, vertex_keys = kernels.number_vertices(element_keys, cells.corners)
    graph = kernels.blur_graph(vertex_keys, cells.starts, cells.neighbours, cells.strengths)
    mass, gram, right = kernels.assemble(
        elements,
        target,
        weight,
        len(vertices),
        cells.gap_of_row,
        cells.weight_row,
        cells.weight_upper,
        cells.weight_lower,
    )
    count = len(vertex_keys)
    mass = kernels.sum_at_vertices(mass, vertices, count)
    n, m = kernels.bistochastise(mass, *graph, _BLUR_CENTER, 10)
    right = kernels.sum_at_vertices(right, vertices, count)
    return BilateralSystem(cells, elements, vertices, mass, gram, right, graph, n, m)


def _color_bins(guide: NDArray[np.uint8], sigma_luma: float, sigma_chroma: float) -> NDArray[np.int64]:
    """Return the index of each pixel's bin of luma and chroma, (H, W)."""
    from pano_mvs.algorithms.filters.kernels_bilateral import COLOR_BINS  # compiles on import

    luma, red, blue = np.moveaxis(cv2.cvtColor(guide, cv2.COLOR_RGB2YCrCb), -1, 0)
    # Bins start at 1: the outermost ones stay empty, so that a step in one channel never reaches the next.
    y, u, v = ((np.arange(256) / sigma).astype(np.int64) + 1 for sigma in (sigma_luma, sigma_chroma, sigma_chroma))
    bins: NDArray[np.int64] = (y[luma] * COLOR_BINS + u[blue]) * COLOR_BINS + v[red]
    return bins


def _blind_guess(target: FloatArray, weight: FloatArray, cells: SphereCells) -> FloatArray:
    """Return a smooth initial guess of the value everywhere, (H, W), from positions alone.

    It is the mean of the targets in each cell, extended to empty cells by Laplace's equation on the cells' graph.
    """
    from scipy.sparse.linalg import spsolve

    count = len(cells.starts) - 1
    element = cells.element_of_pixel[cells.gap_of_row]
    cell = cells.corners[element, 0]
    total_weight = np.bincount(cell.ravel(), weight.ravel(), count)
    total = np.bincount(cell.ravel(), (weight * target).ravel(), count)
    graph = scipy.sparse.csr_array((cells.strengths, cells.neighbours, cells.starts), shape=(count, count))
    pull = 1e3 * total_weight / total_weight.max()
    mean = total / np.where(total_weight > 0, total_weight, 1)
    matrix = scipy.sparse.diags_array(pull + graph.sum(axis=1)) - graph
    guess: FloatArray = np.asarray(spsolve(matrix.tocsc(), pull * mean), np.float64)
    spread: FloatArray = guess[cell]
    return spread
