"""Matches of the network LightGlue between level views of two panoramas (Lindenberger et al., ICCV 2023).

The network sees the key points of a view of either panorama: their descriptors and where they are. Layer by layer it
compares them within a view and across; it stops once it is sure of nearly all, and drops those that cannot match.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.learned.aliked import level_tiles
from pano_mvs.algorithms.learned.networks import DESCRIPTOR_NORM, PACKAGED, TILE_PX, Array, Network, Networks
from pano_mvs.algorithms.matching.brute_force import match_l2
from pano_mvs.core.errors import UsageError
from pano_mvs.core.settings import Setting, checks_settings
from pano_mvs.scene import Features

LAYERS = 9

_FIRST_VIEWS, _FIRST_KEYPOINTS = 3, 512
"""What is compared first: pairs of views, and key points of each, those with the highest scores. Of 27 pairs of ZInD's
sample tour, of which 6 are verified by all, these verify the 6, in a sixth of the time."""


@checks_settings
def match_learned(
    first: Features,
    second: Features,
    *,
    min_score: Annotated[float, Setting("minimum probability of a match", ge=0, le=1)] = 0.1,
    max_views: Annotated[
        int, Setting("number of pairs of views that are compared, those most alike", ge=1, le=256)
    ] = 8,
    networks: Networks = PACKAGED,
) -> NDArray[np.int32]:
    """Match the ALIKED key points of two panoramas.

    Args:
        first: key points of the first image; only the learned ones are matched.
        second: key points of the second image.
        max_views: how many of the 256 or more pairs of views are compared, those with the most similar descriptors.
        networks: the network files and what executes them.

    Returns:
        (M, 2) int32 positions in the first and second image, one to one, by ascending position in the first.

    Raises:
        UsageError: if both images have key points but no learned ones, or a network file or the provider is missing.
    """
    return _Views(first, second, most=max_views, networks=networks).matches(min_score=min_score)


def few_and_all_matches(
    first: Features, second: Features, *, min_score: float, max_views: int, networks: Networks = PACKAGED
) -> Iterator[NDArray[np.int32]]:
    """Yield the matches of a part of the key points in the most similar views, and then those of `match_learned`.

    The first ones suffice for most pairs of images that show nothing in common, and for many that clearly do.
    """
    views = _Views(first, second, most=max_views, networks=networks)
    yield views.matches(min_score=min_score, views=_FIRST_VIEWS, keypoints=_FIRST_KEYPOINTS)
    yield views.matches(min_score=min_score)


class _Views:
    """The most similar views of two panoramas."""

    def __init__(self, first: Features, second: Features, *, most: int, networks: Networks) -> None:
        """Find `most` pairs of views; none if an image has no learned key points."""
        if len(first) and len(second) and not (first.learned or second.learned):
            raise UsageError("matches.lightglue needs the key points of features.aliked: add that stage before it")
        self._offsets = [len(features) - features.learned for features in (first, second)]
        self._pairs: list[tuple[int, int]] = []
        if min(first.learned, second.learned) >= 2:
            self._sides = [Side.of(features) for features in (first, second)]
            self._pairs = _alike(self._sides[0], self._sides[1], most)
            self._glue = LightGlue(networks)

    def matches(self, *, min_score: float, views: int | None = None, keypoints: int | None = None) -> NDArray[np.int32]:
        """Return the matches (M, 2) of the most similar pairs of views, by the key points with the highest scores."""
        best: dict[tuple[int, int], float] = {}
        for one, other in self._pairs[:views]:
            first_idx, *first_seen = self._sides[0].inside(one, keypoints)
            second_idx, *second_seen = self._sides[1].inside(other, keypoints)
            matches, scores = self._glue.match(first_seen, second_seen, min_score=min_score)
            for i, j, score in zip(first_idx[matches[:, 0]], second_idx[matches[:, 1]], scores, strict=True):
                best[int(i), int(j)] = max(best.get((int(i), int(j)), 0.0), float(score))
        return _one_to_one(best, offsets=self._offsets)


class LightGlue:
    """The network, layer by layer."""

    def __init__(self, networks: Networks) -> None:
        """Load its files; see `Networks.load` and `Networks.of_colmap`."""
        self._whole = networks.of_colmap("matcher")
        if not self._whole:
            self._start, self._layer, self._end = (
                networks.load(f"lightglue_{part}.onnx") for part in ("start", "layer", "end")
            )

    def match(
        self, first: Sequence[Array], second: Sequence[Array], *, min_score: float
    ) -> tuple[NDArray[np.intp], Array]:
        """Return the matches (M, 2) of two views and their probabilities (M,).

        Args:
            first: unit descriptors (N, 128) and positions (N, 2), −1 … 1 from edge to edge, of the first view.
            second: those of the second view.
            min_score: minimum probability.
        """
        if self._whole:
            return _matched_by_colmap(self._whole, first, second, min_score=min_score)
        states = [self._start(descriptors=descriptors, positions=places) for descriptors, places in (first, second)]
        kept = [np.arange(len(features)) for features, _ in states]
        counts = [len(one) for one in kept]
        matchable = [np.zeros(0, np.float32)] * 2
        number = 0
        for number in range(LAYERS):
            if min(len(one) for one in kept) == 0:
                return np.zeros((0, 2), np.intp), np.zeros(0, np.float32)
            (one, one_encoding), (other, other_encoding) = states
            *features, judged, judged_too = self._layer(
                layer=np.array(number),
                first=one,
                second=other,
                first_encoding=one_encoding,
                second_encoding=other_encoding,
            )
            matchable = [judged[:, 1], judged_too[:, 1]]
            states = [[features[0], one_encoding], [features[1], other_encoding]]
            if number == LAYERS - 1:
                break
            sure = 0.8 + 0.1 * float(np.exp(-4.0 * number / LAYERS))
            confident = [judged[:, 0] >= sure, judged_too[:, 0] >= sure]
            dropped = sum(counts) - sum(len(one) for one in kept)
            # As published: at this share of confident key points it stops, and it drops those as hopeless as this.
            if dropped + sum(int(one.sum()) for one in confident) > 0.95 * sum(counts):
                break
            for side in (0, 1):
                keep = np.flatnonzero((matchable[side] > 1 - 0.99) | ~confident[side])
                kept[side] = kept[side][keep]
                states[side] = [states[side][0][keep], states[side][1][:, keep]]
        chance = np.exp(self._end(layer=np.array(number), first=states[0][0], second=states[1][0])[0])
        chance *= matchable[0][:, None] * matchable[1]
        nearest = chance.argmax(axis=1)
        score = chance[np.arange(len(chance)), nearest]
        mutual = np.flatnonzero((chance.argmax(axis=0)[nearest] == np.arange(len(chance))) & (score > min_score))
        return np.stack([kept[0][mutual], kept[1][nearest[mutual]]], axis=1), score[mutual]


def _matched_by_colmap(
    network: Network, first: Sequence[Array], second: Sequence[Array], *, min_score: float
) -> tuple[NDArray[np.intp], Array]:
    """Return what `LightGlue.match` returns, by COLMAP's file, which computes all layers for all key points."""
    if min(len(first[0]), len(second[0])) == 0:
        return np.zeros((0, 2), np.intp), np.zeros(0, np.float32)
    # Pixels whose first one has its centre at (0, 0).
    inputs = {
        f"{name}{number}": values[None]
        for number, (descriptors, places) in enumerate((first, second))
        for name, values in (
            ("kpts", (places + 1) * np.float32(TILE_PX / 2) - np.float32(0.5)),
            ("desc", descriptors),
            ("image_size", np.full(2, TILE_PX, np.float32)),
        )
    }
    partners, scores = network(**inputs)
    matched = np.flatnonzero((partners >= 0) & (scores >= min_score))
    return np.stack([matched, partners[matched].astype(np.intp)], axis=1), scores[matched]


@dataclass(frozen=True, eq=False)
class Side:
    """The learned key points of a panorama in its level views, for each direction that may be up."""

    descriptors: Array  # (N, 128) whole numbers, of length `DESCRIPTOR_NORM`
    scores: Array  # (N,) of the detector
    places: Array  # (V, N, 2) positions in the views, −1 … 1 from edge to edge; NaN outside of them
    ups: int  # number of directions that may be up

    @classmethod
    def of(cls, features: Features) -> Side:
        """Return the learned key points of a panorama."""
        learned = features.only_learned()
        of_up = np.repeat(np.arange(len(learned.ups)), learned.per_up or (learned.learned,))
        views = []
        for number, up in enumerate(learned.ups):
            for tile in level_tiles(np.array(up)):
                pixels = tile.pixels_from_rays(learned.bearings)
                seen = (of_up == number) & tile.contains(pixels)
                views.append(np.where(seen[:, None], pixels / (TILE_PX / 2) - 1, np.nan))
        descriptors = learned.descriptors.astype(np.float32)
        return cls(descriptors, learned.scores, np.array(views, np.float32), len(learned.ups))

    def inside(self, view: int, most: int | None = None) -> tuple[NDArray[np.intp], Array, Array]:
        """Return the key points in a view, `most` at most, their unit descriptors and their places in it."""
        idx = np.flatnonzero(~np.isnan(self.places[view, :, 0]))
        idx = np.sort(idx[np.argsort(-self.scores[idx], kind="stable")[:most]])
        return idx, self.descriptors[idx] / np.float32(DESCRIPTOR_NORM), self.places[view, idx]


def _alike(first: Side, second: Side, most: int) -> list[tuple[int, int]]:
    """Return the pairs of views with the most descriptors that are each other's nearest."""
    # With views for several directions that may be up, a share of the key points is enough.
    one, other = (side.descriptors[:: side.ups] for side in (first, second))
    nearest = match_l2(one, other, ratio=1)
    seen = [~np.isnan(side.places[:, side.ups * nearest[:, n], 0]) for n, side in enumerate((first, second))]
    counts = seen[0].astype(np.int64) @ seen[1].astype(np.int64).T
    order = np.argsort(-counts, axis=None, kind="stable")[:most]
    return [(int(one), int(other)) for one, other in zip(*np.unravel_index(order, counts.shape), strict=True)]


def _one_to_one(scores: dict[tuple[int, int], float], offsets: list[int]) -> NDArray[np.int32]:
    """Return the most probable matches of which none share a key point."""
    used: tuple[set[int], set[int]] = (set(), set())
    chosen = []
    for i, j in sorted(scores, key=lambda pair: (-scores[pair], pair)):
        if i not in used[0] and j not in used[1]:
            used[0].add(i)
            used[1].add(j)
            chosen.append((i + offsets[0], j + offsets[1]))
    return np.array(sorted(chosen), np.int32).reshape(-1, 2)
