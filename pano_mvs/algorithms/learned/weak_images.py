"""Which images SIFT does not place firmly."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Annotated, Literal

import numpy as np
import scipy

from pano_mvs.algorithms.matching.pair_selection import similarities
from pano_mvs.algorithms.poses.placement.placed_model import Pairs, PlacedModel
from pano_mvs.algorithms.poses.placement.view_graph import connected_groups
from pano_mvs.core.settings import Setting, checks_settings
from pano_mvs.scene import Features, Poses, TwoView, WeakImages
from pano_mvs.scene.pose_groups import split_groups


@checks_settings
def weak_images(
    features: Mapping[str, Features],
    matches: Mapping[tuple[str, str], TwoView],
    poses: Poses,
    *,
    learned: Annotated[
        Literal["auto", "always", "never"],
        Setting("which images get learned key points: those that are not placed firmly without them, all or none"),
    ] = "auto",
    partners: Annotated[int, Setting("number of similar images that a weak one may match", ge=1)] = 10,
) -> WeakImages:
    """Find the images that are not placed firmly by matches without a network.

    An image is placed firmly if it is in the group of poses that has most images of the capture, and if two or more
    pairs connect it with most others across every cut between them. Pairs count if one of their geometries agrees with
    the poses. Doubts do not count: they mostly come from structure that repeats, which deceives networks as well.

    Args:
        features: key points of all images, in the capture's order.
        matches: the verified pairs.
        poses: what a solver made of these pairs.
    """
    names = list(features)
    if learned != "auto":
        return WeakImages(weak=tuple(names)) if learned == "always" else WeakImages(others=tuple(names))
    firm = _firmly_placed(poses, matches, count=len(names))
    weak = [idx for idx, name in enumerate(names) if name not in firm]
    if not weak:
        return WeakImages(others=tuple(names))
    alike = similarities(features.values())
    np.fill_diagonal(alike, -np.inf)
    similar = {int(idx) for one in weak for idx in np.argsort(-alike[one], kind="stable")[:partners]} - {*weak}
    rest = set(range(len(names))) - {*weak} - similar
    groups = (sorted(group) for group in (weak, similar, rest))
    return WeakImages(*(tuple(names[idx] for idx in group) for group in groups))


def _firmly_placed(poses: Poses, matches: Mapping[tuple[str, str], TwoView], *, count: int) -> set[str]:
    """Return the images that are placed firmly among most of a capture (see `weak_images`).

    Args:
        poses: of the images that a solver has placed.
        matches: the pairs from which it has.
        count: number of images of the capture.
    """
    group = split_groups(poses)[0]
    names = group.names
    place = {name: idx for idx, name in enumerate(names)}
    model = PlacedModel(Pairs.without(names), {idx: group.cam_from_world(idx) for idx in place.values()})
    edges = []
    for (first, second), view in matches.items():
        if view and place.keys() >= {first, second}:
            edge = place[first], place[second]
            # Where structure repeats, most pairs have the right geometry among their alternatives.
            if any(model.agrees_with(edge, geometry) for geometry in (view, *view.alternatives)):
                edges.append(edge)
    # One pair leaves the distance open, two give ten equations for six unknowns; two images have one pair at most.
    firm = _largest(edges if count == 2 else _without_bridges(edges, len(names)), len(names))
    return {names[idx] for idx in firm} if 2 * len(firm) > count else set()


def _largest(edges: Collection[tuple[int, int]], count: int) -> list[int]:
    return max(connected_groups(edges, count), key=len, default=[])


def _without_bridges(edges: Collection[tuple[int, int]], count: int) -> list[tuple[int, int]]:
    """Return the edges of a graph that are on a cycle: what they connect, no single edge separates.

    Each edge outside a spanning tree gets a random number. Those that pass a cut of the tree are the ones that begin on
    one side of it: the exclusive or of the numbers at the nodes below it is 0 only if there are none.
    """
    ends = np.array(sorted({(min(edge), max(edge)) for edge in edges}), np.intp).reshape(-1, 2)
    graph = scipy.sparse.csr_array(scipy.sparse.coo_array((np.ones(len(ends), np.int8), ends.T), (count, count)))
    above = np.full(count, -1)
    below: list[int] = []
    seen = np.zeros(count, np.bool_)
    for root in range(count):
        if not seen[root]:
            order, before = scipy.sparse.csgraph.breadth_first_order(graph, root, directed=False)
            seen[order] = True
            above[order[1:]] = before[order[1:]]
            below += order[1:].tolist()
    in_tree = (above[ends[:, 0]] == ends[:, 1]) | (above[ends[:, 1]] == ends[:, 0])
    numbers = np.random.default_rng(0).integers(1, 2**63, len(ends))
    passing = np.zeros(count, np.int64)
    for edge, number in zip(ends[~in_tree], numbers[~in_tree], strict=True):
        passing[edge] ^= number
    for node in reversed(below):
        passing[above[node]] ^= passing[node]
    bridges = {tuple(sorted((node, int(above[node])))) for node in below if not passing[node]}
    return [(int(a), int(b)) for a, b in ends if (int(a), int(b)) not in bridges]
