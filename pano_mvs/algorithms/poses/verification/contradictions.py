"""Parts of a model that verified pairs contradict: the cut through its cameras that most evidence speaks against.

A camera, or a room, in a wrong place mostly has pairs of its own that put it there: structure repeats. Other pairs
are right, and contradict the cameras. Counted by camera or over all pairs they are few; counted among the pairs
that cross the cut between the wrong part and the rest, they weigh nearly as much as those that agree.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array

from pano_mvs.algorithms.poses.placement.placed_model import PlacedModel
from pano_mvs.algorithms.poses.placement.view_graph import Edge
from pano_mvs.geometry import angle_between, geodesic_angle
from pano_mvs.scene import TwoView

MAX_CONTRADICTED = 0.3
"""Greatest share of the significance of the pairs across a cut that may contradict the cameras. Of 34 groups of a real
tour and seven rendered houses, none of the 28 right ones has such a cut, and three of the six others do, from .42."""


@dataclass(frozen=True)
class ContradictedPart:
    """A part of a model, no larger than the rest, whose place verified pairs contradict."""

    images: tuple[int, ...]  # of the part; all images of the model if both sides of the cut are equally large
    share: float  # of the significance of all verified pairs across the cut, that of those that contradict the cameras
    pair: Edge  # the most significant pair that contradicts


def contradicted_parts(
    model: PlacedModel, shares: Mapping[int, float], *, more_than: float = MAX_CONTRADICTED
) -> list[ContradictedPart]:
    """Return the parts of a model that are contradicted, each of them found after the ones before were left out.

    Args:
        model: the cameras, with their verified pairs if these are known.
        shares: image position to the share of its texture that other images confirm, NaN where unknown. Parts of which
            the images confirm most are not returned.
        more_than: smallest share of the significance of the pairs across the cut.
    """
    significance = _significance(model)
    left = set(model.cameras)
    found = []
    while (part := _most_contradicted(significance, left, more_than)) is not None:
        # Where the images confirm more than this share of the texture, matches that contradict a part come from what
        # repeats.
        if np.nan_to_num([shares.get(image, np.nan) for image in part.images]).mean() <= 0.5:
            found.append(part)
        left -= {*part.images}
    return found


def _significance(model: PlacedModel) -> dict[Edge, tuple[float, float]]:
    """Return the significance of each verified pair that agrees with the cameras, and that which contradicts them.

    A pair counts by how many more matches support its geometry that agrees than one that does not, or the other way
    round: where structure repeats, both may have nearly as many, and the pair decides nothing.
    """
    found = {}
    for edge, view in (model.pairs.compared or {}).items():
        if view and model.cameras.keys() >= {*edge}:
            matches = {True: 0, False: 0}
            for one in (view, *view.alternatives):
                agrees = agrees_with(model, edge, one)
                matches[agrees] = max(matches[agrees], len(one))
            # −log₁₀ of the false alarms that one pair counts at most
            margin = min(-view.log10_false_alarms, 200.0) * (matches[True] - matches[False]) / max(matches.values())
            found[edge] = max(margin, 0.0), max(-margin, 0.0)
    return found


def agrees_with(model: PlacedModel, edge: Edge, view: TwoView) -> bool:
    """Return whether the geometry of a pair agrees with the cameras of a model."""
    relative = model.cameras[edge[1]] @ model.cameras[edge[0]].inverse()
    turned = geodesic_angle(view.rotation, relative.rotation)
    return bool(
        turned < float(np.deg2rad(3.0))
        and angle_between(view.direction, relative.translation) < float(np.deg2rad(10.0))
    )


def _most_contradicted(
    significance: Mapping[Edge, tuple[float, float]], images: Collection[int], more_than: float
) -> ContradictedPart | None:
    """Return the part of some images whose cut gains most by contradictions; None if none has enough."""
    members = sorted(images)
    number = {image: idx for idx, image in enumerate(members)}
    edges = [edge for edge in significance if number.keys() >= {*edge}]
    if not edges:
        return None
    ends = np.array([[number[image] for image in edge] for edge in edges]).T
    agreeing, against = np.array([significance[edge] for edge in edges]).T
    gains = (1 - more_than) * against - more_than * agreeing
    graph = csr_array(coo_array((np.tile(gains, 2), np.concatenate([ends, ends[::-1]], axis=1)), (len(members),) * 2))
    heaviest = [idx for idx in np.argsort(-against, kind="stable")[:20] if against[idx] > 0]
    cuts = [_best_cut(graph, start) for start in dict.fromkeys(ends[:, heaviest].T.ravel().tolist())]
    scores = [float(gains[sides[ends[0]] != sides[ends[1]]].sum()) for sides in cuts]
    if not scores or max(scores) <= 0:
        return None
    sides = cuts[int(np.argmax(scores))]
    crossing = sides[ends[0]] != sides[ends[1]]
    first, second = (np.flatnonzero(sides == side) for side in (-1, 1))
    smaller = range(len(sides)) if len(first) == len(second) else min(first, second, key=len)
    share = float(against[crossing].sum() / (agreeing + against)[crossing].sum())
    pair = edges[int(np.argmax(np.where(crossing, against, -1.0)))]
    return ContradictedPart(tuple(members[idx] for idx in smaller), share, pair)


def _best_cut(graph: csr_array, start: int) -> NDArray[np.float64]:
    """Return sides −1 and 1 of all nodes, the best in a sequence of single changes that starts with a part of one node.

    Each node changes its side once, the one that gains most first, also where that loses, as a room has to go over
    together (Kernighan & Lin, "An Efficient Heuristic Procedure for Partitioning Graphs", 1970).
    """
    sides = np.full(graph.shape[0], -1.0)
    sides[start] = 1.0
    pull = graph @ sides
    free = np.ones(len(sides), np.bool_)
    free[start] = False
    best, score, most = sides.copy(), 0.0, 0.0
    for _ in range(len(sides) - 2):
        node = int(np.argmax(np.where(free, sides * pull, -np.inf)))
        score += sides[node] * pull[node]  # what the cut gains if the node changes its side
        free[node] = False
        sides[node] *= -1
        begin, end = graph.indptr[node], graph.indptr[node + 1]
        pull[graph.indices[begin:end]] += 2 * sides[node] * graph.data[begin:end]
        if score > most + 1e-9:
            best, most = sides.copy(), score
    return best
