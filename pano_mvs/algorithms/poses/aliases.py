"""Blocks of cameras that repeated structure has shifted together, and the moves that would put them back.

Where a row of equal doors or columns repeats, all pairs between two blocks of cameras may agree on a relative place
that is one period off: each camera is then well supported, and no camera can be moved alone. But some pairs also have a
runner-up geometry, supported by what does not repeat, and all of these suggest the same move of one block.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.poses.placed_model import PlacedModel
from pano_mvs.algorithms.poses.view_graph import Edge
from pano_mvs.geometry import Rigid3

FloatArray = NDArray[np.float64]

_MAX_TURN_RAD = float(np.deg2rad(3.0))
# A move shorter than this share of the pair's distance is an error, not another place.
_MIN_MOVE = 0.05
# Moves are one if they differ by less than this share of their length and of the usual distance between cameras.
_SAME_MOVE, _SAME_PLACE = 0.06, 0.02
_MIN_PAIRS, _MIN_PAIR_SHARE = 3, 0.1
_MAX_ALIASES, _ATTEMPTS = 2, 6
# How much a pair that agrees as things are counts against separating its images.
_HELD = 0.1
_LABELLINGS = 2
_STARTS = 50
# Of very many suggested moves the heaviest are compared with one another.
_MAX_MOVES = 1500


@dataclass(frozen=True, eq=False)
class Alias:
    """A move that runner-up geometries of several pairs suggest alike.

    Attributes:
        move: (3,) in the world.
        support: weight of the pairs that suggest it.
        votes: (i, j), i < j, to a signed weight: positive if j is to move by `move` relative to i, negative if by its
            opposite.
    """

    move: FloatArray
    support: float
    votes: dict[Edge, float]


def find_aliases(model: PlacedModel) -> list[Alias]:
    """Return the moves that runner-up geometries of several pairs suggest alike, best supported first.

    Fewer than three pairs, or than a tenth of those that agree as things are, may do so by chance.
    """
    edges, moves, weights = _suggested_moves(model)
    if not edges:
        return []
    lengths = np.linalg.norm(moves, axis=1)
    spread = float(np.median(lengths))
    tolerance = _SAME_MOVE * lengths + _SAME_PLACE * spread
    apart = np.linalg.norm(moves[:, None] - moves[None], axis=2)
    opposite = np.linalg.norm(moves[:, None] + moves[None], axis=2)
    near = np.minimum(apart, opposite) < tolerance[:, None]
    left = np.ones(len(edges), np.bool_)
    found: list[Alias] = []
    for _ in range(_ATTEMPTS):
        if not left.any() or len(found) == _MAX_ALIASES:
            break
        votes = [_votes(edges, weights, apart[row] <= opposite[row], near[row] & left) for row in range(len(edges))]
        support = np.array([sum(map(abs, vote.values())) for vote in votes]) * left
        best = int(np.argmax(support))
        members = np.flatnonzero(near[best] & left)
        left[members] = False
        left[best] = False
        if len(votes[best]) < max(_MIN_PAIRS, _MIN_PAIR_SHARE * len(model.chosen)):
            continue
        signs = np.where(apart[best, members] <= opposite[best, members], 1.0, -1.0)
        move = np.average(moves[members] * signs[:, None], axis=0, weights=weights[members])
        found.append(Alias(move, float(support[best]), votes[best]))
    return found


def labellings(model: PlacedModel, alias: Alias) -> list[dict[int, int]]:
    """Return which cameras an alias may have shifted, image position to 0 or 1 (to be moved); the likeliest first.

    A labelling is good if many pairs that suggest the move join images with different labels, the right way round, and
    few pairs join such images that do not suggest it. Each is the best that single changes lead to from one vote. The
    last is the best that cuts the capture in two where it lies in its order, since people take panoramas along a way.
    """
    images = sorted(model.cameras)
    place = {image: idx for idx, image in enumerate(images)}
    # gain[a, b]: what moving b while a stays gains.
    gain = np.zeros((len(images), len(images)))
    for (i, j), rank in model.chosen.items():
        held = _HELD * model.pairs.geometries[i, j][rank].weight
        gain[place[i], place[j]] -= held
        gain[place[j], place[i]] -= held
    for (i, j), vote in alias.votes.items():
        a, b = (i, j) if vote > 0 else (j, i)
        gain[place[a], place[b]] += abs(vote)
        gain[place[b], place[a]] -= abs(vote)
    found: dict[tuple[int, ...], float] = {}
    for (i, j), vote in sorted(alias.votes.items(), key=lambda item: (-abs(item[1]), item[0]))[:_STARTS]:
        a, b = (place[i], place[j]) if vote > 0 else (place[j], place[i])
        labels = np.zeros(len(images), np.intp)
        labels[b] = 1
        labels, score = _improved(gain, labels, kept=(a, b))
        if score > 0:
            found[tuple(labels.tolist())] = score
    best = sorted(found, key=lambda labels: (-found[labels], labels))[:_LABELLINGS]
    best += [labels for labels in _best_cut(gain) if labels not in best]
    return [dict(zip(images, labels, strict=True)) for labels in best]


def moved_cameras(model: PlacedModel, alias: Alias, labels: dict[int, int]) -> dict[int, Rigid3]:
    """Return the cameras of a model with a block moved by an alias.

    Those with label 1 move; if they are the larger part, the others move the other way, which is the same arrangement.
    """
    ones = sum(labels.values())
    mover, move = (1, alias.move) if 2 * ones <= len(labels) else (0, -alias.move)
    return {
        image: Rigid3.from_center(camera.rotation, camera.center + move) if labels[image] == mover else camera
        for image, camera in model.cameras.items()
    }


def _suggested_moves(model: PlacedModel) -> tuple[list[Edge], FloatArray, FloatArray]:
    """Return how geometries that were not chosen would move the second image of a pair relative to the first."""
    edges: list[Edge] = []
    moves: list[FloatArray] = []
    weights: list[float] = []
    for i, j in model.pairs.geometries:
        if i not in model.cameras or j not in model.cameras:
            continue
        for fixed, image, sign in ((i, j, 1.0), (j, i, -1.0)):
            witnesses = model.witnesses(image, [fixed])
            distance = float(np.linalg.norm(model.cameras[image].center - model.cameras[fixed].center))
            for idx in np.flatnonzero(np.isfinite(witnesses.lengths)):
                if model.chosen.get((i, j)) == witnesses.rank[idx]:
                    continue
                there = witnesses.origins[idx] + witnesses.lengths[idx] * witnesses.directions[idx]
                move = sign * (there - model.cameras[image].center)
                cosine = (np.sum(witnesses.rotations[idx] * model.cameras[image].rotation) - 1) / 2
                if cosine > np.cos(_MAX_TURN_RAD) and float(np.linalg.norm(move)) > _MIN_MOVE * distance:
                    edges.append((i, j))
                    moves.append(move)
                    weights.append(float(witnesses.weight[idx]))
    heaviest = np.sort(np.argsort(-np.array(weights), kind="stable")[:_MAX_MOVES])
    return [edges[idx] for idx in heaviest], np.array(moves).reshape(-1, 3)[heaviest], np.array(weights)[heaviest]


def _votes(
    edges: list[Edge], weights: FloatArray, same_way: NDArray[np.bool_], near: NDArray[np.bool_]
) -> dict[Edge, float]:
    """Return the heaviest vote of each pair among the moves that are near one of them."""
    votes: dict[Edge, float] = {}
    for idx in np.flatnonzero(near):
        signed = float(weights[idx]) if same_way[idx] else -float(weights[idx])
        if abs(signed) > abs(votes.get(edges[idx], 0.0)):
            votes[edges[idx]] = signed
    return votes


def _best_cut(gain: FloatArray) -> list[tuple[int, ...]]:
    """Return the best labelling in which the images up to one have one label, and those after it the other."""
    count = len(gain)
    cuts = []
    for first in range(1, count):
        for before, after in ((0, 1), (1, 0)):
            labels = np.repeat([before, after], [first, count - first])
            cuts.append((float(gain[np.ix_(labels == 0, labels == 1)].sum()), tuple(labels.tolist())))
    return [max(cuts)[1]] if cuts else []


def _improved(gain: FloatArray, labels: NDArray[np.intp], *, kept: tuple[int, int]) -> tuple[NDArray[np.intp], float]:
    """Change one label after another as long as the score rises; the two labels of the first vote stay.

    The score is the sum of gain[a, b] over all a with label 0 and b with label 1.
    """
    labels = labels.copy()
    for _ in range(4 * len(labels)):
        stays, moves = (labels == 0).astype(np.float64), (labels == 1).astype(np.float64)
        # What an image contributes as one that moves, less what it contributes as one that stays.
        rise = stays @ gain - gain @ moves
        rise = np.where(labels == 0, rise, -rise)
        rise[list(kept)] = -np.inf
        best = int(np.argmax(rise))
        if rise[best] <= 1e-12:
            break
        labels[best] = 1 - labels[best]
    return labels, float(gain[np.ix_(labels == 0, labels == 1)].sum())
