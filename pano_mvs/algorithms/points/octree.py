"""An octree of a cloud for viewers: each node adds points to those of its parents, so that nodes refine each other.

The points of a node are a random sample of those in its cube that its parents do not have.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

NODE_POINTS = 30_000
"""Largest number of points that a node adds."""

_SMALL_CHILD = 500


@dataclass(frozen=True, eq=False)
class OctreeNode:
    """A cube of the octree."""

    name: str  # "r" for the root; a child's name is its parent's and its octant's number, bit 0 for x, 1 for y, 2 for z
    lower: NDArray[np.float64]  # (3,) float64, the cube's corner with the smallest coordinates
    size: float  # length of its edges
    chosen: NDArray[np.int64]  # (K,) int64, the points that this node adds, in no order


def octree(
    points: NDArray[np.float32], among: NDArray[np.int64] | None = None, *, node_points: int = NODE_POINTS
) -> list[OctreeNode]:
    """Return the nodes of a cloud's octree, parents before their children; each point is in exactly one node.

    Args:
        points: (N, 3), which may be memory-mapped.
        among: (M,) the points to use; None: all.
        node_points: largest number of points that a node adds to those of its parents.
    """
    used = np.arange(len(points), dtype=np.int64) if among is None else among
    if not len(used):
        return []
    lower, upper = points[used].min(axis=0).astype(np.float64), points[used].max(axis=0)
    size = float((upper - lower).max()) * (1 + 1e-6) or 1.0
    order = np.random.default_rng(0).permutation(used)
    nodes: list[OctreeNode] = []
    pending = [("r", lower, size, order)]
    while pending:
        name, lower, size, inside = pending.pop(0)
        if len(inside) <= node_points + _SMALL_CHILD or len(name) > 20:
            nodes.append(OctreeNode(name, lower, size, inside))
            continue
        half = size / 2
        rest = inside[node_points:]
        octants = (points[rest] >= lower + half) @ np.array([1, 2, 4])
        kept = [inside[:node_points]]
        for octant in range(8):
            child = rest[octants == octant]
            if len(child) < _SMALL_CHILD:  # a file of its own would not pay
                kept.append(child)
            else:
                corner = lower + half * np.array([octant & 1, octant >> 1 & 1, octant >> 2 & 1])
                pending.append((f"{name}{octant}", corner, half, child))
        nodes.append(OctreeNode(name, lower, size, np.concatenate(kept)))
    return nodes
