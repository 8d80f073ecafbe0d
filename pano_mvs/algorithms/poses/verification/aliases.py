"""Blocks of cameras that repeated structure has shifted together, and the motions that put them back.

Where a row of equal doors or columns repeats, all pairs between two blocks of cameras may agree on a relative position
that is one period off: each camera is then well supported, and no camera can be moved alone. But some pairs also have a
runner-up geometry, supported by structure that does not repeat, and all of these suggest the same move of one block. If
two identical rooms face each other, one may be placed on top of the other; the motion then also rotates the block.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.poses.placement.placed_model import PlacedModel
from pano_mvs.algorithms.poses.placement.view_graph import Edge
from pano_mvs.geometry import Rigid3, geodesic_angle, nearest_rotation

FloatArray = NDArray[np.float64]

_MAX_TURN_RAD = float(np.deg2rad(3.0))
# A motion that rotates a block by more than this has six degrees of freedom; two pairs hardly agree on it by chance.
_MIN_TURN_RAD = float(np.deg2rad(20.0))
_MIN_TURNED_PAIRS = 2
# If very many motions are suggested, only the heaviest are compared with one another.
_MAX_MOVES, _MAX_TURNED = 1500, 60


@dataclass(frozen=True, eq=False)
class Alias:
    """A motion that runner-up geometries of several pairs suggest alike."""

    move: FloatArray  # (3,) in the world, after the rotation about the origin
    support: float  # weight of the pairs that suggest it
    # (i, j), i < j, to a signed weight: positive if j is to move by the motion x → turn x + move relative to i,
    # negative if by its inverse
    signed_weights: dict[Edge, float]
    turn: FloatArray = field(default_factory=lambda: np.eye(3))  # (3, 3) rotation of the world, usually the identity
    own_inverse: bool = False  # whether the motion is its own inverse, like a half turn

    def motion(self, *, inverse: bool = False) -> Rigid3:
        """Return the motion of a block, or its inverse."""
        motion = Rigid3(self.turn, self.move)
        return motion.inverse() if inverse else motion


@dataclass(frozen=True, eq=False)
class _Suggestion:
    """The motion of the second image of a pair relative to the first that an unchosen geometry suggests."""

    edge: Edge
    weight: float
    motion: Rigid3
    center: FloatArray
    displacement: FloatArray


def find_aliases(model: PlacedModel) -> list[Alias]:
    """Return the motions that runner-up geometries of several pairs suggest alike, best supported first.

    At least three pairs must suggest a motion, and at least a tenth of the pairs that agree with the current
    arrangement; fewer may agree by chance. For motions that rotate a block, two pairs are enough.
    """
    suggestions = _suggestions(model)
    straight = [found for found in suggestions if _angle(found.motion) < _MAX_TURN_RAD]
    turned = [found for found in suggestions if _angle(found.motion) > _MIN_TURN_RAD]
    return _straight_aliases(model, straight) + _turned_aliases(turned)


def _straight_aliases(model: PlacedModel, suggestions: list[_Suggestion]) -> list[Alias]:
    edges = [found.edge for found in suggestions]
    moves = np.array([found.displacement for found in suggestions]).reshape(-1, 3)
    weights = np.array([found.weight for found in suggestions])
    if not edges:
        return []
    lengths = np.linalg.norm(moves, axis=1)
    spread = float(np.median(lengths))
    # Moves are the same if they differ by less than this share of their length and of the usual distance between
    # cameras.
    tolerance = 0.06 * lengths + 0.02 * spread
    apart = np.linalg.norm(moves[:, None] - moves[None], axis=2)
    opposite = np.linalg.norm(moves[:, None] + moves[None], axis=2)
    near = np.minimum(apart, opposite) < tolerance[:, None]
    left = np.ones(len(edges), np.bool_)
    found: list[Alias] = []
    for _ in range(6):
        if not left.any() or len(found) == 2:
            break
        signed_weights = [
            _signed_weights(edges, weights, apart[row] <= opposite[row], near=near[row] & left)
            for row in range(len(edges))
        ]
        support = np.array([sum(map(abs, signed.values())) for signed in signed_weights]) * left
        best = int(np.argmax(support))
        members = np.flatnonzero(near[best] & left)
        left[members] = False
        left[best] = False
        if len(signed_weights[best]) < max(3, 0.1 * len(model.chosen)):
            continue
        signs = np.where(apart[best, members] <= opposite[best, members], 1.0, -1.0)
        move = np.average(moves[members] * signs[:, None], axis=0, weights=weights[members])
        found.append(Alias(move, float(support[best]), signed_weights[best]))
    return found


def _turned_aliases(suggestions: list[_Suggestion]) -> list[Alias]:
    """Return the motion with a rotation that most pairs suggest, if at least two do; the heaviest ones are compared."""
    suggestions = sorted(suggestions, key=lambda found: (-found.weight, found.edge))[:_MAX_TURNED]
    if len(suggestions) < _MIN_TURNED_PAIRS:
        return []
    spread = float(np.median([np.linalg.norm(found.displacement) for found in suggestions]))
    best: tuple[float, list[_Suggestion], list[bool]] = (0.0, [], [])
    for one in suggestions:
        same = [_same_motion(one.motion, other, spread) for other in suggestions]
        inverse = [_same_motion(one.motion.inverse(), other, spread) for other in suggestions]
        alike = [other for other, a, b in zip(suggestions, same, inverse, strict=True) if a or b]
        heaviest: dict[Edge, float] = {}
        for other in alike:
            heaviest[other.edge] = max(other.weight, heaviest.get(other.edge, 0.0))
        support = sum(heaviest.values())
        if len(heaviest) >= _MIN_TURNED_PAIRS and support > best[0]:
            best = support, alike, [a for a, b in zip(same, inverse, strict=True) if a or b]
    support, alike, same = best
    if not alike:
        return []
    motions = [found.motion if way else found.motion.inverse() for found, way in zip(alike, same, strict=True)]
    weights = np.array([found.weight for found in alike])
    turn = nearest_rotation(np.einsum("n,nij->ij", weights, [motion.rotation for motion in motions]))
    # The translations belong to slightly different rotations, so they are averaged at the cameras.
    pivot = np.average([found.center for found in alike], axis=0, weights=weights)
    move = np.average([motion.apply(pivot) for motion in motions], axis=0, weights=weights) - turn @ pivot
    motion = Rigid3(turn, move)
    own_inverse = all(_same_motion(motion.inverse(), replace(found, motion=motion), spread) for found in alike)
    signed_weights: dict[Edge, float] = {}
    for found, way in zip(alike, same, strict=True):
        if found.weight > abs(signed_weights.get(found.edge, 0.0)):
            signed_weights[found.edge] = found.weight if way or own_inverse else -found.weight
    return [Alias(move, support, signed_weights, turn, own_inverse)]


def _same_motion(motion: Rigid3, other: _Suggestion, spread: float) -> bool:
    """Return whether a motion matches a suggestion, in rotation and in the position of the suggestion's camera."""
    apart = float(np.linalg.norm(motion.apply(other.center) - other.motion.apply(other.center)))
    length = float(np.linalg.norm(other.displacement))
    turned = float(geodesic_angle(motion.rotation, other.motion.rotation))
    # Share of the move and of the usual distance between cameras.
    return turned < _MAX_TURN_RAD and apart < 0.1 * (length + spread)


def _angle(motion: Rigid3) -> float:
    return float(geodesic_angle(motion.rotation, np.eye(3)))


def labellings(model: PlacedModel, alias: Alias) -> list[dict[int, int]]:
    """Return labellings of cameras that an alias may have shifted, image position to 0 or 1 (move), likeliest first.

    A labelling is good if many pairs that suggest the motion join images with different labels, in the right order, and
    few other pairs do. Each labelling is the best one reached by single changes from one suggesting pair. The last
    labelling is the best contiguous part of the capture's order, since people take panoramas along a path.
    """
    images = sorted(model.cameras)
    place = {image: idx for idx, image in enumerate(images)}
    # gain[a, b]: the gain from moving b while a stays.
    gain = np.zeros((len(images), len(images)))
    for (i, j), rank in model.chosen.items():
        # Weight of a pair that agrees with the current arrangement against separating its images.
        held = 0.1 * model.pairs.geometries[i, j][rank].weight
        gain[place[i], place[j]] -= held
        gain[place[j], place[i]] -= held
    for (i, j), signed in alias.signed_weights.items():
        a, b = (i, j) if signed > 0 else (j, i)
        gain[place[a], place[b]] += abs(signed)
        gain[place[b], place[a]] += abs(signed) if alias.own_inverse else -abs(signed)
    found: dict[tuple[int, ...], float] = {}
    for (i, j), signed in sorted(alias.signed_weights.items(), key=lambda item: (-abs(item[1]), item[0]))[:50]:
        a, b = (place[i], place[j]) if signed > 0 else (place[j], place[i])
        labels = np.zeros(len(images), np.intp)
        labels[b] = 1
        labels, score = _improved(gain, labels, kept=(a, b))
        if score > 0:
            found[tuple(labels.tolist())] = score
    best = sorted(found, key=lambda labels: (-found[labels], labels))[:2]
    best += [labels for labels in _best_cut(gain) if labels not in best]
    return [dict(zip(images, labels, strict=True)) for labels in best]


def moved_cameras(model: PlacedModel, alias: Alias, labels: dict[int, int]) -> dict[int, Rigid3]:
    """Return the cameras of a model with a block moved by an alias.

    Cameras with label 1 move. If they are the larger part, the others move the other way, which is the same
    arrangement.
    """
    mover = 1 if 2 * sum(labels.values()) <= len(labels) else 0
    motion = alias.motion(inverse=mover == 0)

    def moved(camera: Rigid3) -> Rigid3:
        return Rigid3.from_center(camera.rotation @ motion.rotation.T, motion.apply(camera.center))

    return {image: moved(camera) if labels[image] == mover else camera for image, camera in model.cameras.items()}


def _suggestions(model: PlacedModel) -> list[_Suggestion]:
    """Return the motions of second images relative to first images that unchosen geometries suggest."""
    suggestions: list[_Suggestion] = []
    for i, j in model.pairs.geometries:
        if i not in model.cameras or j not in model.cameras:
            continue
        for fixed, image, sign in ((i, j, 1.0), (j, i, -1.0)):
            pair_evidence = model.evidence(image, [fixed])
            distance = float(np.linalg.norm(model.cameras[image].center - model.cameras[fixed].center))
            for idx in np.flatnonzero(np.isfinite(pair_evidence.lengths)):
                if model.chosen.get((i, j)) == pair_evidence.rank[idx]:
                    continue
                there = pair_evidence.origins[idx] + pair_evidence.lengths[idx] * pair_evidence.directions[idx]
                here = model.cameras[image]
                turn = pair_evidence.rotations[idx].T @ here.rotation
                motion = Rigid3(turn, there - turn @ here.center)
                displacement = sign * (there - here.center)
                # A move shorter than this share of the pair's distance is an error, not another place.
                if float(np.linalg.norm(displacement)) > 0.05 * distance or _angle(motion) > _MIN_TURN_RAD:
                    motion = motion if sign > 0 else motion.inverse()
                    center = model.cameras[j].center
                    suggestions.append(
                        _Suggestion((i, j), float(pair_evidence.weight[idx]), motion, center, displacement)
                    )
    heaviest = np.sort(np.argsort([-found.weight for found in suggestions], kind="stable")[:_MAX_MOVES])
    return [suggestions[idx] for idx in heaviest]


def _signed_weights(
    edges: list[Edge], weights: FloatArray, same_way: NDArray[np.bool_], *, near: NDArray[np.bool_]
) -> dict[Edge, float]:
    """Return the heaviest signed weight of each pair among the motions that are near one of them."""
    signed_weights: dict[Edge, float] = {}
    for idx in np.flatnonzero(near):
        signed = float(weights[idx]) if same_way[idx] else -float(weights[idx])
        if abs(signed) > abs(signed_weights.get(edges[idx], 0.0)):
            signed_weights[edges[idx]] = signed
    return signed_weights


def _best_cut(gain: FloatArray) -> list[tuple[int, ...]]:
    """Return the best labelling in which a run of consecutive images has one label, and all others the other."""
    count = len(gain)
    total = np.zeros((count + 1, count + 1))
    total[1:, 1:] = gain.cumsum(axis=0).cumsum(axis=1)
    best, found = -np.inf, []
    for first in range(count):
        for end in range(first + 1, count + 1 - (first == 0)):
            inside = total[end, end] - total[first, end] - total[end, first] + total[first, first]
            to_inside = total[count, end] - total[count, first] - inside
            from_inside = total[end, count] - total[first, count] - inside
            for label, score in ((1, to_inside), (0, from_inside)):
                if score > best + 1e-9:
                    best = score
                    found = [tuple(label if first <= idx < end else 1 - label for idx in range(count))]
    return found


def _improved(gain: FloatArray, labels: NDArray[np.intp], *, kept: tuple[int, int]) -> tuple[NDArray[np.intp], float]:
    """Change single labels as long as the score rises; the two labels of the initial pair stay fixed.

    The score is the sum of gain[a, b] over all a with label 0 and b with label 1.
    """
    labels = labels.copy()
    for _ in range(4 * len(labels)):
        stays, moves = (labels == 0).astype(np.float64), (labels == 1).astype(np.float64)
        # The contribution of an image with label 1 minus its contribution with label 0.
        rise = stays @ gain - gain @ moves
        rise = np.where(labels == 0, rise, -rise)
        rise[list(kept)] = -np.inf
        best = int(np.argmax(rise))
        if rise[best] <= 1e-12:
            break
        labels[best] = 1 - labels[best]
    return labels, float(gain[np.ix_(labels == 0, labels == 1)].sum())
