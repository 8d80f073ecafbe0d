"""Detect views with doubtful poses: other views contradict their ranges, but agree with those of their neighbours."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_NEIGHBOURS = 4
# Relative to the agreement of its neighbours. Cameras with true poses had 0.64 or more (rendered and synthetic rooms,
# including plain ones; 4 to 9 views, 2 to 8 sources), lowest at the edge of a capture; cameras half a metre off had at
# most 0.47.
_MIN_SHARE_OF_NEIGHBOURS = 0.55
# Cameras with true poses had at most 0.62, cameras half a metre off 0.63 or more. This is not sufficient alone: it
# excludes views that agree little because their errors scatter.
_MIN_ONE_WAY = 0.55
# If neighbours agree with no view either, or little can be compared, nothing can be concluded.
_MIN_AGREED, _MIN_COMPARED = 0.1, 0.2
_MIN_VIEWS = 3


@dataclass(frozen=True, slots=True)
class Agreement:
    """Agreement of a view's sources with its ranges, by solid angle.

    Attributes:
        compared: share of the sphere with a range that at least one source can compare with its own.
        agreed: share of that with which at least one source agrees.
        seen_through: share of that with which no source agrees and behind which at least three quarters of the
            comparing sources, and at least two, see something farther away.
        hidden: likewise with something nearer, which occludes it.
    """

    compared: float
    agreed: float
    seen_through: float
    hidden: float

    @property
    def one_way(self) -> float:
        """The share that the sources contradict unanimously in one direction."""
        return self.seen_through + self.hidden


def view_doubts(agreements: Mapping[str, Agreement], centers: Mapping[str, NDArray[np.float64]]) -> dict[str, str]:
    """Return the views with doubtful poses, with the reason.

    A view is doubtful if its sources agree with a much smaller share of its ranges than is usual for the views around
    it, and if they contradict most of the rest in one direction. Matching errors scatter; a wrong pose moves
    everything.

    Args:
        agreements: view name to agreement.
        centers: (3,) camera centres of the views of one world frame; views without one are not judged.
    """
    names = [name for name in agreements if name in centers and agreements[name].compared >= _MIN_COMPARED]
    if len(names) < _MIN_VIEWS:
        return {}
    places = np.array([centers[name] for name in names])
    agreed = np.array([agreements[name].agreed for name in names])
    doubts = {}
    for idx, (name, around) in enumerate(zip(names, nearest_views(places), strict=True)):
        usual = float(np.median(agreed[around]))
        one_way = agreements[name].one_way
        if usual >= _MIN_AGREED and agreed[idx] < _MIN_SHARE_OF_NEIGHBOURS * usual and one_way >= _MIN_ONE_WAY:
            doubts[name] = (
                f"other views agree with {100 * agreed[idx]:.0f} % of its ranges (usual around it: {100 * usual:.0f} "
                f"%) and contradict {100 * one_way:.0f} % in one direction"
            )
    return doubts


def nearest_views(places: NDArray[np.float64]) -> Iterator[NDArray[np.int64]]:
    """Yield for each view the indices of the four nearest other views, nearest first; ties in their order.

    Args:
        places: (N, 3) camera centres, at least two.
    """
    from scipy.spatial import cKDTree

    count = min(_NEIGHBOURS, len(places) - 1)
    tree = cKDTree(places)
    # The view itself is among the results, unless more than `count` others coincide with it.
    farthest = np.asarray(tree.query(places, k=count + 1)[0])[:, -1]
    for idx, place in enumerate(places):
        # Slightly more than the distance of the last one, so that rounding does not exclude ones at the same distance.
        within = np.array(sorted(tree.query_ball_point(place, farthest[idx] * (1 + 1e-9))), np.int64)
        within = within[within != idx]
        yield within[np.argsort(np.linalg.norm(places[within] - place, axis=1), kind="stable")[:count]]
