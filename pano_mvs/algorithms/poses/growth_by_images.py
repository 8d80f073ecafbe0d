"""Grow a model where structure repeats: the images choose the camera that is placed next, and its place."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.poses.growth import grown_model, settle, why_nothing
from pano_mvs.algorithms.poses.placement.pair_evidence import Geometry, PairEvidence
from pano_mvs.algorithms.poses.placement.placed_model import Pairs, PlacedModel
from pano_mvs.algorithms.poses.placement.places import Placement
from pano_mvs.algorithms.poses.placement.view_graph import Edge, connected_groups
from pano_mvs.algorithms.poses.verification.appearance import Appearance, Surroundings
from pano_mvs.algorithms.poses.verification.arrangements import CHANCE_SHARE, is_better_arrangement, place_score
from pano_mvs.algorithms.poses.verification.confirmation import Confirmation, Evidence, nearest_cameras
from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import Rigid3, geodesic_angle, pixel_from_ray

Seed = tuple[Edge, int]

_WIDTH_PX = 128
"""Width of the sweeps that compare places. Between two views they separate right geometries from wrong ones nearly as
well as at 256 columns (area under the ROC .91, .85, .82, .93 instead of .92, .88, .86, .91 in four captures that
repeat), in less than half the time."""
_SEEDS, _MANY = 4, 20
_PARTNERS = 4  # of each image, with most matches; the geometries of its pairs with them may be seeds
_IMAGES, _PLACES = 8, 8  # numbers of images, and of places of each, that are compared before one is added
_SWEPT = 3  # number of places of an image that are swept, those where it shows most of what is expected
_STEPS = 1, 2  # in the order of capture, between images of pairs from which a model grows


def repeats(pairs: Pairs, consistent: Pairs) -> bool:
    """Return whether structure repeats, so that pairs alone hardly decide.

    At least a third of the pairs are ambiguous, or contradict other pairs. Of 80 drawn captures, this holds for nearly
    all places that repeat, and elsewhere (up to 17 %) only for a plain room (36 %) and a walk of three views (33 %).

    Args:
        pairs: all pairs.
        consistent: those whose rotations do not contradict those of other pairs.
    """
    clear = sum(not is_ambiguous(found) for found in consistent.geometries.values())
    return 3 * clear <= 2 * len(pairs.geometries) and bool(pairs.geometries)


def is_ambiguous(found: tuple[Geometry, ...]) -> bool:
    """Return whether the second geometry of a pair has more than a quarter of the weight of the first one."""
    return len(found) > 1 and found[1].weight > 0.25 * found[0].weight


def model_by_images(
    pairs: Pairs, images: Collection[int], *, confirmation: Confirmation, adjust: bool
) -> tuple[PlacedModel, dict[int, str]]:
    """Return a model of a connected group of images, and why images of the group could not be added to it.

    Where structure repeats, the pairs of an image agree on several places, and often most of them on a wrong one. So
    each camera is placed where the others confirm most of what it sees. The small range maps of the sweeps also have
    the ranges of key points that no third image shares, without which most right geometries have no length there.

    Several models are compared, of which the one whose cameras are confirmed most is returned: one by the pairs alone
    (`grown_model`), those that begin with pairs of neighbours in the order of capture, and those that begin with a seed
    that both of its images confirm. An arrangement that is the best one when it is found for the second time ends the
    search. In larger groups, seeds are used if neighbours gain nothing, and the first one that gains nothing ends it.

    Args:
        pairs: all pairs of the capture.
        images: positions of the images of the group.
        confirmation: of the capture.
        adjust: whether all cameras are adjusted as the model grows.
    """
    small = confirmation.at_width(_WIDTH_PX)
    best = by_pairs = grown_model(pairs, images, adjust=adjust)
    for steps in _STEPS:
        model = _of_neighbours(pairs, images, steps, adjust=adjust)
        if model is not None:
            found = _completed(model, images, small, adjust=adjust)
            if is_better_arrangement(found[0].cameras, best[0].cameras, confirmation):
                best = found
    many = len(images) > _MANY
    if many and best is not by_pairs:
        return best
    is_of_seed = False
    for seed in ranked_by_images(pairs, images, small):
        model = PlacedModel(pairs)
        model.seed(*seed)
        found = _completed(model, images, small, adjust=adjust)
        if is_of_seed and found[0].is_same_arrangement(best[0]):
            break
        if is_better_arrangement(found[0].cameras, best[0].cameras, confirmation):
            best, is_of_seed = found, True
        elif many:
            break
    return best


def ranked_by_images(pairs: Pairs, images: Collection[int], confirmation: Confirmation) -> list[Seed]:
    """Return pairs, each with the rank of the geometry to start from, that are confirmed most, best first.

    A good seed also has sufficient parallax and matches. No image is in more than two of them.
    """
    members = set(images)
    edges = {
        (min(image, partner), max(image, partner))
        for image in images
        for partner in pairs.partners[image][:_PARTNERS]
        if partner in members
    }
    ranked: list[tuple[float, Seed]] = []
    for edge in sorted(edges):
        for rank, one in enumerate(pairs.geometries[edge]):
            poses = {edge[0]: Rigid3.identity(), edge[1]: Rigid3(one.view.rotation, one.view.direction)}
            share = float(np.nan_to_num([*confirmation.shares(poses).values()]).mean())
            quality = share * min(one.parallax_deg / 5.0, 1.0) * min(len(one.view) / 40, 1.0)
            if quality > 0:
                ranked.append((-quality, (edge, rank)))
    kept: list[Seed] = []
    for _, seed in sorted(ranked):
        if all(sum(image in edge for edge, _ in kept) < 2 for image in seed[0]):
            kept.append(seed)
    return kept[: max(_SEEDS, 40 // len(members))]  # a small group costs little


def _of_neighbours(pairs: Pairs, images: Collection[int], steps: int, *, adjust: bool) -> PlacedModel | None:
    """Return the model that grows from pairs of images which are at most some steps apart in the order of capture.

    It is None if they are all pairs, or place no more than half of the images.
    """
    members = set(images)
    inside = [edge for edge in pairs.geometries if members.issuperset(edge)]
    near = {edge: pairs.geometries[edge] for edge in inside if edge[1] - edge[0] <= steps}
    if not near or len(near) == len(inside):
        return None
    group = connected_groups(near, len(pairs.names))[0]
    cameras = grown_model(replace(pairs, geometries=near), group, adjust=adjust)[0].cameras
    return PlacedModel(pairs).with_cameras(cameras) if 2 * len(cameras) > len(images) else None


def _completed(
    model: PlacedModel, images: Collection[int], confirmation: Confirmation, *, adjust: bool
) -> tuple[PlacedModel, dict[int, str]]:
    """Return a model with all images of a group that the others confirm, and the reasons for those left out."""
    model.adjust(cameras=adjust and len(model.cameras) > 2)
    growth = Growth(model, set(images) - model.cameras.keys(), confirmation, adjust)
    growth.grow()
    return growth.ended()


def extend_by_images(model: PlacedModel, left: set[int], confirmation: Confirmation, *, adjust: bool) -> dict[int, str]:
    """Add images to a model one at a time, the one that is confirmed most first, where it is confirmed most.

    Args:
        model: the model, changed in place.
        left: images to add; those that were added are removed.
        confirmation: of the capture.
        adjust: whether all cameras are adjusted each time their number has grown by a quarter. If False, only points
            are triangulated again.

    Returns:
        Why images could not be added although their pairs suggest places.
    """
    growth = Growth(model, left, confirmation, adjust)
    growth.grow()
    return growth.refused()


@dataclass(eq=False)
class Growth:
    """A model that grows by images."""

    model: PlacedModel
    left: set[int]  # images that are not in it
    confirmation: Confirmation
    adjust: bool  # whether all cameras are adjusted as the model grows
    options: list[_Option] = field(default_factory=list)  # places that were compared last
    maps: dict[int, NDArray[np.float32]] = field(default_factory=dict)  # confirmed ranges of its cameras
    changed: set[int] = field(default_factory=set)  # cameras whose maps are to be computed
    adjusted: int = 0  # number of cameras when it was last adjusted

    def __post_init__(self) -> None:
        if not self.adjusted:
            self.adjusted, self.changed = len(self.model.cameras), set(self.model.cameras)

    def grow(self) -> None:
        """Add images, the best one first, until no other is confirmed."""
        while options := self.usable():
            self.add(options[0])

    def usable(self) -> list[_Option]:
        """Return the places for further images at which these are confirmed more than by chance, best first."""
        for camera in sorted(self.changed):
            self.maps[camera] = self.confirmation.ranges(camera, self.model.cameras)
            bearings = self.model.pairs.bearings[camera]
            self.model.confirmed_ranges[camera] = ranges_of_key_points(self.maps[camera], bearings)
        self.changed = set()
        self.options = _options(self.model, self.left, self.confirmation, maps=self.maps, known=self.options)
        usable = (option for option in self.options if option.share >= CHANCE_SHARE)
        return sorted(usable, key=lambda option: (-option.score, option.image))

    def add(self, option: _Option) -> None:
        """Add an image at a place."""
        model = self.model
        model.add(option.image, option.pose)
        self.left.discard(option.image)
        self.changed = {option.image} | {idx for idx in model.cameras if option.image in _nearest(model, idx)}
        # The first cameras decide on all others.
        if len(model.cameras) > 1.25 * self.adjusted or len(model.cameras) < 6:
            model.adjust(cameras=self.adjust)
            self.adjusted = len(model.cameras)
            self.changed = set(model.cameras)

    def refused(self) -> dict[int, str]:
        """Return why images could not be added although their pairs suggest places."""
        why = "at the places that its pairs suggest, other images confirm nothing of what it sees"
        return {option.image: why for option in self.options if option.image in self.left}

    def ended(self) -> tuple[PlacedModel, dict[int, str]]:
        """Return the model after all cameras were adjusted, and why images could not be added."""
        refused = self.refused()
        settle(self.model, adjust=self.adjust)
        self.model.confirmed_ranges.clear()  # they belong to the cameras before the last adjustment
        return self.model, {image: refused.get(image) or why_nothing(self.model, image) for image in sorted(self.left)}


def ranges_of_key_points(ranges: NDArray[np.float32], bearings: FloatArray) -> FloatArray:
    """Return the ranges of key points (N,) in a small map, NaN where it has none."""
    columns, rows = np.floor(pixel_from_ray(bearings, ranges.shape)).astype(np.intp).T
    return np.asarray(ranges[rows.clip(0, len(ranges) - 1), columns % ranges.shape[1]], np.float64)


def _nearest(model: PlacedModel, camera: int) -> list[int]:
    others = {idx: pose for idx, pose in model.cameras.items() if idx != camera}
    return nearest_cameras(model.cameras[camera], others)


@dataclass(frozen=True, eq=False)
class _Option:
    """A place for an image that is not in a model yet."""

    image: int
    suggested: Rigid3  # the pose on which pairs agree
    sources: list[int]  # the nearest cameras
    appearance: Appearance  # of the image there
    pose: Rigid3  # refined on known points, as soon as it is swept
    evidence: Evidence | None = None  # what these confirm of what the image sees there; None if it was not swept

    @property
    def share(self) -> float:
        """The share that these confirm of what the image sees there; negative if it was not swept."""
        return -1.0 if self.evidence is None else float(np.nan_to_num(self.evidence.share))

    @property
    def score(self) -> float:
        """How far what the image shows is for this place, to be compared with that of other places alone."""
        return place_score(max(self.share, 0.0), self.appearance)


def _options(
    model: PlacedModel,
    images: Collection[int],
    confirmation: Confirmation,
    *,
    maps: Mapping[int, NDArray[np.float32]],
    known: list[_Option],
) -> list[_Option]:
    """Return the places of the images that are connected best with a model; of the next ones if these have none.

    Those at which the images show most of what other cameras expect are swept.

    Args:
        model: the model.
        images: images that are not in it.
        confirmation: of the capture.
        maps: confirmed ranges of its cameras.
        known: places that were compared before.
    """
    surroundings = Surroundings(confirmation, model.cameras, maps.get)

    def places(image: int) -> Iterator[tuple[_Option, Callable[[], Rigid3]]]:
        evidence, found = model.place(image, most=_PLACES)
        for place in found:
            pose = place.cam_from_world
            sources = nearest_cameras(pose, model.cameras)
            nearest = float(np.linalg.norm(pose.center - model.cameras[sources[0]].center)) if sources else 0.0
            before = (
                option
                for option in known
                if option.image == image
                and option.sources == sources
                and np.linalg.norm(option.suggested.center - pose.center) < 0.03 * nearest
                and geodesic_angle(option.suggested.rotation, pose.rotation) < np.deg2rad(1.0)
            )
            option = next(before, None) or _Option(image, pose, sources, surroundings.appearance(image, pose), pose)
            yield option, partial(_refined, model, image, evidence, place=place)

    weights = {image: _connection(model, image) for image in images}
    connected = sorted((image for image in images if weights[image] > 0), key=lambda idx: (-weights[idx], idx))
    compared: list[_Option] = []
    for first in range(0, len(connected), _IMAGES):
        for image in connected[first : first + _IMAGES]:
            found = sorted(places(image), key=lambda each: -place_score(0.0, each[0].appearance))
            for number, (option, refined) in enumerate(found):
                if number < _SWEPT and option.share < 0:
                    pose = refined()
                    evidence = confirmation.evidence(option.image, pose, model.cameras)
                    option = replace(option, pose=pose, evidence=evidence)
                compared.append(option)
        if any(option.share >= CHANCE_SHARE for option in compared):
            break
    return compared


def _refined(model: PlacedModel, image: int, evidence: PairEvidence, *, place: Placement) -> Rigid3:
    return model.polished(image, evidence, place)[0]


def _connection(model: PlacedModel, image: int) -> float:
    """Return the weight of the pairs of an image with a model."""
    return sum(
        model.pairs.geometries[min(image, partner), max(image, partner)][0].weight
        for partner in model.pairs.partners[image]
        if partner in model.cameras
    )
