"""Which images SIFT does not place firmly."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Annotated, Literal

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import maximum_flow

from pano_mvs.algorithms.matching.pair_selection import similarities
from pano_mvs.algorithms.poses.placement.placed_model import Pairs, PlacedModel
from pano_mvs.core.settings import Setting, checks_settings
from pano_mvs.scene import Features, Poses, TwoView, WeakImages
from pano_mvs.scene.pose_groups import split_groups

_DETERMINED_BY = 2  # pairs: one leaves the distance open, two give ten equations for six unknowns


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
    pairs that agree with the poses connect it with most others across every cut between them. Doubts do not count: they
    mostly come from structure that repeats, which deceives networks as well.

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
    edges = [
        (place[first], place[second])
        for (first, second), view in matches.items()
        if view and place.keys() >= {first, second} and model.agrees_with((place[first], place[second]), view)
    ]
    firm = _firmly_connected(edges, len(names), at_least=min(_DETERMINED_BY, count - 1))
    return {names[idx] for idx in firm} if 2 * len(firm) > count else set()


def _firmly_connected(edges: Collection[tuple[int, int]], count: int, *, at_least: int) -> set[int]:
    """Return the largest set of nodes, any two of which are connected by `at_least` paths without a common edge.

    By Menger's theorem, every cut between two of them then has at least this number of edges.
    """
    ends = np.array(edges, np.intp).reshape(-1, 2)
    both = np.concatenate([ends, ends[:, ::-1]]).T
    graph = csr_array(coo_array((np.ones(both.shape[1], np.int32), both), (count, count)))
    degree = graph.sum(axis=0)
    left, largest = set(range(count)), set[int]()
    while len(left) > len(largest):
        root = max(left, key=lambda node: (degree[node], -node))
        others = (node for node in sorted(left - {root}) if degree[node] >= at_least)
        found = {root, *(node for node in others if maximum_flow(graph, root, node).flow_value >= at_least)}
        largest = max(largest, found, key=len)
        left -= found
    return largest
