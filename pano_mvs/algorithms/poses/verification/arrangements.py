"""Compare whole arrangements of a capture by what the images confirm, and find others to compare with."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np

from pano_mvs.algorithms.poses.growth import settle
from pano_mvs.algorithms.poses.placement.placed_model import Pairs, PlacedModel, pairs_of
from pano_mvs.algorithms.poses.solved_models import solved_models
from pano_mvs.algorithms.poses.verification.confirmation import SHARED_FROM, Confirmation
from pano_mvs.geometry import Rigid3
from pano_mvs.scene import Features, TwoView

SHARE_STD = 0.02
"""Standard deviation of a camera's confirmed share between two arrangements that are both right: .019 for 91 cameras of
13 captures, solved and true poses."""
CHANCE_SHARE = 0.08
"""What others confirm of a camera in a wrong place: .036 in the median and .073 at most, of 80 in 25 drawn captures; of
124 right cameras, .085 at least."""

Pair = tuple[str, str]


def shares_of(groups: Iterable[Mapping[int, Rigid3]], confirmation: Confirmation) -> dict[int, float]:
    """Return the confirmed share of every camera of some groups, NaN where too little can be judged.

    In small groups, each camera is confirmed by maps that are swept without it: in shared ones it would confirm itself.
    """
    shares: dict[int, float] = {}
    for cameras in groups:
        shares |= confirmation.shares(cameras, independent=len(cameras) < SHARED_FROM)
    return shares


def is_better_arrangement(
    groups: Sequence[Mapping[int, Rigid3]], before: Sequence[Mapping[int, Rigid3]], confirmation: Confirmation
) -> bool:
    """Return whether the images confirm one arrangement more than another one, which may have other cameras.

    Cameras that are confirmed no more than by chance count as if they were not placed: another source makes any map
    better, even a source in a wrong place.
    """
    return is_more_confirmed(*(_shares_beyond_chance(cameras, confirmation) for cameras in (groups, before)))


def _shares_beyond_chance(groups: Iterable[Mapping[int, Rigid3]], confirmation: Confirmation) -> dict[int, float]:
    groups = list(groups)
    shares = shares_of(groups, confirmation)
    by_chance = {image for image, share in shares.items() if share < CHANCE_SHARE}
    placed = [{image: pose for image, pose in cameras.items() if image not in by_chance} for cameras in groups]
    return shares_of(placed, confirmation) if by_chance else shares


def is_more_confirmed(shares: Mapping[int, float], before: Mapping[int, float]) -> bool:
    """Return whether the images confirm one arrangement more than another, by more than its noise.

    All cameras count, on the same pixels: what one camera gains in another place, others may lose by it. A camera that
    only one of the arrangements has confirms nothing in the other. Structure that repeats lets one camera look better
    in a wrong place, but hardly all of them together.

    Args:
        shares: image position to the confirmed share of its textured pixels; NaN counts as nothing.
        before: those of the other arrangement.
    """
    images = sorted(shares.keys() | before.keys())
    gains = np.array([np.nan_to_num(shares.get(idx, 0.0)) - np.nan_to_num(before.get(idx, 0.0)) for idx in images])
    return bool(gains.sum() > 2 * SHARE_STD * np.sqrt(np.count_nonzero(np.abs(gains) > 1e-6)))


def other_arrangements(
    features: Mapping[str, Features], two_views: Mapping[Pair, TwoView], pairs: Pairs
) -> Iterator[list[PlacedModel]]:
    """Yield arrangements that are solved from few pairs, each with the models of its groups.

    Where structure repeats, most pairs of distant images are wrong, agree with one another, and outvote right pairs of
    neighbours. So the models are solved from pairs of neighbours in the order of capture, or from the strongest pairs
    of each image, and adjusted with those of the others that agree with them.

    Args:
        features: key points by image name, in the order of capture.
        two_views: verified pairs.
        pairs: all of these.
    """
    tried: list[set[Pair]] = []
    for kept in (
        *(_neighbours(tuple(features), two_views, steps) for steps in (1, 2)),
        *(_strongest(two_views, count) for count in (1, 2)),
    ):
        if kept in tried:
            continue
        tried.append(kept)
        few = pairs_of(features, {pair: two_views[pair] for pair in two_views if pair in kept})
        if models := [settled(model, pairs) for model in solved_models(few)[0]]:
            yield models


def settled(model: PlacedModel, pairs: Pairs) -> PlacedModel:
    """Return a model with all pairs that agree with its cameras, adjusted to them."""
    found = PlacedModel(pairs).with_cameras(model.cameras)
    settle(found, adjust=True)
    return found


def _neighbours(names: Sequence[str], two_views: Mapping[Pair, TwoView], steps: int) -> set[Pair]:
    """Return the verified pairs of images that are at most some steps apart in the order of capture."""
    position = {name: idx for idx, name in enumerate(names)}
    return {
        pair
        for pair, view in two_views.items()
        if view and position.keys() >= {*pair} and abs(position[pair[0]] - position[pair[1]]) <= steps
    }


def _strongest(two_views: Mapping[Pair, TwoView], count: int) -> set[Pair]:
    """Return the verified pairs with most matches of every image."""
    of_image: dict[str, list[tuple[int, Pair]]] = {}
    for pair, view in two_views.items():
        for name in pair if view else ():
            of_image.setdefault(name, []).append((-len(view), pair))
    return {pair for ranked in of_image.values() for _, pair in sorted(ranked)[:count]}
