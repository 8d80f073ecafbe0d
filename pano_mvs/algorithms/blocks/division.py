"""Divide a capture into overlapping blocks along its order, and where its path returns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import permutations

import numpy as np
from scipy.spatial import cKDTree

from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.errors import UsageError

# Images of two blocks are of one place if they are this near, in median steps of the path.
_NEAR = 1.5


def divide_capture(
    names: Sequence[str],
    *,
    size: int,
    overlap: int,
    loop: bool = False,
    positions: Mapping[str, FloatArray] | None = None,
) -> list[list[str]]:
    """Return the names of the images of each block, in the order of the capture.

    Blocks are stretches of about equal length along the order of the images, each overlapping the next.

    Args:
        names: all images, in the order in which they were taken.
        size: maximum number of images in a stretch.
        overlap: number of images that two consecutive stretches have in common.
        loop: whether the path ends where it began: the last block and the first one overlap, too.
        positions: rough positions (3,) of images in one frame, by name. Where the path comes near a stretch of another
            block again, both blocks get the nearest images of each other, at most `overlap` in all.

    Raises:
        UsageError: if the overlap is not less than half of the size, or fewer than three.
    """
    if overlap < 3:
        raise UsageError(f"blocks are aligned by 3 or more common images: an overlap of {overlap} is too small")
    if 2 * overlap >= size:
        raise UsageError(f"an overlap of {overlap} must be less than half of the size of a block, {size}")
    count = len(names)
    if count <= size:
        return [list(names)]
    length = count + (overlap if loop else 0)
    number = -(-(length - overlap) // (size - overlap))
    starts = np.linspace(0, length - overlap, number + 1).round().astype(int)
    stretches = [
        {idx % count for idx in range(start, min(stop + overlap, length))}
        for start, stop in zip(starts[:-1].tolist(), starts[1:].tolist(), strict=True)
    ]
    if positions is not None:
        stretches = _with_returns(names, stretches, positions, overlap=overlap)
    return [[names[idx] for idx in sorted(stretch)] for stretch in stretches]


def _with_returns(
    names: Sequence[str], stretches: Sequence[set[int]], positions: Mapping[str, FloatArray], *, overlap: int
) -> list[set[int]]:
    """Return the stretches with the images of other stretches where the path returns."""
    known = [[idx for idx in sorted(stretch) if names[idx] in positions] for stretch in stretches]
    centers = [np.array([positions[names[idx]] for idx in own]).reshape(-1, 3) for own in known]
    steps = [np.linalg.norm(np.diff(own, axis=0), axis=1) for own in centers if len(own) > 1]
    reach = _NEAR * float(np.median(np.concatenate(steps))) if steps else 0.0
    found = [set(stretch) for stretch in stretches]
    for here, there in permutations(range(len(stretches)), 2):
        if stretches[here] & stretches[there] or not len(centers[here]) or not len(centers[there]):
            continue
        distances = np.asarray(cKDTree(centers[here]).query(centers[there])[0])
        nearest = [n for n in np.argsort(distances, kind="stable").tolist() if distances[n] <= reach]
        added = {known[there][n] for n in nearest[: -(-overlap // 2)]}
        found[here] |= added
    return found
