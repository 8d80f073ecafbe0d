"""The evidence for and against each camera of a model: one row of measurements per camera, NaN where one is missing."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from pano_mvs.algorithms.poses.placement.placed_model import PlacedModel
from pano_mvs.algorithms.poses.placement.view_graph import Edge
from pano_mvs.algorithms.poses.verification.appearance import Appearance
from pano_mvs.geometry import Rigid3, geodesic_angle

FloatArray = NDArray[np.float64]
Row = dict[str, float]


class OfImages(NamedTuple):
    """What the images say of a camera; NaN where unknown."""

    share: float = np.nan  # of its texture, that other images confirm
    expected: float = np.nan  # the share that its neighbours suggest
    wide_share: float = np.nan  # of what it sees under more than 30°, that other images confirm
    appearance: Appearance = Appearance()  # what it shows, compared with what its neighbours expect there, if anything


def camera_evidence(
    model: PlacedModel,
    of_images: Mapping[int, OfImages],
    *,
    images: Collection[int] | None = None,
    contradicting_before: float = np.nan,
    refuted: Mapping[int, Sequence[Rigid3]] | None = None,
    undecided: Collection[int] | None = None,
) -> dict[int, Row]:
    """Return the evidence for cameras of a model, which is to be measured after all choices were made.

    Args:
        model: the cameras, with their pairs if these are known.
        of_images: image position to what the images say of its camera.
        images: whose evidence to return; None for that of all cameras.
        contradicting_before: the largest `links_contradicting` of the model with cameras that were left out since then:
            what contradicted them speaks against those that agree with them, such as copies of a room, as well.
        refuted: image position to poses that the images refute; places there are no rivals.
        undecided: images with another place that the images do not refute; None if they were not asked.

    Returns:
        Image position to the name and value of each measurement: `ratio` (share relative to the expected one), `share`,
        `wide_share`, `likeness` (correlation of what it shows with what is expected there, less the mean of the other
        cameras), `unlike` (see `Appearance`), `contradicted` (share of the weight of its pairs that does not agree with
        its place), `pairs_contradicting` (the mean of it over all cameras), `agreeing` (number of pairs that agree),
        `scale_worst` (largest |log ratio| of a distance between cameras to the one that known points suggest),
        `place_rival` (weight of another place relative to its own), `repeats` (mean weight of other geometries of the
        pairs of all cameras, relative to those in use), `linked` (weight of the learned pairs that agree less that of
        those that do not, across the weakest cut between the camera and the larger part of those with such pairs; see
        `weight_of_pair`), and `links_contradicting` (share of the weight of all learned pairs of the model that does
        not agree with its cameras), for cameras with such.
    """
    refuted = refuted or {}
    # Other geometries of pairs lead to other places; they do not count once the images refute all of these.
    repeats = _repeats(model) if undecided is None or undecided else 0.0
    # If no pair of a camera agrees, and those that do not may be chance, the pairs say nothing.
    silent = model.cameras.keys() - {image for edge in model.chosen for image in edge} - _certain(model)
    contradicted = {image: share for image, share in _contradicted(model).items() if image not in silent}
    pairs_contradicting = float(np.mean([*contradicted.values()])) if contradicted else np.nan
    linked, links_contradicting = _links(model)
    links_contradicting = float(np.fmax(links_contradicting, contradicting_before))
    rows = {}
    for image in sorted(model.cameras if images is None else images):
        own = of_images.get(image, OfImages())
        of_pairs = _of_pairs(model, image, refuted.get(image, ())) | {"contradicted": contradicted.get(image, np.nan)}
        rows[image] = {
            "ratio": own.share / own.expected if own.expected > 0 else np.nan,
            "share": own.share,
            "wide_share": own.wide_share,
            "likeness": _likeness(image, of_images),
            "unlike": own.appearance.unlike if own.appearance.cover > 0 else np.nan,
            **(dict.fromkeys(of_pairs, np.nan) if image in silent else of_pairs),
            "pairs_contradicting": pairs_contradicting,
            "repeats": repeats,
            "linked": linked.get(image, np.nan),
            "links_contradicting": links_contradicting if image in linked else np.nan,
        }
    return rows


def _certain(model: PlacedModel) -> set[int]:
    """Return the cameras with a pair that chance does not explain, whether or not it agrees with them."""
    return {
        image
        for edge, view in (model.pairs.compared or {}).items()
        if model.cameras.keys() >= {*edge} and view.log10_false_alarms < -50
        for image in edge
    }


def _likeness(image: int, of_images: Mapping[int, OfImages]) -> float:
    """Return how much better what an image shows is correlated with what is expected than in other images; or NaN.

    Light and noise lower the correlation of all of them.
    """
    correlations = {idx: own.appearance.correlation for idx, own in of_images.items() if own.appearance.cover > 0}
    others = [correlation for idx, correlation in correlations.items() if idx != image]
    return float(correlations[image] - np.mean(others)) if image in correlations and others else np.nan


def _contradicted(model: PlacedModel) -> dict[int, float]:
    """Return which share of the weight of its pairs does not agree with each camera, if it has any."""
    weights = {
        edge: found[0].weight
        for edge, found in model.pairs.geometries.items()
        if model.cameras.keys() >= {*edge} and found[0].weight > 0
    }
    of_cameras: dict[int, FloatArray] = {}
    for edge, weight in weights.items():
        for image in edge:
            both = of_cameras.setdefault(image, np.zeros(2))
            both += weight * np.array([edge not in model.chosen, 1.0])
    return {image: float(against / all_of_it) for image, (against, all_of_it) in of_cameras.items()}


def _repeats(model: PlacedModel) -> float:
    of_cameras: dict[int, list[tuple[float, int]]] = {}
    for edge, rank in model.chosen.items():
        found = model.pairs.geometries[edge]
        rival = max((other.weight for number, other in enumerate(found) if number != rank), default=0.0)
        for image in edge:
            of_cameras.setdefault(image, []).append((rival / max(found[rank].weight, 1e-9), len(found[rank].view)))
    means = [
        np.average(rivals, weights=matches)
        for rivals, matches in (zip(*own, strict=True) for own in of_cameras.values())
    ]
    return float(np.mean(means)) if means else np.nan


def _of_pairs(model: PlacedModel, image: int, refuted: Sequence[Rigid3]) -> Row:
    """Return how well the pairs of a camera agree with it, and with another place."""
    edges = [edge for edge in model.chosen if image in edge]
    errors = _scale_errors(model, image, edges)
    own = sum(model.pairs.geometries[edge][model.chosen[edge]].weight for edge in edges)
    return {
        "agreeing": float(len(edges)),
        "scale_worst": float(errors.max()) if len(errors) else np.nan,
        "place_rival": _place_rival(model, image, own, refuted=refuted),
    }


def _scale_errors(model: PlacedModel, image: int, edges: Sequence[Edge]) -> FloatArray:
    evidence = model.evidence(image, [edge[edge[0] == image] for edge in edges])
    actual = np.linalg.norm(model.cameras[image].center - evidence.origins, axis=1)
    used = [model.chosen[min(image, partner), max(image, partner)] for partner in evidence.partner.tolist()]
    known = (evidence.rank == np.array(used, np.intp)) & np.isfinite(evidence.lengths) & (actual > 0)
    return np.asarray(np.abs(np.log(evidence.lengths[known] / actual[known])))


def _place_rival(model: PlacedModel, image: int, own: float, *, refuted: Sequence[Rigid3]) -> float:
    """Return the weight of the best other place that the pairs of a camera suggest, relative to its own.

    Places that the images refute are not counted.
    """
    places = model.place(image)[1] if len(model.cameras) > 2 else []
    if not places or own <= 0:
        return np.nan
    known = (model.cameras[image], *refuted)
    elsewhere = (
        place.score
        for place in places
        if not any(is_same_place(place.cam_from_world, {**model.cameras, image: pose}, image) for pose in known)
    )
    return next(elsewhere, 0.0) / own


def is_same_place(pose: Rigid3, cameras: Mapping[int, Rigid3], image: int) -> bool:
    """Return whether a pose is that of a camera, within a share of the distance to the nearest other camera."""
    here = cameras[image]
    nearest = min(float(np.linalg.norm(other.center - here.center)) for idx, other in cameras.items() if idx != image)
    return (
        float(np.linalg.norm(pose.center - here.center)) <= 0.1 * nearest
        and float(geodesic_angle(pose.rotation, here.rotation)) <= 0.07
    )


def _links(model: PlacedModel) -> tuple[dict[int, float], float]:
    """Return what learned pairs say for the weakest cut between each camera that has any and the larger part of these.

    Also returned is the share of their weight that does not agree with the cameras, as if one more pair did agree; NaN
    without any.
    """
    weights = {}
    for edge, weight in model.pairs.learned_weights.items():
        if model.cameras.keys() >= {*edge}:
            view = (model.pairs.compared or {})[edge]
            weights[edge] = weight if model.agrees_with(edge, view if view else view.alternatives[0]) else -weight
    if not weights:
        return {}, np.nan
    images = sorted({image for edge in weights for image in edge})
    number = {image: idx for idx, image in enumerate(images)}
    ends = np.array([[number[image] for image in edge] for edge in weights]).T
    values = np.array([*weights.values()])
    graph = scipy.sparse.csr_array(
        scipy.sparse.coo_array((np.tile(values, 2), np.concatenate([ends, ends[::-1]], axis=1)), (len(images),) * 2)
    )
    found = np.full(len(images), np.inf)
    for part in _branches(graph):
        cut = float((graph @ (1.0 - part))[part].sum())
        for side in (part, ~part):
            if 2 * side.sum() <= len(images):
                found[side] = np.minimum(found[side], cut)
    against = np.maximum(-values, 0.0).sum()
    return dict(zip(images, found.tolist(), strict=True)), float(against / (np.abs(values).sum() + 1.0))


def _branches(graph: scipy.sparse.csr_array) -> Iterator[NDArray[np.bool_]]:
    """Yield parts of a graph that may have a weak cut: each node, and what hangs on an edge of the strongest tree."""
    count = graph.shape[0]
    yield from np.eye(count, dtype=np.bool_)
    strong = graph.maximum(0)
    strong.eliminate_zeros()
    strong.data *= -1
    tree = scipy.sparse.csgraph.minimum_spanning_tree(strong)
    parts = scipy.sparse.csgraph.connected_components(tree, directed=False)[1]
    for part in range(parts.max() + 1):
        order, before = scipy.sparse.csgraph.breadth_first_order(tree, int(np.argmax(parts == part)), directed=False)
        inside = np.eye(count, dtype=np.bool_)[order]  # of each node, the branch that hangs on it
        place = {node: idx for idx, node in enumerate(order.tolist())}
        for idx in range(len(order) - 1, 0, -1):
            inside[place[before[order[idx]]]] |= inside[idx]
        yield from (branch for branch in inside if not branch.all())
