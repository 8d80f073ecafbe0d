"""Choose pairs of images to match by their order alone."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

from pano_mvs.core.errors import UsageError
from pano_mvs.scene import Pairs


def exhaustive_pairs(names: Sequence[str]) -> Pairs:
    """Return every pair of images, in the order of the capture."""
    return Pairs(tuple(combinations(names, 2)))


def sequential_pairs(names: Sequence[str], *, window: int = 5, loop: bool = False) -> Pairs:
    """Return the pairs of images that are at most `window` positions apart.

    Args:
        names: image names in the order in which they were taken.
        window: each image is paired with this number of following images.
        loop: whether the first image follows the last one.

    Raises:
        UsageError: if the window is less than 1.
    """
    if window < 1:
        raise UsageError(f"the window of sequential pairs must be at least 1, got {window}")
    count = len(names)
    pairs = {
        (min(first, second), max(first, second))
        for first in range(count)
        for second in (first + step for step in range(1, window + 1))
        for second in ([second] if second < count else [second % count] if loop else [])
        if first != second
    }
    return Pairs(tuple((names[first], names[second]) for first, second in sorted(pairs)))
