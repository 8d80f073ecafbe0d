"""Measure the joints of a model by the images: parts of it, such as rooms, that only few points connect.

The cameras of one part agree with one another wherever the part is placed. So the surfaces that each part sees by
itself are compared with those of the other part: neither may look through a surface of the other one.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.poses.placement.placed_model import PlacedModel
from pano_mvs.algorithms.poses.placement.view_graph import Edge, connected_groups
from pano_mvs.algorithms.poses.verification.confirmation import Confirmation, nearest_cameras
from pano_mvs.algorithms.ranges.agreement import pixels_containing
from pano_mvs.geometry import Rigid3, pixel_solid_angle, ray_grid

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Joint:
    """Two parts of a model that meet."""

    parts: tuple[tuple[int, ...], tuple[int, ...]]  # images of either part
    matches: int  # number of matches between them with which their cameras agree
    # solid angle in which one part looks through a surface of the other one, relative to all in which both see one; NaN
    # if a part has one camera only, or if they see nothing in common
    contradicting: float


def measured_joints(model: PlacedModel, confirmation: Confirmation) -> list[Joint]:
    """Return the joints between the parts of a model that meet; none if it has a single part."""
    return [
        Joint(
            (tuple(first), tuple(second)),
            sum(_matches_of(model, one, other) for one in first for other in second),
            _contradicting(model.cameras, confirmation, (first, second))
            if min(map(len, (first, second))) > 1
            else np.nan,
        )
        for first, second in _meeting(model, linked_parts(model))
    ]


def linked_parts(model: PlacedModel) -> list[list[int]]:
    """Return the parts of a model, the largest first: images connected by pairs that share key points, so a scale.

    Two pairs of an image that share enough key points link their three images. Of the others, the pair with most
    matches is a part of two images.
    """
    views = {edge: model.pairs.geometries[edge][rank].view for edge, rank in model.chosen.items()}
    order = sorted(views, key=lambda edge: (-len(views[edge]), edge))
    linked = set[Edge]()
    for image in sorted(model.cameras):
        edges = [edge for edge in order if image in edge]
        mine = {edge: np.unique(views[edge].matches_idx[:, edge.index(image)]) for edge in edges}
        for one, other in combinations(edges, 2):
            # Two pairs of an image that share this many key points have a common scale.
            if not linked >= {one, other} and len(np.intersect1d(mine[one], mine[other], assume_unique=True)) >= 30:
                linked |= {one, other}
    alone = model.cameras.keys() - {image for edge in linked for image in edge}
    for edge in order:
        if alone >= {*edge}:
            linked.add(edge)
            alone -= {*edge}
    groups = connected_groups(linked, len(model.pairs.names))
    return [group for group in groups if group[0] in model.cameras]


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


def _contradicting(
    cameras: Mapping[int, Rigid3], confirmation: Confirmation, parts: tuple[Collection[int], Collection[int]]
) -> float:
    """Return the share of what two parts see by themselves that the other part looks through."""
    sides = _nearest(cameras, *parts), _nearest(cameras, *parts[::-1])
    ranges = {}
    for part, side in zip(parts, sides, strict=True):
        for image in side:
            found = np.full(confirmation.small(image).mask.shape, np.nan)
            others = {idx: cameras[idx] for idx in part if idx != image}
            for partner in nearest_cameras(cameras[image], others, count=2):
                found = np.where(np.isfinite(found), found, confirmation.range_with(image, partner, cameras))
            ranges[image] = found
    agreeing = contradicting = 0.0
    for a, b in (pair for one in sides[0] for other in sides[1] for pair in ((one, other), (other, one))):
        masks = _compared(ranges[a], ranges[b], cameras[b] @ cameras[a].inverse())
        solid_angle = pixel_solid_angle((masks[0].shape[0], masks[0].shape[1]))[:, None]
        agrees, contradicts = (float((solid_angle * mask).sum()) for mask in masks)
        agreeing += agrees
        contradicting += contradicts
    return contradicting / (agreeing + contradicting) if agreeing + contradicting > 0 else np.nan


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
    distances = np.maximum(np.linalg.norm(seen, axis=1), 1e-12).reshape(height, width)
    y, x = pixels_containing(seen.reshape(height, width, 3) / distances[..., None], (height, width))
    around = np.stack([other[(y + dy).clip(0, height - 1), (x + dx) % width] for dy in (-1, 0, 1) for dx in (-1, 0, 1)])
    with np.errstate(invalid="ignore"):
        agrees = known & (np.abs(around / distances - 1) < 0.1).any(axis=0)
        nearest = np.where(np.isfinite(around), around, np.inf).min(axis=0)
        contradicts = known & np.isfinite(other[y, x]) & (nearest > 1.2 * distances)
    return agrees, contradicts & ~agrees


def _matches_of(model: PlacedModel, one: int, other: int) -> int:
    """Return the number of matches of two images with which their cameras agree."""
    edge = min(one, other), max(one, other)
    return len(model.pairs.geometries[edge][model.chosen[edge]].view) if edge in model.chosen else 0


def _nearest(cameras: Mapping[int, Rigid3], part: Collection[int], other: Collection[int]) -> list[int]:
    """Return the cameras of a part that are nearest to another part."""
    middle = np.mean([cameras[image].center for image in other], axis=0)
    return sorted(part, key=lambda image: (float(np.linalg.norm(cameras[image].center - middle)), image))[:3]
