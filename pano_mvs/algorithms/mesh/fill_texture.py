"""Colours for the texels that no panorama sees, and for the space between the charts."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array, diags_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import spsolve

from pano_mvs.algorithms.mesh.atlas import Texels
from pano_mvs.core.arrays import FloatImage

_GREY = 128.0
_TEXELS_AT_ONCE = 1 << 20  # bounds the memory


def vertex_colors(
    colors: FloatImage, seen: NDArray[np.bool_], texels: Texels, *, faces: NDArray[np.int32], vertices: int
) -> FloatImage:
    """Return the colour of each vertex, (V, 3): the mean of the texels around it that are seen, by their weights.

    A vertex without such texels has the mean of its neighbours along the edges, as have those in turn (the discrete
    Laplace equation). A part of the mesh that nobody sees has the mean of all colours.

    Args:
        colors: (T, 3) colours of the texels.
        seen: (T,) the texels whose colours are known.
        texels: the texels.
        faces: (F, 3) triangles of the mesh.
        vertices: the number V of vertices.
    """
    sums, totals = np.zeros((vertices, 3)), np.zeros(vertices)
    for first in range(0, len(seen), _TEXELS_AT_ONCE):
        part = slice(first, first + _TEXELS_AT_ONCE)
        shown = seen[part]
        triangle, weights = texels.triangle[part][shown], texels.weights[part][shown].astype(np.float64)
        for corner, weight in enumerate((1 - weights.sum(axis=1), weights[:, 0], weights[:, 1])):
            vertex = faces[triangle, corner]
            totals += np.bincount(vertex, weight, vertices)
            for channel in range(3):
                sums[:, channel] += np.bincount(vertex, weight * colors[part][shown, channel], vertices)
    known = totals > 1e-3
    result = np.full((vertices, 3), _GREY if not known.any() else 0.0)
    if not known.any():
        return result.astype(np.float32)
    result[known] = sums[known] / totals[known, None]
    result[~known] = result[known].mean(axis=0)
    _diffuse(result, known, faces)
    return result.astype(np.float32)


def fill_unseen(
    colors: FloatImage, seen: NDArray[np.bool_], texels: Texels, *, faces: NDArray[np.int32], of_vertices: FloatImage
) -> None:
    """Give the texels that are not seen the colour between those of their triangle's vertices, in place."""
    for first in range(0, len(seen), _TEXELS_AT_ONCE):
        part = slice(first, first + _TEXELS_AT_ONCE)
        hidden = ~seen[part]
        triangle, weights = texels.triangle[part][hidden], texels.weights[part][hidden]
        second, third = weights[:, :1], weights[:, 1:]
        corners = of_vertices[faces[triangle]]
        colors[part][hidden] = (1 - second - third) * corners[:, 0] + second * corners[:, 1] + third * corners[:, 2]


def spread_over_gaps(texture: NDArray[np.uint8], filled: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Return a texture whose other texels have the colour of the nearest filled one.

    Lookups at the borders of charts, and smaller levels of the texture, then mix no foreign colour.

    Args:
        texture: (H, W, 3) or (H, W).
        filled: (H, W) bool.
    """
    if filled.all() or not filled.any():
        return texture
    gaps = np.where(filled, np.uint8(0), np.uint8(1))
    _, labels = cv2.distanceTransformWithLabels(gaps, cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL)
    source = np.zeros(int(labels.max()) + 1, np.int32)
    source[labels[filled]] = np.flatnonzero(filled)
    flat = texture.reshape(filled.size, -1)
    return np.asarray(flat[source[labels.ravel()]].reshape(texture.shape))


def _diffuse(colors: NDArray[np.float64], known: NDArray[np.bool_], faces: NDArray[np.int32]) -> None:
    """Solve the Laplace equation for the vertices whose colours are not known, in place."""
    links = _links(faces, len(colors))
    _, part = connected_components(links, directed=False)
    reached = np.isin(part, np.unique(part[known]))
    wanted = np.flatnonzero(~known & reached)
    if not len(wanted):
        return
    degrees = np.asarray(links.sum(axis=1)).ravel()
    rows = links[wanted]
    system = (diags_array(degrees[wanted]) - rows[:, wanted]).tocsc()
    right = rows[:, np.flatnonzero(known)] @ colors[known]
    colors[wanted] = np.asarray(spsolve(system, right)).reshape(-1, 3)


def _links(faces: NDArray[np.int32], count: int) -> csr_array:
    """Return the adjacency of vertices, (count, count), 1 for an edge."""
    starts, ends = faces[:, [0, 1, 2]].ravel(), faces[:, [1, 2, 0]].ravel()
    both = np.concatenate([starts, ends]), np.concatenate([ends, starts])
    links = coo_array((np.ones(2 * len(starts)), both), shape=(count, count)).tocsr()
    links.data[:] = 1
    return links
