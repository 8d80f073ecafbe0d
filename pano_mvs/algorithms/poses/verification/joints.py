"""Check the joints of a model by the images: parts of it, such as rooms, that only few points connect.

The cameras of one part agree with one another wherever the part is placed. So the surfaces that each part sees by
itself are compared with those of the other part: neither may look through a surface of the other one, and if both see
the same surfaces, their images must match there.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.poses.placement.placed_model import PlacedModel
from pano_mvs.algorithms.poses.placement.view_graph import Edge, connected_groups
from pano_mvs.algorithms.poses.verification.confirmation import Confirmation, nearest_cameras
from pano_mvs.geometry import Rigid3, pixel_from_ray, pixel_solid_angle, ray_grid

FloatArray = NDArray[np.float64]

LINKED = 30  # two pairs of an image that share this many key points have a common scale
_CAMERAS, _PARTNERS = 3, 2  # cameras of a part that are compared, the nearest to the other part; partners of each
_SAME_RANGE, _BEYOND = 0.1, 1.2
_MIN_AGREEING_SR = 0.1
# Parts contradict each other if one looks through the other in this share of what both see, and in this solid angle …
_MAX_CONTRADICTING, _MIN_CONTRADICTING_SR = 0.1, 0.02
# … or if they see the same surfaces in this solid angle, but match this share of what cameras of a part match there.
_COMMON_SR, _MIN_DENSITY = 0.5, 0.05
# A second geometry with this share of the weight of the one in use is a rival.
_RIVAL = 0.4
_NAMED = 3


@dataclass(frozen=True)
class JointEvidence:
    """How the surfaces that two parts of a model see agree, in the mean over pairs of their cameras.

    Attributes:
        agreeing_sr: solid angle in which both parts see a surface at the same place.
        contradicting_sr: solid angle in which one part looks through a surface of the other one.
        density: matches per solid angle that agrees, relative to those of cameras of one part; NaN if a matcher has
            compared none of these pairs.
    """

    agreeing_sr: float
    contradicting_sr: float
    density: float

    @property
    def contradicts(self) -> bool:
        """Whether the parts cannot both be where they are."""
        seen = self.agreeing_sr + self.contradicting_sr
        if self.contradicting_sr > max(_MAX_CONTRADICTING * seen, _MIN_CONTRADICTING_SR):
            return True
        return self.agreeing_sr > _COMMON_SR and self.density < _MIN_DENSITY

    @property
    def confirms(self) -> bool:
        """Whether the images confirm that the parts are where they are."""
        if self.contradicting_sr > _MAX_CONTRADICTING * (self.agreeing_sr + self.contradicting_sr):
            return False  # also where parts see too little of the same surfaces for a contradiction
        return self.agreeing_sr > _MIN_AGREEING_SR and self.density >= _MIN_DENSITY and not self.contradicts


@dataclass(frozen=True)
class Joint:
    """Two parts of a model that meet, and the evidence for how they are joined.

    Attributes:
        first: images of one part.
        second: images of the other.
        evidence: of the surfaces that both see; None if a part has one camera only.
        matches: number of matches between them with which their cameras agree.
        rivals: share of the pairs between them with another geometry that has nearly as much weight; NaN without pairs.
    """

    first: list[int]
    second: list[int]
    evidence: JointEvidence | None
    matches: int
    rivals: float

    @property
    def is_certain(self) -> bool:
        """Whether the joint is not in doubt; a part of one camera is judged by its matches."""
        if self.evidence is None:
            return self.matches >= LINKED
        return self.evidence.confirms and not self.rivals > 1 / 2


def measured_joints(model: PlacedModel, confirmation: Confirmation) -> Iterator[Joint]:
    """Yield the joints between the parts of a model that meet; none if it has a single part."""
    for first, second in _meeting(model, linked_parts(model)):
        several = min(len(first), len(second)) > 1
        yield Joint(
            first,
            second,
            joint_evidence(model, confirmation, (first, second)) if several else None,
            sum(_matches_of(model, one, other) for one in first for other in second),
            _rival_share(model, first, second),
        )


def joint_doubts(model: PlacedModel, confirmation: Confirmation, *, given: bool = False) -> dict[int, str]:
    """Return the images of parts that the images contradict or do not confirm, with the reason.

    Parts are compared if each of them has two cameras or more. If two parts contradict each other, all images of the
    model are doubtful, because any joint between them may be wrong. If the images do not confirm the only joint between
    two sides of the model, or most pairs there have two geometries, the smaller side is doubtful.

    Args:
        model: the cameras and their pairs.
        confirmation: of the same capture.
        given: whether the poses come from elsewhere and not from these pairs: few common points then cause no doubt.
    """
    doubts: dict[int, str] = {}
    for joint in measured_joints(model, confirmation):
        if joint.evidence is not None and joint.evidence.contradicts:
            reason = (
                f"the images of {_named(model, joint.first)} contradict those of {_named(model, joint.second)}, and "
                "few points connect them: take panoramas in between"
            )
            return dict.fromkeys(sorted(model.cameras), reason)
        if given or joint.is_certain:
            continue
        side = _smaller_side(model, joint.first, joint.second)
        doubts |= dict.fromkeys(
            side,
            f"few points connect {_named(model, side)} with the other cameras, and the images do not confirm how: take "
            "panoramas in between",
        )
    return doubts


def linked_parts(model: PlacedModel) -> list[list[int]]:
    """Return the parts of a model, the largest first: images connected by pairs that share key points, so a scale.

    Two pairs of an image that share enough key points link their three images. Of the others, the pair with most
    matches is a part of two images.
    """
    views = {edge: model.pairs.geometries[edge][rank].view for edge, rank in model.chosen.items()}
    of_image: dict[int, list[Edge]] = {image: [] for image in model.cameras}
    for edge in sorted(views, key=lambda edge: (-len(views[edge]), edge)):
        for image in edge:
            of_image[image].append(edge)
    label = {image: image for image in model.cameras}

    def union(images: Collection[int]) -> None:
        labels = {label[image] for image in images}
        for image, one in label.items():
            if one in labels:
                label[image] = min(labels)

    for image, edges in sorted(of_image.items()):
        mine = {edge: np.unique(views[edge].matches_idx[:, edge.index(image)]) for edge in edges}
        for number, one in enumerate(edges):
            for other in edges[:number]:
                images = {*one, *other}
                if len({label[idx] for idx in images}) > 1:
                    shared = np.intersect1d(mine[one], mine[other], assume_unique=True)
                    if len(shared) >= LINKED:
                        union(images)
    for edge in sorted(views, key=lambda edge: (-len(views[edge]), edge)):
        alone = [sum(one == label[image] for one in label.values()) == 1 for image in edge]
        if all(alone):
            union(edge)
    return sorted(_groups(label), key=lambda part: (-len(part), part))


def _groups(label: Mapping[int, int]) -> list[list[int]]:
    groups: dict[int, list[int]] = {}
    for image, one in sorted(label.items()):
        groups.setdefault(one, []).append(image)
    return list(groups.values())


def _meeting(model: PlacedModel, parts: Sequence[list[int]]) -> Iterator[tuple[list[int], list[int]]]:
    """Yield the parts that pairs connect, or of which one has a camera near one of the other."""
    number = {image: idx for idx, part in enumerate(parts) for image in part}
    if len(parts) < 2:
        return
    near = {
        (image, other)
        for image, pose in model.cameras.items()
        for other in nearest_cameras(pose, {idx: camera for idx, camera in model.cameras.items() if idx != image})
    }
    meeting = {(min(number[a], number[b]), max(number[a], number[b])) for a, b in near | model.chosen.keys()}
    yield from ((parts[a], parts[b]) for a, b in sorted(meeting) if a != b)


def joint_evidence(
    model: PlacedModel, confirmation: Confirmation, parts: tuple[Collection[int], Collection[int]]
) -> JointEvidence:
    """Return how the surfaces that two parts of a model see by themselves agree.

    Args:
        model: the cameras and their pairs.
        confirmation: of the same capture.
        parts: images of both parts, two or more each.
    """
    cameras = model.cameras
    sides = _nearest(cameras, *parts), _nearest(cameras, *parts[::-1])
    ranges, own_density = {}, []
    for part, side in zip(parts, sides, strict=True):
        for image in side:
            partners = _partners(cameras, image, part)
            ranges[image] = _own_range(confirmation, cameras, image, partners=partners)
            matches = np.mean([_matches_of(model, image, partner) for partner in partners])
            own_density.append(matches / max(_solid_angle(np.isfinite(ranges[image])), _MIN_AGREEING_SR))
    agreeing = contradicting = matches_between = 0.0
    pairs = [pair for one in sides[0] for other in sides[1] for pair in ((one, other), (other, one))]
    for a, b in pairs:
        agrees, contradicts = _compared(ranges[a], ranges[b], cameras[b] @ cameras[a].inverse())
        agreeing += _solid_angle(agrees) / len(pairs)
        contradicting += _solid_angle(contradicts) / len(pairs)
        matches_between += _matches_of(model, a, b) / len(pairs)
    density = matches_between / max(agreeing, 1e-9) / max(float(np.median(own_density)), 1e-9)
    is_known = any(_was_compared(model, a, b) for a, b in pairs)
    return JointEvidence(agreeing, contradicting, density if is_known else np.nan)


def _compared(
    own: FloatArray, other: FloatArray, other_from_own: Rigid3
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return where the ranges of one image agree with those of another, and where the other looks through them.

    Args:
        own: (H, W) ranges of the image, NaN where there is none.
        other: (H, W) ranges of the other image.
        other_from_own: relative pose.

    Returns:
        Two masks (H, W) of the first image.
    """
    height, width = own.shape
    known = np.isfinite(own)
    seen = other_from_own.apply((ray_grid((height, width)) * np.where(known, own, 1.0)[..., None]).reshape(-1, 3))
    distances = np.maximum(np.linalg.norm(seen, axis=1), 1e-12)
    pixels = np.floor(pixel_from_ray(seen / distances[:, None], (height, width))).astype(np.intp)
    pixels = pixels.reshape(height, width, 2)
    distances = distances.reshape(height, width)
    x, y = pixels[..., 0] % width, pixels[..., 1].clip(0, height - 1)
    around = np.stack([other[(y + dy).clip(0, height - 1), (x + dx) % width] for dy in (-1, 0, 1) for dx in (-1, 0, 1)])
    with np.errstate(invalid="ignore"):
        agrees = known & (np.abs(around / distances - 1) < _SAME_RANGE).any(axis=0)
        nearest = np.where(np.isfinite(around), around, np.inf).min(axis=0)
        contradicts = known & np.isfinite(other[y, x]) & (nearest > _BEYOND * distances)
    return agrees, contradicts & ~agrees


def _own_range(
    confirmation: Confirmation, cameras: Mapping[int, Rigid3], image: int, *, partners: Collection[int]
) -> FloatArray:
    """Return the ranges (H, W) of an image that one of its partners confirms, NaN elsewhere."""
    found = np.full(confirmation.small(image).mask.shape, np.nan)
    for partner in partners:
        found = np.where(np.isfinite(found), found, confirmation.range_with(image, partner, cameras))
    return found


def _partners(cameras: Mapping[int, Rigid3], image: int, part: Collection[int]) -> list[int]:
    return nearest_cameras(cameras[image], {idx: cameras[idx] for idx in part if idx != image}, count=_PARTNERS)


def _matches_of(model: PlacedModel, one: int, other: int) -> int:
    """Return the number of matches of two images with which their cameras agree."""
    edge = min(one, other), max(one, other)
    return len(model.pairs.geometries[edge][model.chosen[edge]].view) if edge in model.chosen else 0


def _was_compared(model: PlacedModel, one: int, other: int) -> bool:
    """Return whether a matcher has compared two images: others have no matches for lack of trying."""
    compared = model.pairs.compared
    return compared is None or (min(one, other), max(one, other)) in compared


def _rival_share(model: PlacedModel, first: Collection[int], second: Collection[int]) -> float:
    """Return the share of the pairs between two parts that have another geometry with nearly as many matches."""
    rivals = []
    for one, other in ((one, other) for one in first for other in second):
        edge = min(one, other), max(one, other)
        if edge in model.chosen:
            found, rank = model.pairs.geometries[edge], model.chosen[edge]
            others = [geometry.weight for number, geometry in enumerate(found) if number != rank]
            rivals.append(max(others, default=0.0) > _RIVAL * found[rank].weight)
    return float(np.mean(rivals)) if rivals else np.nan


def _solid_angle(mask: NDArray[np.bool_]) -> float:
    """Return the solid angle of a mask (H, W)."""
    return float((pixel_solid_angle((mask.shape[0], mask.shape[1]))[:, None] * mask).sum())


def _nearest(cameras: Mapping[int, Rigid3], part: Collection[int], other: Collection[int]) -> list[int]:
    """Return the cameras of a part that are nearest to another part."""
    middle = np.mean([cameras[image].center for image in other], axis=0)
    return sorted(part, key=lambda image: (float(np.linalg.norm(cameras[image].center - middle)), image))[:_CAMERAS]


def _smaller_side(model: PlacedModel, first: Collection[int], second: Collection[int]) -> list[int]:
    """Return the smaller side of a model that only the pairs between two parts connect; empty if there is no such."""
    between = {edge for edge in model.chosen if (edge[0] in first) != (edge[1] in first)} & {
        edge for edge in model.chosen if (edge[0] in second) != (edge[1] in second)
    }
    if not between:
        return []
    number = {image: idx for idx, image in enumerate(sorted(model.cameras))}
    left = [(number[a], number[b]) for a, b in model.chosen if (a, b) not in between]
    images = sorted(model.cameras)
    sides = [[images[idx] for idx in group] for group in connected_groups(left, len(images))]
    own = [side for side in sides if {*side} & {*first}]
    if any({*side} & {*second} for side in own):
        return []
    others = [side for side in sides if {*side} & {*second}]
    one, other = (sorted(image for side in some for image in side) for some in (own, others))
    return one if (len(one), other[0]) < (len(other), one[0]) else other


def _named(model: PlacedModel, images: Collection[int]) -> str:
    names = [model.pairs.names[image] for image in sorted(images)]
    return ", ".join(names[:_NAMED]) + (" …" if len(names) > _NAMED else "")
