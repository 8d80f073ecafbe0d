"""One vector for a whole picture from the descriptors of its key points, with a codebook that no data made."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import hadamard

from pano_mvs.scene import Features, GlobalDescriptor

FloatArray = NDArray[np.float64]

_CELL_BITS = 4
_RESIDUAL_SIZE = 128
_LENGTH = 1024.0
_CODEBOOK_SEED = 20261121  # any other would do; it never changes, so that pictures can be compared


def vlad_descriptor(features: Features, *, strongest: int = 4000) -> GlobalDescriptor:
    """Return the vector of locally aggregated descriptors of a picture.

    Jégou et al., "Aggregating local descriptors into a compact image representation", 2010, with the signed square
    root and the normalisation within cells of Arandjelović & Zisserman, "All about VLAD", 2013. The cells are not
    clusters of some training set but the 16 orthants of 4 random directions, so that the vector of a picture depends
    on this picture alone: one more picture leaves the other vectors as they are.

    Args:
        features: key points, strongest first, with either kind of descriptor.
        strongest: so many of them are used.

    Returns:
        A vector of length 1024 within rounding, of whole numbers: scalar products are exact in any order.
    """
    turned = _turned(_centered(features, strongest))
    if turned.shape[1] <= _CELL_BITS or not len(turned):
        return GlobalDescriptor(np.zeros(_RESIDUAL_SIZE << _CELL_BITS, np.float32))
    unit = turned / np.maximum(np.sqrt(np.sum(turned**2, axis=1, keepdims=True)), 1e-12)
    cell = (unit[:, :_CELL_BITS] > 0) @ (1 << np.arange(_CELL_BITS))
    residuals = unit[:, _CELL_BITS:][:, :_RESIDUAL_SIZE]
    sums = np.stack([np.bincount(cell, column, 1 << _CELL_BITS) for column in residuals.T], axis=1)
    sums = sums / np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-12)
    vector = (np.sign(sums) * np.sqrt(np.abs(sums))).ravel()
    vector *= _LENGTH / max(float(np.linalg.norm(vector)), 1e-12)
    return GlobalDescriptor(np.rint(vector).astype(np.float32))


def _centered(features: Features, strongest: int) -> FloatArray:
    """Return the descriptors as whole numbers whose mean over the components is zero, (N, D): bits become ± 1."""
    if features.metric == "hamming":
        return 2.0 * np.unpackbits(features.descriptors[:strongest].astype(np.uint8), axis=1).astype(np.float64) - 1.0
    whole = np.rint(features.descriptors[:strongest]).astype(np.float64)
    centered: FloatArray = whole.shape[1] * whole - whole.sum(axis=1, keepdims=True)
    return centered


def _turned(vectors: FloatArray) -> FloatArray:
    """Return the vectors in randomly turned axes, exactly: signs, a Hadamard matrix, a permutation; whole numbers."""
    size = 1 << max(vectors.shape[1] - 1, 1).bit_length()
    rng = np.random.default_rng(_CODEBOOK_SEED)
    signs = rng.choice([-1.0, 1.0], size)[: vectors.shape[1]]
    rows = hadamard(size, dtype=np.float64)[: vectors.shape[1]]
    turned: FloatArray = (vectors * signs) @ rows[:, rng.permutation(size)]
    return turned
