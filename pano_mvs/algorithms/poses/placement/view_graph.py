"""View graph: images joined by verified pairs, consistency of its edges, and connected groups."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np
import scipy
from numpy.typing import NDArray

from pano_mvs.geometry import Rigid3, geodesic_angle
from pano_mvs.scene import TwoView

Edge = tuple[int, int]


def consistent_edges(names: tuple[str, ...], two_views: Mapping[tuple[str, str], TwoView]) -> dict[Edge, TwoView]:
    """Return the pairs with a general geometry whose rotations are consistent with the pairs around them.

    The three rotations around a triangle of images must cancel to 3° (Zach et al. 2010). While any triangle does not
    close, remove the pair with the largest share of such triangles; of equals, the one with fewest matches.

    Args:
        names: image names in the capture's order.
        two_views: verified pairs, in either order of names.

    Returns:
        (first, second) positions in `names`, first < second, to the geometry second_from_first.
    """
    edges = {edge: view for edge, view in views_by_position(names, two_views).items() if view}
    keys = list(edges)
    triangles = _triangles(keys)
    rotations = np.array([view.rotation for view in edges.values()]).reshape(-1, 3, 3)
    # The rotation around a loop should be none.
    there, on, directly = (rotations[triangles[:, side]] for side in range(3))
    closes = geodesic_angle(on @ there, directly) < np.deg2rad(3.0)
    sizes = np.array([len(view) for view in edges.values()])
    of_edge = _triangles_of_edges(triangles, len(keys))
    good, bad = (np.bincount(triangles[which].ravel(), minlength=len(keys)) for which in (closes, ~closes))
    there = np.ones(len(triangles), np.bool_)
    while bad.any():
        share = bad / np.maximum(bad + good, 1)
        worst = int(np.lexsort((np.arange(len(keys)), -sizes, share))[-1])
        del edges[keys[worst]]
        gone = of_edge[worst][there[of_edge[worst]]]
        there[gone] = False
        np.subtract.at(good, triangles[gone[closes[gone]]].ravel(), 1)
        np.subtract.at(bad, triangles[gone[~closes[gone]]].ravel(), 1)
    return edges


def connected_groups(edges: Iterable[Edge], count: int) -> list[list[int]]:
    """Return the connected groups of images, largest first; of equals, the group with the earliest image first."""
    ends = np.array(list(edges), np.intp).reshape(-1, 2)
    graph = scipy.sparse.coo_array((np.ones(len(ends)), ends.T), (count, count))
    label = scipy.sparse.csgraph.connected_components(graph, directed=False)[1]
    groups = [np.flatnonzero(label == number).tolist() for number in range(label.max(initial=-1) + 1)]
    return sorted(groups, key=lambda group: (-len(group), group[0]))


def views_by_position(names: tuple[str, ...], two_views: Mapping[tuple[str, str], TwoView]) -> dict[Edge, TwoView]:
    """Return all pairs, verified or not, by positions (first, second), first < second, as second_from_first."""
    position = {name: idx for idx, name in enumerate(names)}
    edges: dict[Edge, TwoView] = {}
    for (first, second), view in two_views.items():
        if first in position and second in position:
            edge = position[first], position[second]
            edges[min(edge), max(edge)] = view if edge[0] < edge[1] else _reversed(view)
    return dict(sorted(edges.items()))


def _reversed(view: TwoView) -> TwoView:
    inverse = Rigid3(view.rotation, view.direction).inverse()
    matches: NDArray[np.int32] = view.matches_idx[:, ::-1]
    others = None if view.unverified_idx is None else view.unverified_idx[:, ::-1]
    best = replace(
        view, matches_idx=matches, rotation=inverse.rotation, direction=inverse.translation, unverified_idx=others
    )
    return best.with_alternatives([_reversed(other) for other in view.alternatives])


def _triangles(keys: list[Edge]) -> NDArray[np.intp]:
    """Return the triangles i < j < k as positions in `keys` of their edges (i, j), (j, k), (i, k); (T, 3)."""
    number = {edge: idx for idx, edge in enumerate(keys)}
    after: dict[int, set[int]] = {}
    for first, second in keys:
        after.setdefault(first, set()).add(second)
    found = [
        (number[i, j], number[j, k], number[i, k]) for i, j in keys for k in sorted(after[i] & after.get(j, set()))
    ]
    return np.array(found, np.intp).reshape(-1, 3)


def _triangles_of_edges(triangles: NDArray[np.intp], count: int) -> list[NDArray[np.intp]]:
    """Return the positions of the triangles of every edge."""
    edge_of_corner = triangles.ravel()
    by_edge = np.argsort(edge_of_corner, kind="stable") // 3
    return np.split(by_edge, np.cumsum(np.bincount(edge_of_corner, minlength=count))[:-1]) if count else []
