"""Join the models of groups, such as rooms that see each other through a door, by all matches between their images."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import count
from typing import NamedTuple

import numpy as np

from pano_mvs.algorithms.poses.joining.alignment import Alignment, PairHypothesis, align_models
from pano_mvs.algorithms.poses.joining.cross_matches import THRESHOLD_RAD, CrossMatches
from pano_mvs.algorithms.poses.joining.floors import LENGTH_STD, KnownLengths, height_above_floor, length_by_floor
from pano_mvs.algorithms.poses.placement.pair_evidence import AGREEING, oriented, significant_length
from pano_mvs.algorithms.poses.placement.placed_model import PlacedModel
from pano_mvs.algorithms.poses.placement.view_graph import Edge
from pano_mvs.algorithms.two_view.significance import MAX_LOG10_FALSE_ALARMS
from pano_mvs.algorithms.two_view.verification import pose_near, weight_of_pair
from pano_mvs.geometry import Rigid3, Similarity3, angle_between, geodesic_angle
from pano_mvs.scene import TwoView

_MAX_LOG10_FALSE_ALARMS = -10.0
_SAME_TURN_RAD, _SAME_DIRECTION_RAD = float(np.deg2rad(2.0)), float(np.deg2rad(4.0))
_OWN_OF_RIVAL = 2.0  # evidence for the best alignment, such as matches, that a rival does not explain

Part = tuple[PlacedModel, tuple[int, ...]]


def join_models(models: Sequence[PlacedModel]) -> list[Part]:
    """Return the models after joining those that can be aligned, with the positions of their parts.

    An image is added to a growing model only if enough of its points are known there. A door may show too few of them
    to any one image, and two images may share too few matches to be verified. But a model knows the ranges of its key
    points, and the matches of all its images count together, verified or not: a match with a known point fixes two
    angles instead of one, and seven numbers align two models with dozens of pairs (see `align_models`). Models are
    joined if the matches determine the alignment, if these are far more than chance, and if no other alignment is
    nearly as good. The most significant alignment is the first; those that were found of its two models before are
    tried again with the joined one.

    Args:
        models: of the same pairs, without common images; the world of the largest part is kept.
    """
    left: dict[int, Part] = {number: (model, (number,)) for number, model in enumerate(models)}
    tried: dict[tuple[int, int], _Joint | None] = {}
    starts: dict[tuple[int, int], list[Similarity3]] = defaultdict(list)
    numbers = count(len(models))
    while True:
        for pair in _promising({number: model for number, (model, _) in left.items()}):
            if pair not in tried:
                tried[pair] = _certain_joint(left[pair[0]][0], left[pair[1]][0], starts[pair])
        usable = {pair: one for pair, one in tried.items() if one is not None and left.keys() >= {*pair}}
        if not usable:
            return list(left.values())
        best = min(usable, key=lambda pair: (-usable[pair].strength, pair))
        (first, one), (second, other) = (left.pop(number) for number in best)
        joined = joined_model(first, second, usable[best].alignment.first_from_second)
        joined.verify_again()
        new = next(numbers)
        for third in left:
            for own_from_third in _alignments_with(
                third, best, usable, sizes=(len(first.cameras), len(second.cameras))
            ):
                starts[new, third].append(own_from_third)
                starts[third, new].append(own_from_third.inverse())
        left[new] = joined, tuple(sorted((*one, *other)))


def _alignments_with(
    third: int, joined: tuple[int, int], usable: Mapping[tuple[int, int], _Joint], *, sizes: tuple[int, int]
) -> Iterator[Similarity3]:
    """Yield what moves a third model into the world of two joined ones, by its alignments with either.

    `sizes`: number of cameras of either; a single one has no unit of length, and so says nothing of the scale.
    """
    world_from = Similarity3(1.0, np.eye(3), np.zeros(3)), usable[joined].alignment.first_from_second
    for part, world_from_part, size in zip(joined, world_from, sizes, strict=True):
        if size < 2:
            continue
        if (part, third) in usable:
            yield world_from_part @ usable[part, third].alignment.first_from_second
        elif (third, part) in usable:
            yield world_from_part @ usable[third, part].alignment.first_from_second.inverse()


def _promising(models: Mapping[int, PlacedModel]) -> Iterator[tuple[int, int]]:
    """Yield pairs of models, the larger one first, at least one with several cameras, by the significance of pairs."""
    number = {image: idx for idx, model in models.items() for image in model.cameras}
    evidence: dict[tuple[int, int], float] = {}
    compared = next(iter(models.values())).pairs.compared or {}
    for (a, b), view in compared.items():
        one, other = number.get(a), number.get(b)
        if one is None or other is None or one == other or not len(view.all_matches_idx):
            continue
        if max(len(models[one].cameras), len(models[other].cameras)) > 1:
            pair = max((one, other), (other, one), key=lambda each: (len(models[each[0]].cameras), -each[0]))
            evidence[pair] = min(evidence.get(pair, np.inf), view.log10_false_alarms)
    chosen = set()
    for idx in models:
        partners = sorted((pair for pair in evidence if idx in pair), key=lambda pair: (evidence[pair], pair))
        chosen |= {*partners[:5]}
    yield from sorted(chosen)


class _Joint(NamedTuple):
    """An alignment of two models, and what the pairs between these say about it."""

    alignment: Alignment
    pairs: _PairEvidence
    learned: bool

    @property
    def strength(self) -> float:
        """How significant it is, by matches with known points or by pairs, relative to what is required."""
        by_matches = self.alignment.log10_false_alarms / _MAX_LOG10_FALSE_ALARMS
        return self.pairs.agreeing if self.learned else max(by_matches, self.pairs.agreeing)


def _certain_joint(first: PlacedModel, second: PlacedModel, starts: Sequence[Similarity3]) -> _Joint | None:
    """Return the alignment of two models by the matches between them; None if these do not determine it.

    Their heights above the floor are equal where both are known, which determines lengths that matches hardly do.
    `starts`: alignments that were certain for parts of the models, tried beside those that pairs suggest.
    """
    views = _views_between(first, second)
    matches = CrossMatches.between(first, second, views)
    learned = _is_learned(first)
    has_scale = len(second.cameras) > 1
    heights = None
    if learned and any(views.values()):
        height = height_above_floor(first)
        both = height, height_above_floor(second) if has_scale else height
        heights = both if all(both) else None
    scale = heights[0] / heights[1] if heights else None
    lengths = _lengths_by_floor(first, views, height=heights[0]) if heights else {}
    hypotheses = {pair: _hypotheses((first, second), pair, view) for pair, view in views.items()}
    if scale:
        for pair, length in lengths.items():
            own, *others = hypotheses[pair]
            hypotheses[pair] = [replace(own, lengths=(length, length / scale)), *others]
    known = KnownLengths.between(first, second, lengths, scale=scale)
    # Of the alignments with which many learned matches agree, the most significant one; the others may rival it.
    found = align_models(matches, hypotheses=hypotheses, starts=starts, known=known, has_scale=has_scale)
    certain: list[_Joint] = []
    for one in _distinct(found, first, second) if learned else found[:1]:
        if one.rotation_std_deg > 1.0 or one.offset_std_deg > 3.0 or one.scale_std > 0.1:
            continue
        evidence = _evidence_of_pairs(one, first, second, views=views)
        if scale and _has_known_length(one, first, second, views=views, lengths=lengths):
            evidence = evidence._replace(has_length=True)
        if _is_significant(one, evidence, learned=learned):
            certain.append(_Joint(one, evidence, learned))
    if not certain:
        return None
    best = max(certain, key=lambda joint: joint.strength)
    # Where structure repeats, an alignment with another, similar place has matches of its own.
    unexplained = matches[np.flatnonzero(~best.alignment.inliers)]
    rest = align_models(unexplained, hypotheses=hypotheses, known=known, has_scale=has_scale)
    rivals = [
        *certain,
        *(_Joint(other, _evidence_of_pairs(other, first, second, views=views), learned) for other in rest[:1]),
    ]
    for other in rivals:
        places = best.alignment.first_from_second, other.alignment.first_from_second
        if are_apart(places, first, second) and _is_rival(best, other, matches):
            return None
    return best


def _is_learned(model: PlacedModel) -> bool:
    """Return whether a network has found key points of the capture."""
    return any(one.learned for one in model.pairs.features.values())


def _distinct(alignments: Sequence[Alignment], first: PlacedModel, second: PlacedModel) -> list[Alignment]:
    """Return alignments that put the second model at different places, in their order."""
    kept: list[Alignment] = []
    for one in alignments:
        if all(are_apart((one.first_from_second, other.first_from_second), first, second) for other in kept):
            kept.append(one)
    return kept


def _lengths_by_floor(first: PlacedModel, views: Mapping[Edge, TwoView], *, height: float) -> dict[Edge, float]:
    """Return the lengths of verified pairs of two models that see the floor, in the unit of the first one."""
    lengths = {}
    for (i, j), view in views.items():
        if view:
            pose, matches = oriented(view, i, j)
            rays = first.pairs.bearings[i][matches[:, 0]], first.pairs.bearings[j][matches[:, 1]]
            length = length_by_floor(first, (i, j), pose, rays=rays, height=height)
            if np.isfinite(length):
                lengths[i, j] = length
    return lengths


def _has_known_length(
    alignment: Alignment,
    first: PlacedModel,
    second: PlacedModel,
    *,
    views: Mapping[Edge, TwoView],
    lengths: Mapping[Edge, float],
) -> bool:
    """Return whether an alignment has the pose and the length of a verified pair that sees the floor."""
    joined = joined_model(first, second, alignment.first_from_second)
    for (i, j), length in lengths.items():
        relative = joined.cameras[j] @ joined.cameras[i].inverse()
        off = abs(np.log(np.linalg.norm(relative.translation) / length))
        if off < 3 * LENGTH_STD and _is_same(oriented(views[i, j], i, j)[0], relative):
            return True
    return False


def _is_significant(alignment: Alignment, evidence: _PairEvidence, *, learned: bool) -> bool:
    """Return whether an alignment is more than chance, by the matches with known points or by pairs.

    Pairs that agree with it are taken as independent, so that several weak ones together may be as significant as one
    must be. Rotation and direction of one pair leave the lengths open: other pairs that agree determine them, or the
    known ranges of its matches, or the floor. Either evidence must outweigh the pairs that do not agree.
    Learned matches count only with such pairs, because false ones agree with one another.
    """
    by_matches = alignment.log10_false_alarms / _MAX_LOG10_FALSE_ALARMS
    if learned and evidence.agreeing < max(1.0, evidence.disagreeing):
        return False
    by_pairs = evidence.agreeing if evidence.has_length else 0.0
    return max(by_matches, by_pairs) >= 1 and max(by_matches, evidence.agreeing) >= evidence.disagreeing


class _PairEvidence(NamedTuple):
    """What the pairs between two models say about an alignment.

    Attributes:
        by_pair: significance of each pair that agrees, relative to that which verifies a pair (`weight_of_pair`).
        disagreeing: sum of that of those that do not agree.
        has_length: whether the matches of one that agrees determine its length, the floor does, or others that agree.
    """

    by_pair: Mapping[Edge, float]
    disagreeing: float
    has_length: bool

    @property
    def agreeing(self) -> float:
        """Sum of the significance of the pairs that agree."""
        return sum(self.by_pair.values())

    def beyond(self, other: _PairEvidence) -> float:
        """Return the sum of what pairs agree better with this alignment than with another one."""
        return sum(max(0.0, own - other.by_pair.get(pair, 0.0)) for pair, own in self.by_pair.items())


def _evidence_of_pairs(
    alignment: Alignment, first: PlacedModel, second: PlacedModel, *, views: Mapping[Edge, TwoView]
) -> _PairEvidence:
    """Return the evidence of the pairs between two models, verified or not, for and against an alignment."""
    joined = joined_model(first, second, alignment.first_from_second)
    by_pair, disagreeing, has_length, alarms = dict[Edge, float](), 0.0, False, list[float]()
    for (i, j), view in views.items():
        if view.geometry == "rotation":
            continue
        features = first.pairs.features[first.pairs.names[i]], first.pairs.features[first.pairs.names[j]]
        relative = joined.cameras[j] @ joined.cameras[i].inverse()
        own = 0.0
        geometry = view if view else next(iter(view.alternatives), None)
        if geometry is not None and view.log10_false_alarms < 0:
            ordered = features if i < j else features[::-1]
            own = weight_of_pair(*ordered, geometry, log10_false_alarms=view.log10_false_alarms)
            own = max(own, float(bool(view)))  # by walls, or links of a tour
            if not view and own >= 1 and not all(one.learned for one in features):
                continue  # it was refused since its direction is open, such as for distant scenery alone
            if _is_same(oriented(geometry, i, j)[0], relative):
                if own > 0:
                    by_pair[i, j] = own
                    alarms.append(view.log10_false_alarms)
                has_length |= _has_lengths((first, second), (i, j), geometry, similarity=alignment.first_from_second)
                continue
        if not all(one.learned for one in features):
            disagreeing += own
            continue
        # The best pose of weak matches is a matter of chance; they may agree with the alignment nearly as well. Those
        # of SIFT are not weak but repeat: in a colonnade, they agree with several alignments.
        near = pose_near(features[0], features[1], view.all_matches_idx[:, :: 1 if i < j else -1], pose=relative)
        here = near[2] if near and _is_same(near[0], relative) else 0.0
        if near and here > 0:
            by_pair[i, j] = here
            alarms.append(near[1])
        disagreeing += max(0.0, own - here)
    has_length |= sum(sorted(alarms)[1:]) <= MAX_LOG10_FALSE_ALARMS
    return _PairEvidence(by_pair, disagreeing, has_length)


def _is_same(pose: Rigid3, relative: Rigid3) -> bool:
    """Return whether a relative pose, |t| = 1, has the rotation and the direction of another one."""
    turned = geodesic_angle(pose.rotation, relative.rotation)
    off = angle_between(pose.translation, relative.translation)
    return bool(turned < _SAME_TURN_RAD and off < _SAME_DIRECTION_RAD)


def _has_lengths(
    models: tuple[PlacedModel, PlacedModel], pair: Edge, view: TwoView, *, similarity: Similarity3
) -> bool:
    """Return whether the matches of a pair determine its length in the unit of either model, as an alignment has it."""
    centers = [model.cameras[image].center for model, image in zip(models, pair, strict=True)]
    length = float(np.linalg.norm(similarity.apply(centers[1][None])[0] - centers[0]))
    log10_alarms = 0.0
    for (found, alarms), expected, model in zip(
        _lengths(models, pair, view), (length, length / similarity.scale), models, strict=True
    ):
        if len(model.cameras) > 1:
            if not abs(np.log(found / expected)) < np.log(AGREEING):
                return False
            log10_alarms += alarms
    return log10_alarms < -1.0


def _views_between(first: PlacedModel, second: PlacedModel) -> dict[Edge, TwoView]:
    """Return the most significant pairs of an image of either model, with the image of the first model first."""
    compared = first.pairs.compared or {}
    found = {
        (i, j): compared[min(i, j), max(i, j)]
        for i in first.cameras
        for j in second.cameras
        if (min(i, j), max(i, j)) in compared
    }
    ranked = sorted(found, key=lambda pair: (found[pair].log10_false_alarms, pair))
    return {pair: found[pair] for pair in ranked[:12]}


def _hypotheses(models: tuple[PlacedModel, PlacedModel], pair: Edge, view: TwoView) -> list[PairHypothesis]:
    """Return the relative poses of a pair of two models, verified or not, between the axes of their worlds."""
    found = []
    for geometry in (view, *view.alternatives):
        if geometry:
            pose, _ = oriented(geometry, *pair)
            own, other = (model.cameras[image].rotation for model, image in zip(models, pair, strict=True))
            lengths = [length if alarms < 0 else np.nan for length, alarms in _lengths(models, pair, geometry)]
            turned = Rigid3(other.T @ pose.rotation @ own, other.T @ pose.translation)
            found.append(PairHypothesis(turned, (lengths[0], lengths[1])))
    return found


def _lengths(
    models: tuple[PlacedModel, PlacedModel], pair: Edge, view: TwoView
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the length of a pair's translation in the unit of either model, with log₁₀ of its false alarms."""
    found = []
    for model, (one, other) in zip(models, (pair, pair[::-1]), strict=True):
        pose, matches = oriented(view, one, other)
        p, q = (model.pairs.bearings[image][matches[:, side]] for side, image in enumerate((one, other)))
        ranges = model.known_ranges(one)[matches[:, 0]]
        found.append(significant_length(pose, p, q, known_ranges=ranges, rng=np.random.default_rng(0)))
    return found[0], found[1]


def _is_rival(best: _Joint, other: _Joint, matches: CrossMatches) -> bool:
    """Return whether another alignment of two models explains nearly as much of its own as the best one.

    Pairs decide if those that agree with one of the two better than with the other are as significant as a pair must be
    (not, therefore, if the two differ in nothing but a length that pairs leave open), else the matches if the other
    alignment is more than chance. Matches without a known point are ignored, since many of them agree with any
    alignment.
    """
    own, others = best.pairs.beyond(other.pairs), other.pairs.beyond(best.pairs)
    if max(own, others) >= 1:
        return own < _OWN_OF_RIVAL * others
    if other.alignment.log10_false_alarms > 0:
        return False
    explained = matches.errors(other.alignment.first_from_second)[0] < THRESHOLD_RAD
    own_matches = int((best.alignment.inliers & ~explained & matches.known).sum())
    others_matches = int((explained & ~best.alignment.inliers & matches.known).sum())
    return own_matches < _OWN_OF_RIVAL * others_matches + 5


def joined_model(first: PlacedModel, second: PlacedModel, first_from_second: Similarity3) -> PlacedModel:
    """Return the cameras, chosen geometries and ranges of two models in the world of the first one."""
    model = first.copy()
    within = {edge: found for edge, found in second.pairs.geometries.items() if second.cameras.keys() >= {*edge}}
    model.pairs = replace(first.pairs, geometries={**first.pairs.geometries, **within})
    scale, turn = first_from_second.scale, first_from_second.rotation
    for image, camera in second.cameras.items():
        center = first_from_second.apply(camera.center[None])[0]
        model.cameras[image] = Rigid3.from_center(camera.rotation @ turn.T, center)
        model.known_ranges(image)[:] = scale * second.known_ranges(image)
    model.chosen |= second.chosen
    return model


def are_apart(alignments: tuple[Similarity3, Similarity3], first: PlacedModel, second: PlacedModel) -> bool:
    """Return whether two alignments put the second model at different places in the world of the first one."""
    one, other = alignments
    if float(geodesic_angle(one.rotation, other.rotation)) > _SAME_TURN_RAD:
        return True
    centers = np.array([camera.center for camera in second.cameras.values()])
    origin = np.mean([camera.center for camera in first.cameras.values()], axis=0)
    offsets = one.apply(centers) - origin, other.apply(centers) - origin
    return bool(angle_between(*offsets).max() > _SAME_DIRECTION_RAD)
