"""Find pairs that bridge groups of images, such as rooms that see each other through doors only."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.matching.neighbours import similarities
from pano_mvs.algorithms.poses.growth import grown_models
from pano_mvs.algorithms.poses.joining.alignment import Alignment, align_models
from pano_mvs.algorithms.poses.joining.cross_matches import CrossMatches, match_errors
from pano_mvs.algorithms.poses.joining.further_pairs import further_pairs
from pano_mvs.algorithms.poses.joining.level_pairs import level_from_world
from pano_mvs.algorithms.poses.joining.models import are_apart, cross_matches, joined_model
from pano_mvs.algorithms.poses.joining.pair_matcher import LoadPicture, PairMatcher
from pano_mvs.algorithms.poses.placement.placed_model import PlacedModel, pairs_of
from pano_mvs.algorithms.poses.placement.view_graph import connected_groups
from pano_mvs.algorithms.two_view.cheirality import agreement
from pano_mvs.core.settings import Setting, checks_settings
from pano_mvs.geometry import Rigid3, angle_between
from pano_mvs.scene import Features, TwoView

FloatArray = NDArray[np.float64]
Pair = tuple[int, int]

_LINKED = 30  # two pairs of an image that share this many key points have a common scale
_RATIOS = 0.8, 0.88
_PROMISING = 0.0  # log10 of the false alarms at a first look, above which two groups are not examined further
_PAIRS_OF_GROUPS = 12  # image pairs that are matched for two groups, the most similar ones
_MAX_TURN_STD_DEG, _MAX_OFFSET_STD_DEG, _MAX_SCALE_STD = 0.6, 2.0, 0.06
_OWN_OF_RIVAL, _MIN_OWN = 2.0, 5  # matches that the best alignment explains and a rival does not
_MIN_OF_PAIR = 8


@dataclass(frozen=True, eq=False)
class Bridge:
    """Two groups that were aligned.

    Attributes:
        images: image names of both groups.
        inliers: number of matches that agree with the alignment.
        log10_false_alarms: expected number of equally good alignments among random matches.
    """

    images: tuple[tuple[str, ...], tuple[str, ...]]
    inliers: int
    log10_false_alarms: float


@dataclass(frozen=True, eq=False)
class Bridges:
    """The pairs that bridge groups of images.

    Attributes:
        two_views: pair to its geometry; only pairs without a reliable one before.
        bridges: the groups that were aligned, in this order.
        groups: number of groups before, and after.
    """

    two_views: dict[tuple[str, str], TwoView] = field(default_factory=dict)
    bridges: tuple[Bridge, ...] = ()
    groups: tuple[int, int] = (1, 1)


@checks_settings
def find_bridges(
    features: Mapping[str, Features],
    two_views: Mapping[tuple[str, str], TwoView],
    *,
    rng: np.random.Generator,
    significance: Annotated[
        float, Setting("minimum -log10 of the expected number of equally good alignments by chance", gt=0)
    ] = 10.0,
    threshold_deg: Annotated[
        float, Setting("maximum error of a match that agrees with an alignment", gt=0, le=5)
    ] = 0.4,
    neighbours: Annotated[int, Setting("number of most similar groups to compare each group with", ge=1)] = 5,
    candidates: Annotated[
        int, Setting("number of further images to match each image of a group of at most six images with", ge=0)
    ] = 5,
    load: LoadPicture | None = None,
) -> Bridges:
    """Align groups of images that no reliable pair connects, and return the pairs between them.

    Two images in different rooms share what a door shows, which is rarely enough for a relative pose. But each group
    knows the ranges of its key points, and the matches of all its images count together: a match with a known point
    fixes two angles instead of one, and seven numbers align two groups with dozens of image pairs (see `align_models`).
    An alignment is accepted if the matches determine it, if it is far more than chance, and if no other alignment is
    nearly as good. The matches come from descriptors alone, so they are independent of the alignment.

    Without groups to join, nothing is matched.

    Args:
        features: key points by image name, in the capture's order.
        two_views: verified pairs.
        rng: draws samples.
        significance: minimum negative log10 of the false alarms (see `significance` of two views).
        threshold_deg: maximum error of a match.
        neighbours: number of most similar groups with which each group is compared.
        candidates: number of further images with which each image of a small group is matched; see `further_pairs`.
        load: loads an image by its name; images of groups that are compared are then also matched by squeezed tiles
            (see `squeezed_layers`).
    """
    names = tuple(features)
    if is_linked(names, two_views):
        return Bridges()
    before = len(local_models(features, two_views))
    if before < 2:
        return Bridges()
    search = _Search(features, names, rng, significance, threshold_deg, neighbours, load)
    found = further_pairs(features, two_views, search.similar, candidates=candidates, rng=rng)
    two_views = {**two_views, **found}
    models = local_models(features, two_views)
    joined, bridges = search.join(models) if len(models) > 1 else (models, [])
    for (one, other), view in sorted(search.views.items()):
        pair = (names[one], names[other]) if (names[other], names[one]) not in two_views else (names[other], names[one])
        if not two_views.get(pair):
            found[pair] = view if pair[0] == names[one] else _swapped(view)
    return Bridges(found, tuple(bridges), (before, len(joined)))


def is_linked(names: tuple[str, ...], two_views: Mapping[tuple[str, str], TwoView]) -> bool:
    """Return whether pairs that share key points, and so a scale, connect all images."""
    edges = [pair for pair, view in two_views.items() if view]
    of_image: dict[str, list[int]] = {name: [] for name in names}
    for number, pair in enumerate(edges):
        for name in pair:
            of_image[name].append(number)
    if not all(of_image.values()):
        return False
    links = []
    for name, numbers in of_image.items():
        mine = [np.unique(two_views[edges[idx]].matches_idx[:, edges[idx].index(name)]) for idx in numbers]
        links += [
            (numbers[a], numbers[b])
            for a in range(len(mine))
            for b in range(a)
            if len(np.intersect1d(mine[a], mine[b], assume_unique=True)) >= _LINKED
        ]
    largest = connected_groups(links, len(edges))[0] if edges else []
    return {name for idx in largest for name in edges[idx]} == set(names)


def local_models(features: Mapping[str, Features], two_views: Mapping[tuple[str, str], TwoView]) -> list[PlacedModel]:
    """Return the models of all groups by the pairs alone, the largest first; a lone image is a model of one camera."""
    pairs = pairs_of(features, two_views)
    waiting = [group for group in connected_groups(pairs.geometries, len(features)) if len(group) > 1]
    models: list[PlacedModel] = []
    while waiting:
        grown = grown_models(pairs, waiting.pop(0), adjust=True, confirmation=None)[0]
        models.append(grown.model)
        left = {edge for edge in pairs.geometries if edge[0] in grown.refused and edge[1] in grown.refused}
        waiting += [group for group in connected_groups(left, len(features)) if len(group) > 1]
    placed = {image for model in models for image in model.cameras}
    models += [PlacedModel(pairs, {image: Rigid3.identity()}) for image in range(len(features)) if image not in placed]
    return sorted(models, key=lambda model: (-len(model.cameras), min(model.cameras)))


@dataclass(eq=False)
class _Search:
    """The search for alignments between groups."""

    features: Mapping[str, Features]
    names: tuple[str, ...]
    rng: np.random.Generator
    significance: float
    threshold_deg: float
    neighbours: int
    load: LoadPicture | None
    views: dict[Pair, TwoView] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._matcher = PairMatcher(self.features, self.load)
        self.similar = similarities(tuple(self.features.values()))

    def join(self, models: list[PlacedModel]) -> tuple[list[PlacedModel], list[Bridge]]:
        """Return the models after joining those that can be aligned, the most certain first."""
        bridges: list[Bridge] = []
        tried: dict[tuple[int, int], tuple[Alignment, CrossMatches] | None] = {}
        numbered = dict(enumerate(models))
        while True:
            for pair in self._pairs_to_try(numbered):
                if pair not in tried:
                    tried[pair] = self._alignment(numbered[pair[0]], numbered[pair[1]])
            usable = {pair: one for pair, one in tried.items() if one is not None and numbered.keys() >= {*pair}}
            if not usable:
                return list(numbered.values()), bridges
            first, second = min(usable, key=lambda pair: (usable[pair][0].log10_false_alarms, pair))
            alignment, matches = usable[first, second]
            one, other = numbered.pop(first), numbered.pop(second)
            model = joined_model(one, other, alignment.first_from_second)
            self._note_views(model, alignment, matches)
            images = tuple(tuple(self.names[image] for image in sorted(part.cameras)) for part in (one, other))
            bridges.append(Bridge((images[0], images[1]), int(alignment.inliers.sum()), alignment.log10_false_alarms))
            numbered[max(tried)[0] + max(tried)[1] + len(tried) + 1] = model

    def _pairs_to_try(self, models: Mapping[int, PlacedModel]) -> Iterator[tuple[int, int]]:
        """Yield pairs of models, at least one with several cameras, among the most similar ones of either."""
        likeness = {
            (a, b): max(float(self.similar[i, j]) for i in models[a].cameras for j in models[b].cameras)
            for a in models
            for b in models
            if a != b and (len(models[a].cameras) > 1 or len(models[b].cameras) > 1)
        }
        chosen = set()
        for a in models:
            partners = sorted((b for b in models if (a, b) in likeness), key=lambda b: (-likeness[a, b], b))
            chosen |= {_larger_first(models, a, b) for b in partners[: self.neighbours]}
        yield from sorted(chosen)

    def _alignment(self, first: PlacedModel, second: PlacedModel) -> tuple[Alignment, CrossMatches] | None:
        """Return the alignment of two models with the matches behind it, or None if there is no certain one."""
        found: list[tuple[Alignment, CrossMatches]] = []
        for ratio in _RATIOS:
            matches = cross_matches(first, second, self._matches(first, second, ratio))
            for threshold_deg in (self.threshold_deg, 0.5 * self.threshold_deg):
                aligned = self._aligned(first, second, matches, threshold_rad=float(np.deg2rad(threshold_deg)))
                if aligned is not None:
                    found.append((aligned, matches))
            if not found or min(one.log10_false_alarms for one, _ in found) > _PROMISING:
                return None
        best, matches = min(found, key=lambda item: item[0].log10_false_alarms)
        if best.log10_false_alarms > -self.significance or not _is_determined(best):
            return None
        others = [one for one, _ in found]
        rest = matches[np.flatnonzero(~best.inliers)]
        # Without the matches that agree: an alignment with another, similar room has matches of its own.
        again = self._aligned(first, second, rest, threshold_rad=best.threshold_rad)
        others += [] if again is None else [again]
        for other in others:
            alignments = best.first_from_second, other.first_from_second
            if are_apart(alignments, first, second) and _is_rival(best, other, matches):
                return None
        return best, matches

    def _aligned(
        self, first: PlacedModel, second: PlacedModel, matches: CrossMatches, *, threshold_rad: float
    ) -> Alignment | None:
        return align_models(
            matches,
            rng=self.rng,
            threshold_rad=threshold_rad,
            has_scale=len(second.cameras) > 1,
            levels=(_level(first), _level(second)),
        )

    def _matches(self, first: PlacedModel, second: PlacedModel, ratio: float) -> dict[Pair, NDArray[np.int32]]:
        """Return the matches of the most similar pairs of images of two models."""
        pairs = sorted(
            ((i, j) for i in first.cameras for j in second.cameras), key=lambda pair: (-self.similar[pair], pair)
        )
        return {pair: self._matcher.matches(pair, ratio) for pair in pairs[:_PAIRS_OF_GROUPS]}

    def _note_views(self, model: PlacedModel, alignment: Alignment, matches: CrossMatches) -> None:
        """Add the two-view geometries of the pairs that the matches of an alignment connect."""
        for cameras in np.unique(matches.cameras, axis=0).tolist():
            of_pair = (matches.cameras == cameras).all(axis=1)
            chosen = matches.keypoints[of_pair & alignment.inliers]
            one, other = cameras
            if one > other:
                one, other, chosen = other, one, chosen[:, ::-1]
            view = _view(model, (one, other), chosen, alignment=alignment, candidates=int(of_pair.sum()))
            if view is not None:
                self.views[one, other] = view


def _view(
    model: PlacedModel, pair: Pair, matches: NDArray[np.int32], *, alignment: Alignment, candidates: int
) -> TwoView | None:
    """Return the two-view geometry of a pair of registered images; None if too few matches agree with it."""
    relative = model.cameras[pair[1]] @ model.cameras[pair[0]].inverse()
    length = float(np.linalg.norm(relative.translation))
    if len(matches) < _MIN_OF_PAIR or length <= 0:
        return None
    pose = Rigid3(relative.rotation, relative.translation / length)
    p, q = (model.pairs.bearings[image][matches[:, side]] for side, image in enumerate(pair))
    residuals, agreeing = agreement(pose, p, q, threshold_rad=alignment.threshold_rad)
    if agreeing.sum() < _MIN_OF_PAIR:
        return None
    parallax = angle_between(p[agreeing] @ pose.rotation.T, q[agreeing])
    return TwoView(
        matches_idx=np.ascontiguousarray(matches[agreeing], np.int32),
        rotation=pose.rotation,
        direction=pose.translation,
        residuals_rad=residuals[agreeing].astype(np.float32),
        geometry="general",
        candidates=candidates,
        parallax_deg=float(np.rad2deg(np.median(parallax))),
        rotation_std_deg=alignment.rotation_std_deg,
        direction_std_deg=alignment.offset_std_deg,
    )


def _swapped(view: TwoView) -> TwoView:
    inverse = Rigid3(view.rotation, view.direction).inverse()
    swapped = np.ascontiguousarray(view.matches_idx[:, ::-1])
    return replace(view, matches_idx=swapped, rotation=inverse.rotation, direction=inverse.translation)


def _level(model: PlacedModel) -> FloatArray | None:
    return level_from_world([camera.rotation for camera in model.cameras.values()])


def _larger_first(models: Mapping[int, PlacedModel], a: int, b: int) -> tuple[int, int]:
    return (a, b) if (len(models[a].cameras), -a) >= (len(models[b].cameras), -b) else (b, a)


def _is_determined(alignment: Alignment) -> bool:
    """Return whether the matches determine rotation, offset and scale."""
    return (
        alignment.rotation_std_deg < _MAX_TURN_STD_DEG
        and alignment.offset_std_deg < _MAX_OFFSET_STD_DEG
        and alignment.scale_std < _MAX_SCALE_STD
    )


def _is_rival(best: Alignment, other: Alignment, matches: CrossMatches) -> bool:
    """Return whether another alignment explains nearly as many matches that the best one does not explain.

    Matches without a known point are ignored, since many of them agree with any alignment.
    """
    explained = match_errors(other.first_from_second, matches) < best.threshold_rad
    own = int((best.inliers & ~explained & matches.known).sum())
    others = int((explained & ~best.inliers & matches.known).sum())
    return own < _OWN_OF_RIVAL * others + _MIN_OWN
