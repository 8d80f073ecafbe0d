"""Pack the sources for the compiled sweep: all 2×2 patches, laid out so that a bilinear sample needs one load.

Patch (j, i) of a panorama holds the pixels of rows j − 1, j and columns i − 1, i, over the seam and over the poles: no
sample lies at a border. Values are stored less 128, as signed bytes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.sweep.preparation import SweepInput
from pano_mvs.geometry import pad_panorama

Element = TypeVar("Element", bound=np.generic)


def pack_plane(plane: NDArray[np.uint8]) -> NDArray[np.uint32]:
    """Return all 2×2 patches of one colour, (H, W) to (H + 1, W + 2), four bytes each.

    They are upper left | lower left << 8 | upper right << 16 | lower right << 24. The last column is not used: it
    makes the rows as long as those of `pack_colors`.
    """
    padded = _signed_bytes(plane)
    upper, lower = padded[:-1], padded[1:]
    patches = np.zeros(upper.shape, np.uint32)
    patches[:, :-1] = upper[:, :-1] | lower[:, :-1] << 8 | upper[:, 1:] << 16 | lower[:, 1:] << 24
    return patches


def pack_colors(picture: NDArray[np.uint8]) -> NDArray[np.uint64]:
    """Return the left halves of all patches of an RGB panorama, (H, W, 3) to (H + 1, W + 2), eight bytes each.

    They are upper and lower R, upper and lower G, upper and lower B, 0, 0: sixteen bytes from there are a patch.
    """
    height, width = picture.shape[:2]
    halves = np.zeros((height + 1, width + 2, 4, 2), np.uint8)
    for color in range(3):
        padded = _signed_bytes(picture[..., color])
        halves[..., color, 0], halves[..., color, 1] = padded[:-1], padded[1:]
    return halves.reshape(height + 1, -1).view(np.uint64)


def _signed_bytes(plane: NDArray[np.uint8]) -> NDArray[np.uint32]:
    return pad_panorama(plane ^ np.uint8(128), 1).astype(np.uint32)


def pack_sources(
    sources: Sequence[NDArray[np.uint8]], *, vector: bool
) -> tuple[NDArray[np.uint32], NDArray[np.uint64], NDArray[np.int64]]:
    """Return all sources packed in one array, by planes or by colours, one of which is empty, and where each begins.

    Args:
        sources: (Hs, Ws, C) each.
        vector: whether vector instructions can be used; they want RGB by colours.
    """
    if vector and sources[0].shape[2] == 3:
        colors, starts = _joined([pack_colors(source).ravel() for source in sources])
        return np.zeros(0, np.uint32), colors, starts[:, None]
    planes = [pack_plane(plane).ravel() for source in sources for plane in np.moveaxis(source, -1, 0)]
    packed, starts = _joined(planes)
    return packed, np.zeros(0, np.uint64), starts.reshape(len(sources), -1)


def pack_votes(work: SweepInput) -> tuple[NDArray[np.uint8], NDArray[np.int64], NDArray[np.int64]]:
    """Return whether each patch of each source is valid (all four pixels are), and `valid_starts` and `masked`."""
    count = len(work.sources)
    if work.source_valid is None:
        return np.zeros(0, np.uint8), np.zeros(count, np.int64), np.zeros((count, 2), np.int64)
    votes = [_valid_patches(mask).ravel() for mask in work.source_valid]
    valid, starts = _joined(votes)
    masked = [np.flatnonzero(vote == 0)[[0, -1]] + (0, 1) if not vote.all() else (0, 0) for vote in votes]
    return valid, starts, np.array(masked, np.int64)


def _valid_patches(mask: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Return which patches are valid, (H, W) to (H + 1, W + 2); those of the last column, which is not used, are."""
    padded = pad_panorama(mask, 1)
    patches = np.ones((len(mask) + 1, mask.shape[1] + 2), np.uint8)
    patches[:, :-1] = padded[:-1, :-1] & padded[1:, :-1] & padded[:-1, 1:] & padded[1:, 1:]
    return patches


def _joined(arrays: Sequence[NDArray[Element]]) -> tuple[NDArray[Element], NDArray[np.int64]]:
    lengths = [len(array) for array in arrays]
    return np.concatenate(arrays), np.cumsum([0, *lengths[:-1]], dtype=np.int64)
