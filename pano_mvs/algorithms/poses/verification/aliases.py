"""Another arrangement of the cameras that many pairs would agree with, as in a place that repeats.

Where a row of equal doors or columns repeats, all pairs between two blocks of cameras may agree on a relative position
that is one period off: each camera is then well supported. But some pairs also have a runner-up geometry, and all of
these suggest the same motion of one block. If two identical rooms face each other, the motion also rotates the block.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pano_mvs.algorithms.poses.placement.placed_model import PlacedModel
from pano_mvs.algorithms.poses.placement.view_graph import Edge
from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import Rigid3, geodesic_angle

_SAME_TURN_RAD = float(np.deg2rad(3.0))
# A motion that rotates a block by more than this has six degrees of freedom; two pairs hardly agree on it by chance.
_MIN_TURN_RAD = float(np.deg2rad(20.0))


@dataclass(frozen=True, eq=False)
class Suggestion:
    """The motion of the second image of a pair relative to the first that an unchosen geometry suggests."""

    edge: Edge
    weight: float
    motion: Rigid3
    center: FloatArray  # of the second image's camera
    length: float  # by which the motion moves it

    @property
    def turn_rad(self) -> float:
        """The angle of the rotation."""
        return float(geodesic_angle(self.motion.rotation, np.eye(3)))


def other_arrangement(model: PlacedModel) -> str:
    """Return a description of the motion of a block that most pairs suggest; "" if hardly any agree on one.

    At least three pairs must suggest a motion, and at least a tenth of the pairs that agree with the current
    arrangement; fewer may agree by chance. For motions that rotate a block, two pairs are enough.
    """
    edges, one = most_suggested(_suggestions(model))
    if one is None or (one.turn_rad < _MIN_TURN_RAD and len(edges) < max(3, 0.1 * len(model.chosen))):
        return ""
    if one.turn_rad < _MIN_TURN_RAD:
        how = f"{one.length:.2g} units away from where they are, relative to the others"
    else:
        how = f"rotated by {np.rad2deg(one.turn_rad):.0f}° and placed elsewhere, as in a second, similar room"
    if 2 * len(edges & model.chosen.keys()) > len(edges):
        return f"the place repeats: {len(edges)} pairs would agree as well if some of the images were {how}"
    return f"{len(edges)} pairs would agree if some of the images were {how}"


def most_suggested(suggestions: list[Suggestion]) -> tuple[set[Edge], Suggestion | None]:
    """Return the pairs that suggest the motion with most support, or its inverse, and the suggestion nearest to it.

    Motions that turn by little, and all by less than two pairs, are left out. The heaviest suggestions are compared.
    """
    usable = (one for one in suggestions if one.turn_rad < _SAME_TURN_RAD or one.turn_rad > _MIN_TURN_RAD)
    compared = sorted(usable, key=lambda one: (-one.weight, one.edge))[:60]
    if not compared:
        return set(), None
    lengths = np.array([one.length for one in compared])
    # Share of the move and of the usual distance between cameras.
    tolerance = 0.1 * (lengths + np.median(lengths))
    centers = np.array([one.center for one in compared])
    turns = np.array([one.motion.rotation for one in compared])
    there = np.array([one.motion.apply(one.center) for one in compared])
    same = np.zeros((len(compared), len(compared)), np.bool_)
    for motions in ([one.motion for one in compared], [one.motion.inverse() for one in compared]):
        apart = np.linalg.norm(np.array([motion.apply(centers) for motion in motions]) - there, axis=2)
        turned = geodesic_angle(np.array([motion.rotation for motion in motions])[:, None], turns[None])
        same |= (turned < _SAME_TURN_RAD) & (apart < tolerance)
    best: tuple[float, set[Edge], Suggestion | None] = (0.0, set(), None)
    for one, alike in zip(compared, same, strict=True):
        # In reverse, so that the heaviest suggestion of a pair counts.
        weights = {compared[idx].edge: compared[idx].weight for idx in np.flatnonzero(alike)[::-1]}
        if len(weights) >= 2 and sum(weights.values()) > best[0]:
            best = sum(weights.values()), set(weights), one
    return best[1], best[2]


def _suggestions(model: PlacedModel) -> list[Suggestion]:
    """Return the motions of second images relative to first images that unchosen geometries suggest."""
    suggestions: list[Suggestion] = []
    for i, j in model.pairs.geometries:
        if i not in model.cameras or j not in model.cameras:
            continue
        for fixed, image in ((i, j), (j, i)):
            evidence, here = model.evidence(image, [fixed]), model.cameras[image]
            distance = float(np.linalg.norm(here.center - model.cameras[fixed].center))
            for idx in np.flatnonzero(np.isfinite(evidence.lengths)):
                if model.chosen.get((i, j)) == evidence.rank[idx]:
                    continue
                there = evidence.origins[idx] + evidence.lengths[idx] * evidence.directions[idx]
                turn = evidence.rotations[idx].T @ here.rotation
                motion = Rigid3(turn, there - turn @ here.center)
                one = Suggestion(
                    (i, j),
                    float(evidence.weight[idx]),
                    motion if image == j else motion.inverse(),
                    model.cameras[j].center,
                    float(np.linalg.norm(there - here.center)),
                )
                # A move shorter than this share of the pair's distance is an error, not another place.
                if one.length > 0.05 * distance or one.turn_rad > _MIN_TURN_RAD:
                    suggestions.append(one)
    return suggestions
