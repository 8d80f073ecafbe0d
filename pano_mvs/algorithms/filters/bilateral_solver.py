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
import scipy.sparse
import scipy.sparse.linalg
from numpy.typing import NDArray

from pano_mvs.algorithms.filters.data_term import data_term, require_guide
from pano_mvs.algorithms.filters.holes import large_holes
from pano_mvs.algorithms.filters.replacement import with_ranges
from pano_mvs.algorithms.filters.settings import Domain, MaxHoleDeg
from pano_mvs.algorithms.filters.sphere.cells import SphereCells, sphere_cells
from pano_mvs.algorithms.filters.support.supported import supported_pixels
from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.errors import UsageError
from pano_mvs.core.settings import Setting, checks_settings
from pano_mvs.scene import RangeMap
from pano_mvs.scene.range_map import CONSISTENT_CONFIDENCE, FILLED_CONFIDENCE

# [1 2 1] along two spatial and three colour dimensions: the centre counts twice for each.
_BLUR_CENTER = 10.0
_BISTOCHASTIC_ITERATIONS = 10
# Weight of a colour-blind initial guess for a pixel without range, so that a colour that only occurs inside a hole has
# a value.
_PRIOR_WEIGHT = 1e-4
_TOLERANCE = 1e-4


@dataclass(frozen=True, slots=True, eq=False)
class BilateralSystem:
    """The linear system A y = b of the solver, and the mapping between its solution and pixels.

    Attributes:
        cells: spatial cells.
        elements: (H, W) int32 coloured element of each pixel.
        vertices: (E, 4) int32 vertices of each coloured element.
        mass: (V,) number of pixels at each vertex, S 1.
        gram: (E, 4, 4) the data term S C Sᵀ of each element.
        right: (V,) b = S C t.
        graph: the blur B̄ without its centre, as compressed rows: starts (V + 1), indices (K), strengths (K).
        n: (V,) diagonal of D_n.
        m: (V,) diagonal of D_m.
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
    fill: Annotated[bool, Setting("fill pixels without a range (confidence 1–63)")] = True,
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
    keep their confidence; filled ones get 1–63 by the share of weight among pixels with similar position and colour.

    Args:
        range_map: (H, W) with even W, the full sphere.
        guide: (H, W, 3) RGB panorama.
        sigma_spatial: size of a grid cell in pixels at the equator.
        sigma_luma: size of a grid cell in luma (0–255), at least 2.1.
        sigma_chroma: size of a grid cell in chroma (0–255), at least 2.1.
        smoothness: λ, the weight of the smoothness term relative to data weights of at most 1.
        iterations: maximum number of conjugate-gradient steps.
        domain: quantity to smooth: "inverse" (1/range, which is linear in the ray on every plane, and in which stereo
            errors are uniform) or "range".
        fill: whether invalid pixels get a range; else they stay invalid.
        max_hole_deg: holes that contain a larger disc stay invalid (`large_holes`), since a sky has no range; 0 fills
            all.
        keep_confidence: pixels with at least this confidence keep their range; 256 smooths all.
        keep_supported: whether pixels that `supported_pixels` finds count as if they had this confidence, so that thin
            objects and gaps between them are not smoothed away.

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

    Args:
        target: (H, W) measured values, any finite value where the weight is 0.
        weight: (H, W) confidences in [0, 1], not all 0.
        colors: (H, W) index of the colour bin.
        cells: spatial cells of the panorama.
        smoothness: λ.
        iterations: maximum number of conjugate-gradient steps.
    """
    from pano_mvs.algorithms.filters import kernels_bilateral as kernels  # compiles on import

    prior = _blind_guess(target, weight, cells)
    known = weight > 0
    pull = np.where(known, weight, _PRIOR_WEIGHT)
    system = build_system(np.where(known, target, prior), pull, colors, cells=cells)
    count = len(system.mass)
    diagonal_gram = np.ascontiguousarray(np.einsum("eaa->ea", system.gram))
    data = kernels.sum_at_vertices(diagonal_gram, system.vertices, count)
    diagonal = smoothness * (system.m - _BLUR_CENTER * system.n**2) + data
    # S C Sᵀ 1, the weight of a vertex from its pixels.
    pulled = kernels.sum_at_vertices(system.gram.sum(axis=2), system.vertices, count)
    arguments = (smoothness, system.n, system.m, *system.graph, _BLUR_CENTER, system.vertices, system.gram)
    # Vertices without pixels are not part of the system: they start at 0 and stay there.
    held = system.mass > 0
    start = np.divide(system.right, pulled, out=np.zeros(count), where=held)
    diagonal[~held] = 1
    solution, _ = kernels.solve(system.right, start, diagonal, _TOLERANCE, iterations, arguments)
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
    n, m = kernels.bistochastise(mass, *graph, _BLUR_CENTER, _BISTOCHASTIC_ITERATIONS)
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
    count = len(cells.starts) - 1
    element = cells.element_of_pixel[cells.gap_of_row]
    cell = cells.corners[element, 0]
    total_weight = np.bincount(cell.ravel(), weight.ravel(), count)
    total = np.bincount(cell.ravel(), (weight * target).ravel(), count)
    graph = scipy.sparse.csr_array((cells.strengths, cells.neighbours, cells.starts), shape=(count, count))
    pull = 1e3 * total_weight / total_weight.max()
    mean = total / np.where(total_weight > 0, total_weight, 1)
    matrix = scipy.sparse.diags_array(pull + graph.sum(axis=1)) - graph
    guess: FloatArray = np.asarray(scipy.sparse.linalg.spsolve(matrix.tocsc(), pull * mean), np.float64)
    spread: FloatArray = guess[cell]
    return spread
