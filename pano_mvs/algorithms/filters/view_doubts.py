"""Doubt the pose of a view whose ranges the other views contradict, where its neighbours agree with theirs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_NEIGHBOURS = 4
# Of what its neighbours have. Cameras with true poses had 0.64 and more of it (rendered and synthetic rooms, plain ones
# too; 4 to 9 views, 2 to 8 sources), those at the edge of a capture least; half a metre off they had 0.47 at most.
_MIN_SHARE_OF_NEIGHBOURS = 0.55
# Cameras with true poses had 0.62 at most, half a metre off 0.63 and more. This does not suffice alone: it keeps views
# apart that agree little because their errors scatter.
_MIN_ONE_WAY = 0.55
# Where neighbours agree with nobody either, or little can be compared, nothing is known.
_MIN_AGREED, _MIN_COMPARED = 0.1, 0.2
_MIN_VIEWS = 3


@dataclass(frozen=True, slots=True)
class Agreement:
    """What the sources of a view say of its ranges, by solid angle.

    Attributes:
        compared: share of the sphere with a range that some source can compare with its own.
        agreed: share of that with which some source agrees.
        seen_through: share of that with which no source agrees and through which three in four of the sources that can
            tell, two or more, see something farther away.
        hidden: likewise with something nearer, which hides it.
    """

    compared: float
    agreed: float
    seen_through: float
    hidden: float

    @property
    def one_way(self) -> float:
        """The share that the sources contradict unanimously, in one direction or the other."""
        return self.seen_through + self.hidden


def view_doubts(agreements: Mapping[str, Agreement], centers: Mapping[str, NDArray[np.float64]]) -> dict[str, str]:
    """Return the views whose poses are doubtful, with the reason.

    A view is doubtful if its sources agree with far fewer of its ranges than is usual for the views around it, and if
    they contradict most of the rest in one direction. Matching errors scatter; a wrong pose moves everything.

    Args:
        agreements: by view.
        centers: (3,) camera centres of the views of one world; views without one are not judged.
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
            doubts[name] = (f"other views agree with {100 * agreed[idx]:.0f} % of its ranges (usual around it: "
                            f"{100 * usual:.0f} %) and contradict {100 * one_way:.0f} % in one direction")  # fmt: skip
    return doubts


def nearest_views(places: NDArray[np.float64]) -> Iterator[NDArray[np.int64]]:
    """Yield for each view the indices of the four nearest others, the nearest first; equally near ones in their order.

    Args:
        places: (N, 3) camera centres, two or more.
    """
    from scipy.spatial import cKDTree

    count = min(_NEIGHBOURS, len(places) - 1)
    tree = cKDTree(places)
    # The place itself is among those found, unless more than `count` others coincide with it.
    farthest = np.asarray(tree.query(places, k=count + 1)[0])[:, -1]
    for idx, place in enumerate(places):
        # A little more than the distance of the last one, so that none at the same distance is missed by rounding.
        within = np.array(sorted(tree.query_ball_point(place, farthest[idx] * (1 + 1e-9))), np.int64)
        within = within[within != idx]
        yield within[np.argsort(np.linalg.norm(places[within] - place, axis=1), kind="stable")[:count]]
