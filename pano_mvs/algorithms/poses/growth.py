"""Grow a model from a seed pair, adding first the image whose pose its pairs determine most clearly."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np

from pano_mvs.algorithms.poses.placement.pair_evidence import PairEvidence
from pano_mvs.algorithms.poses.placement.placed_model import Pairs, PlacedModel
from pano_mvs.algorithms.poses.placement.places import Placement
from pano_mvs.algorithms.poses.placement.resection import points_needed, why_refused
from pano_mvs.algorithms.poses.placement.view_graph import Edge
from pano_mvs.geometry import Rigid3


def grown_model(pairs: Pairs, images: Collection[int], *, adjust: bool) -> tuple[PlacedModel, dict[int, str]]:
    """Return a model of a connected group of images, and why images of the group could not be added to it.

    It grows from the best seed or, if no image can be attached to this, from the best one that contradicts it.

    Args:
        pairs: all pairs of the capture.
        images: positions of the images of the group.
        adjust: whether all cameras are adjusted as the model grows.
    """
    models: list[tuple[PlacedModel, dict[int, str]]] = []
    tried: set[tuple[Edge, int]] = set()
    while len(models) < 2 and (seeds := ranked_seeds(pairs, images, without=tried)):
        edge, rank = seeds[0]
        model, refused = _grown(pairs, images, edge, rank=rank, adjust=adjust)
        models.append((model, refused))
        if not refused or len(model.cameras) > 2:
            break
        # A seed that agrees with this model would lead to the same model again.
        tried |= {seeds[0], *model.chosen.items()}
    return max(models, key=lambda found: len(found[0].cameras))


def ranked_seeds(
    pairs: Pairs, images: Collection[int], *, without: Collection[tuple[Edge, int]] = ()
) -> list[tuple[Edge, int]]:
    """Return candidate seeds, best first: pairs, each with the rank of the geometry to start from.

    A good seed has a large weight and sufficient parallax, and its two cameras agree on the poses of third images. A
    seed with a false geometry is rarely supported by third images.

    Args:
        pairs: all pairs of the capture.
        images: positions of the images of the group.
        without: seeds to leave out.
    """
    members = set(images)

    def quality(edge: Edge, rank: int) -> float:
        geometry = pairs.geometries[edge][rank]
        return geometry.weight**2 * min(geometry.parallax_deg / 10.0, 1.0)

    seeds = [
        (edge, rank)
        for edge, found in pairs.geometries.items()
        if members.issuperset(edge)
        for rank in range(len(found))
        if (edge, rank) not in without
    ]
    seeds.sort(key=lambda seed: (-quality(*seed), seed))
    seeds = seeds[:12]  # number of seeds whose support by third images is computed
    support = {seed: _support(pairs, *seed) for seed in seeds}
    most = max((quality(*seed) for seed in seeds), default=1.0)
    return sorted(seeds, key=lambda seed: (-support[seed] * np.sqrt(quality(*seed) / most), -quality(*seed), seed))


def _support(pairs: Pairs, edge: Edge, rank: int) -> float:
    """Return the support of a seed by third images: the weight of the placements on which both cameras agree."""
    model = PlacedModel(pairs)
    model.seed(edge, rank)
    thirds = [idx for idx in pairs.partners[edge[0]] if idx in pairs.partners[edge[1]]][:8]
    total = 0.25
    for image in thirds:
        _, found = model.place(image)
        agreeing_with_both = [place for place in found if place.explained.sum() >= 2]
        if agreeing_with_both:
            total += agreeing_with_both[0].score
    return total


def _grown(
    pairs: Pairs, images: Collection[int], edge: Edge, *, rank: int, adjust: bool
) -> tuple[PlacedModel, dict[int, str]]:
    """Return the model that grows from a seed, and the reasons for images that could not be added."""
    model = PlacedModel(pairs)
    model.seed(edge, rank)
    left = set(images) - set(edge)
    reasons = extend(model, left, adjust=adjust)
    settle(model, adjust=adjust)
    return model, {image: reasons.get(image, why_nothing(model, image)) for image in sorted(left)}


def extend(model: PlacedModel, left: set[int], *, adjust: bool) -> dict[int, str]:
    """Add images to a model one at a time, the one whose pose its pairs determine most clearly first.

    Args:
        model: the model, changed in place.
        left: images to add; those that were added are removed.
        adjust: whether all cameras are adjusted each time their number has grown by a quarter. If False, only points
            are triangulated again.

    Returns:
        Why images could not be added when they were last tried.
    """
    weights: dict[int, float] = {}

    def count_pairs(image: int) -> None:
        for partner in model.pairs.partners[image]:
            if partner in left:
                edge = min(image, partner), max(image, partner)
                weights[partner] = weights.get(partner, 0.0) + model.pairs.geometries[edge][0].weight

    for image in model.cameras:
        count_pairs(image)
    if not adjust:
        model.adjust(cameras=False)
    adjusted = len(model.cameras)
    reasons: dict[int, str] = {}
    while step := _next(model, weights, reasons=reasons):
        image, pose = step
        model.add(image, pose)
        left.discard(image)
        del weights[image]
        count_pairs(image)
        if len(model.cameras) > 1.25 * adjusted:
            model.adjust(cameras=adjust)
            adjusted = len(model.cameras)
    return reasons


def _next(model: PlacedModel, weights: Mapping[int, float], *, reasons: dict[int, str]) -> tuple[int, Rigid3] | None:
    """Return the image to add next and its pose; None if none can be added.

    Args:
        model: the model to extend.
        weights: unregistered images that share pairs with registered ones, to the total weight of these pairs.
        reasons: receives why an image cannot be added yet.
    """

    def accepted(image: int, evidence: PairEvidence, placement: Placement) -> Rigid3 | None:
        pose, why = _polished(model, image, evidence, placement=placement)
        if why:
            reasons[image] = why
        return None if why else pose

    order = sorted(weights, key=lambda idx: (-weights[idx], idx))
    # Six images are placed before the clearest of them is added, if none is clear by itself.
    for first in range(0, len(order), 6):
        doubtful: list[tuple[float, int, PairEvidence, list[Placement]]] = []
        for image in order[first : first + 6]:
            evidence, found = model.place(image)
            if not found:
                reasons[image] = why_nothing(model, image)
                continue
            rival = found[1].score / found[0].score if len(found) > 1 else 0.0
            share = found[0].score / evidence.total
            # Share of an image's pairs, by weight, that must agree with a clear placement.
            clear = rival < 0.8 and share > 0.5
            if clear and (pose := accepted(image, evidence, found[0])):
                return image, pose
            doubtful.append((share * (1 - 0.5 * rival), image, evidence, found))
        for _, image, evidence, found in sorted(doubtful, key=lambda item: (-item[0], item[1])):
            for placement in found[:2]:
                if pose := accepted(image, evidence, placement):
                    return image, pose
    return None


def _polished(model: PlacedModel, image: int, evidence: PairEvidence, *, placement: Placement) -> tuple[Rigid3, str]:
    """Return the refined pose of a placement, and why it is refused if too few known points support it."""
    pose, support, known = model.polished_near_pairs(image, evidence, placement)
    agreeing = len(set(evidence.partner[placement.explained].tolist()))
    if support >= points_needed(known, agreeing=agreeing):
        return pose, ""
    pairs, partner = model.pairs, model.pairs.partners[image][0]
    count = max(len(found.view) for found in pairs.geometries[min(image, partner), max(image, partner)])
    return pose, why_refused(support, known, agreeing=agreeing, partner=pairs.names[partner], matches=count)


def settle(model: PlacedModel, *, adjust: bool) -> None:
    """Choose the geometries of a grown model again, and adjust it with them."""
    for _ in range(2 if adjust else 1):
        if adjust:
            model.adjust()
        model.choose_again()


def why_nothing(model: PlacedModel, image: int) -> str:
    """Return why none of the pairs of an image suggests a place for it."""
    if any(idx in model.cameras for idx in model.pairs.partners[image]):
        return "no pair with a registered image shares enough points with a third image to determine the distance"
    return "its pairs are all with images that could not be registered"
