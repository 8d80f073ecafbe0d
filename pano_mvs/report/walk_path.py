"""The path of a capture that was taken along a walk, and the pairs that close its loops."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

# A capture is a walk if it has at least this number of cameras, most consecutive ones are matched, and most pairs are
# of cameras that follow each other closely, although many others would have been possible.
_MIN_CAMERAS = 20
_WINDOW = 10
_CONSECUTIVE_SHARE = 0.8
_NEAR_SHARE = 0.6
_MAX_PAIR_SHARE = 0.25


@dataclass(frozen=True)
class WalkPath:
    """A walk.

    Attributes:
        stretches: positions of the cameras in order; a new stretch begins where consecutive cameras are not matched.
    """

    stretches: tuple[tuple[int, ...], ...]

    @staticmethod
    def is_closure(first: int, second: int) -> bool:
        """Return whether a pair of positions in the order of the capture is a loop closure."""
        return abs(first - second) > _WINDOW


def find_walk(count: int, pairs: Sequence[tuple[int, int]]) -> WalkPath | None:
    """Return the walk along which cameras were taken, or None if they were not taken along one.

    Args:
        count: number of cameras, in the order of the capture.
        pairs: positions of the matched pairs.
    """
    if count < _MIN_CAMERAS or not pairs:
        return None
    distinct = {(min(pair), max(pair)) for pair in pairs}
    near = sum(b - a <= _WINDOW for a, b in distinct)
    consecutive = [(idx, idx + 1) in distinct for idx in range(count - 1)]
    is_walk = (
        sum(consecutive) >= _CONSECUTIVE_SHARE * (count - 1)
        and near >= _NEAR_SHARE * len(distinct)
        and (len(distinct) <= _MAX_PAIR_SHARE * count * (count - 1) / 2 or near == len(distinct))
    )
    if not is_walk:
        return None
    stretches: list[list[int]] = [[0]]
    for idx, is_matched in enumerate(consecutive, start=1):
        if is_matched:
            stretches[-1].append(idx)
        else:
            stretches.append([idx])
    return WalkPath(tuple(tuple(stretch) for stretch in stretches))
