"""Weight the geometries of ambiguous pairs by how much the two images confirm under each of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pano_mvs.algorithms.poses.placement.pair_evidence import Geometry
from pano_mvs.algorithms.poses.placement.placed_model import Pairs
from pano_mvs.algorithms.poses.placement.view_graph import Edge
from pano_mvs.algorithms.poses.verification.confirmation import Confirmation
from pano_mvs.geometry import Rigid3

_MIN_AMBIGUOUS = 1 / 3


def weighed_by_images(pairs: Pairs, confirmation: Confirmation) -> Pairs:
    """Return pairs in which the images decide the weights of ambiguous pairs.

    Two panoramas are swept against each other under each geometry of their pair. Under the true one they confirm more
    than under those that repeated structure suggests, however many matches these have. A geometry's weight is
    multiplied by the cube of its confirmed share relative to the pair's best share. This is done for the pairs of every
    image with its six best partners; the weights of other ambiguous pairs are lowered. If less than a third of the
    pairs are ambiguous, the other pairs decide and no image is loaded.

    Args:
        pairs: all pairs of a capture.
        confirmation: of the same capture.
    """
    ambiguous = sum(is_ambiguous(found) for found in pairs.geometries.values())
    if ambiguous < _MIN_AMBIGUOUS * len(pairs.geometries):
        return pairs
    asked = {
        (min(image, partner), max(image, partner))
        for image, partners in enumerate(pairs.partners)
        for partner in partners[:6]
    }
    geometries: dict[Edge, tuple[Geometry, ...]] = {}
    for edge, found in pairs.geometries.items():
        if not is_ambiguous(found):
            geometries[edge] = found
        elif edge in asked:
            geometries[edge] = _weighed(edge, found, confirmation)
        else:
            # Factor on the weight of an ambiguous pair that is not checked because other pairs suffice.
            geometries[edge] = tuple(replace(one, weight=0.3 * one.weight) for one in found)
    return replace(pairs, geometries=geometries)


def is_ambiguous(found: tuple[Geometry, ...]) -> bool:
    """Return whether the second geometry of a pair is a rival of the first."""
    # A pair is ambiguous if its second geometry has more than this share of the first one's weight.
    return len(found) > 1 and found[1].weight > 0.25 * found[0].weight


def _weighed(edge: Edge, found: tuple[Geometry, ...], confirmation: Confirmation) -> tuple[Geometry, ...]:
    """Return the geometries of a pair, weighted by what both images confirm under each, the heaviest first."""
    shares = []
    for one in found:
        poses = {edge[0]: Rigid3.identity(), edge[1]: Rigid3(one.view.rotation, one.view.direction)}
        shares.append(float(np.nan_to_num([confirmation.share(image, poses[image], poses) for image in edge]).mean()))
    most = max(shares)
    if most <= 0:
        return found
    heaviest = found[0].weight
    weighed = [
        # The best geometry by the images gets the weight of the best one by matches: its number of matches says little
        # here.
        replace(one, weight=max(one.weight, heaviest * share / most) * (share / most) ** 3)
        for one, share in zip(found, shares, strict=True)
    ]
    return tuple(sorted(weighed, key=lambda one: -one.weight))
