"""A global descriptor of a panorama: one vector over all key points, and a sample of their descriptors."""

from __future__ import annotations

from typing import Annotated

import numpy as np
import scipy
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.settings import Setting, checks_settings
from pano_mvs.scene import Features, GlobalDescriptor

_CELL_BITS = 4
_RESIDUAL_SIZE = 128


@checks_settings
def vlad_descriptor(
    features: Features,
    *,
    strongest: Annotated[int, Setting("number of the strongest key points in the descriptor", ge=8)] = 4000,
    sample: Annotated[
        int,
        Setting(
            "number of key points of the coarsest scales that pairs.retrieval matches with one another", ge=0, le=2000
        ),
    ] = 200,
) -> GlobalDescriptor:
    """Compute the VLAD vector of a panorama, and the descriptors of its largest key points.

    Jégou et al., "Aggregating local descriptors into a compact image representation", 2010, with the signed square root
    and the normalisation within cells of Arandjelović & Zisserman, "All about VLAD", 2013. The cells are not clusters
    of a training set but the 16 orthants of 4 random directions, so that the vector of an image depends on this image
    alone: adding an image does not change other vectors.

    Args:
        features: key points, strongest first, with either kind of descriptor.
        sample: number of key points, those of the coarsest scales, whose descriptors are kept unchanged. Key points of
            coarse scales are the ones most likely found from other positions (Wu, "Towards linear-time incremental
            structure from motion", 2013, section 3.1).

    Returns:
        A vector of length 1024 up to rounding, of integers: scalar products are exact in any order.
    """
    largest = _whole(features, np.argsort(-features.sizes_rad, kind="stable")[:sample]).astype(np.int16)
    turned = _turned(_centered(features, strongest))
    if turned.shape[1] <= _CELL_BITS or not len(turned):
        length = min(_RESIDUAL_SIZE, max(turned.shape[1] - _CELL_BITS, 0)) << _CELL_BITS
        return GlobalDescriptor(np.zeros(length, np.float32), largest)
    unit = turned / np.maximum(np.sqrt(np.sum(turned**2, axis=1, keepdims=True)), 1e-12)
    cell = (unit[:, :_CELL_BITS] > 0) @ (1 << np.arange(_CELL_BITS))
    residuals = unit[:, _CELL_BITS:][:, :_RESIDUAL_SIZE]
    sums = np.stack([np.bincount(cell, column, 1 << _CELL_BITS) for column in residuals.T], axis=1)
    sums = sums / np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-12)
    vector = (np.sign(sums) * np.sqrt(np.abs(sums))).ravel()
    vector *= 1024.0 / max(float(np.linalg.norm(vector)), 1e-12)
    return GlobalDescriptor(np.rint(vector).astype(np.float32), largest)


def _centered(features: Features, strongest: int) -> FloatArray:
    """Return the descriptors as integers whose mean over the components is zero, (N, D): bits become ± 1."""
    whole = _whole(features, np.arange(len(features))[:strongest])
    if features.metric == "hamming":
        return whole
    centered: FloatArray = whole.shape[1] * whole - whole.sum(axis=1, keepdims=True)
    return centered


def _whole(features: Features, chosen: NDArray[np.intp]) -> FloatArray:
    """Return the chosen descriptors as integers, (N, D): bits become ± 1."""
    if features.metric == "hamming":
        return 2.0 * np.unpackbits(features.descriptors[chosen].astype(np.uint8), axis=1).astype(np.float64) - 1.0
    whole: FloatArray = np.rint(features.descriptors[chosen]).astype(np.float64)
    return whole


def _turned(vectors: FloatArray) -> FloatArray:
    """Return the vectors in randomly rotated axes, exactly: signs, a Hadamard matrix, a permutation; integers."""
    size = 1 << max(vectors.shape[1] - 1, 1).bit_length()
    rng = np.random.default_rng(20261121)  # arbitrary but fixed, so that images can be compared
    signs = rng.choice([-1.0, 1.0], size)[: vectors.shape[1]]
    rows = scipy.linalg.hadamard(size, dtype=np.float64)[: vectors.shape[1]]
    turned: FloatArray = (vectors * signs) @ rows[:, rng.permutation(size)]
    return turned
