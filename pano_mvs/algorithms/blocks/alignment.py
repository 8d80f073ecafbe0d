"""Align blocks of cameras by the cameras that they have in common."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.optimize import least_squares

from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import (
    Rigid3,
    Similarity3,
    geodesic_angle,
    nearest_rotation,
    rotation_from_rotvec,
    rotvec_from_rotation,
)

MIN_COMMON = 3
"""Number of common cameras that two blocks need."""

_ROUNDS = 30
# A rotation is compared with a position at this distance, in median distances between neighbouring cameras.
_ARM = 3.0
_LOSS_SCALE = 0.02  # in median distances between neighbouring cameras


@dataclass(frozen=True)
class BlockLink:
    """How well two blocks agree about their common cameras, after all blocks have been aligned.

    Attributes:
        first: position of a block.
        second: position of the other one.
        names: the common cameras.
        offsets: (N,) distance between the two positions of each, in units of the merged world.
        turns_rad: (N,) angle between its two orientations.
        spacing: median distance between a common camera and its nearest neighbour in the first block.
    """

    first: int
    second: int
    names: tuple[str, ...]
    offsets: FloatArray
    turns_rad: FloatArray
    spacing: float

    @property
    def relative_offset(self) -> float:
        """The median offset as a share of the spacing of the cameras."""
        return float(np.median(self.offsets)) / self.spacing

    @property
    def turn_deg(self) -> float:
        """The median angle between orientations, in degrees."""
        return float(np.degrees(np.median(self.turns_rad)))


@dataclass(frozen=True)
class BlockAlignment:
    """The poses of blocks in one world, that of the reference block.

    Attributes:
        reference: position of the reference block.
        world_from_block: similarity of each block; None if it shares too few cameras with the others.
        links: the pairs of blocks with common cameras.
    """

    reference: int
    world_from_block: tuple[Similarity3 | None, ...]
    links: tuple[BlockLink, ...]


def align_blocks(blocks: Sequence[Mapping[str, Rigid3]], reference: int = 0) -> BlockAlignment:
    """Return the similarities that bring all blocks into the world of one of them.

    Pairs of blocks are aligned first, robustly, by the positions and orientations of their common cameras; orientations
    also determine the rotation about a line if the common cameras are on one line. Starting from the reference, the
    blocks are chained by the pairs with the most common cameras. Then the similarities of all blocks are adjusted
    together (Cauchy loss), which distributes the error of loops of blocks.

    Args:
        blocks: cam_from_block of the cameras of each block, by image name.
        reference: position of the block whose world is kept.
    """
    common = {
        (a, b): names
        for a, b in combinations(range(len(blocks)), 2)
        if len(names := tuple(name for name in blocks[a] if name in blocks[b])) >= MIN_COMMON
    }
    similarities: dict[int, Similarity3] = {reference: Similarity3(1.0, np.eye(3), np.zeros(3))}
    while step := _next_link(common, similarities):
        known, new = step
        names = common[min(step), max(step)]
        known_from_new = similarity_from_cameras(
            [blocks[new][name] for name in names], [blocks[known][name] for name in names]
        )
        similarities[new] = similarities[known] @ known_from_new
    used = {pair: names for pair, names in common.items() if pair[0] in similarities and pair[1] in similarities}
    if len(used) >= len(similarities):  # a loop of blocks
        similarities = _adjusted(blocks, used, similarities, reference=reference)
    return BlockAlignment(
        reference,
        tuple(similarities.get(number) for number in range(len(blocks))),
        tuple(_link(blocks, pair, names, similarities=similarities) for pair, names in used.items()),
    )


def similarity_from_cameras(source: Sequence[Rigid3], target: Sequence[Rigid3]) -> Similarity3:
    """Return the robust similarity target_from_source between two sets of poses of the same cameras.

    The sum of the distances between positions, and between points a few camera spacings away in the cameras' axes, is
    minimised by iteratively reweighted least squares, so that single cameras with wrong poses have little influence.

    Args:
        source: cam_from_source of each camera; at least three.
        target: cam_from_target of the same cameras.
    """
    before, after = _reference_points(source), _reference_points(target)
    weights = np.ones(len(before))
    found = Similarity3(1.0, np.eye(3), np.zeros(3))
    for _ in range(_ROUNDS):
        found = _weighted_similarity(before, after, weights)
        errors = np.linalg.norm(found.apply(before) - after, axis=-1).max(axis=1)
        weights = 1 / (errors + 1e-9 + 0.01 * float(np.median(errors)))
    return found


def camera_spacing(centers: FloatArray) -> float:
    """Return the median distance between a camera and its nearest neighbour, of centres (N, 3)."""
    apart = np.linalg.norm(centers[:, None] - centers[None], axis=-1)
    np.fill_diagonal(apart, np.inf)
    return max(float(np.median(apart.min(axis=1))), 1e-12)


def _reference_points(cameras: Sequence[Rigid3]) -> FloatArray:
    """Return the centre of each camera, and a point on each of its axes, (N, 4, 3)."""
    centers = np.array([camera.center for camera in cameras])
    axes = np.array([camera.rotation for camera in cameras])  # the rows are the axes in the world
    return np.concatenate([centers[:, None], centers[:, None] + _ARM * camera_spacing(centers) * axes], axis=1)


def _weighted_similarity(source: FloatArray, target: FloatArray, weights: FloatArray) -> Similarity3:
    """Return the similarity with the least weighted squared distance between points (N, 4, 3) of cameras.

    Rotation and translation are those of all points, as Umeyama's. The scale is that of the centres alone, because the
    arms have the length of the spacing in either frame.
    """
    share = np.repeat(weights / weights.sum() / source.shape[1], source.shape[1])
    a, b = source.reshape(-1, 3), target.reshape(-1, 3)
    mean_a, mean_b = share @ a, share @ b
    rotation = nearest_rotation((b - mean_b).T @ ((a - mean_a) * share[:, None]))
    of_camera = weights / weights.sum()
    centers_a, centers_b = source[:, 0], target[:, 0]
    middle_a, middle_b = of_camera @ centers_a, of_camera @ centers_b
    turned = (centers_a - middle_a) @ rotation.T
    spread = float(of_camera @ np.sum(turned**2, axis=1))
    scale = float(of_camera @ np.sum(turned * (centers_b - middle_b), axis=1)) / max(spread, 1e-300)
    scale = scale if scale > 0 else 1.0
    return Similarity3(scale, rotation, middle_b - scale * rotation @ middle_a)


def _next_link(
    common: Mapping[tuple[int, int], tuple[str, ...]], known: Mapping[int, Similarity3]
) -> tuple[int, int] | None:
    """Return a known block and the block to add next, with the most common cameras; None if no block can be added."""
    open_links = [
        (-len(names), *((a, b) if a in known else (b, a)))
        for (a, b), names in common.items()
        if (a in known) != (b in known)
    ]
    if not open_links:
        return None
    _, inside, outside = min(open_links)
    return inside, outside


def _adjusted(
    blocks: Sequence[Mapping[str, Rigid3]],
    common: Mapping[tuple[int, int], tuple[str, ...]],
    start: Mapping[int, Similarity3],
    *,
    reference: int,
) -> dict[int, Similarity3]:
    """Return the similarities with the least robust differences between the two poses of all common cameras."""
    free = [number for number in start if number != reference]
    pairs = []
    for (a, b), names in common.items():
        poses = [[blocks[number][name] for name in names] for number in (a, b)]
        centers = np.array([[pose.center for pose in own] for own in poses])
        rotations = np.array([[pose.rotation for pose in own] for own in poses])
        pairs.append((a, b, centers, rotations, camera_spacing(start[a].apply(centers[0]))))

    def unpacked(parameters: FloatArray) -> dict[int, Similarity3]:
        moved = {reference: start[reference]}
        for number, (log_scale, *rest) in zip(free, parameters.reshape(-1, 7), strict=True):
            turn, shift = np.array(rest[:3]), np.array(rest[3:])
            old = start[number]
            moved[number] = Similarity3(
                old.scale * float(np.exp(log_scale)), rotation_from_rotvec(turn) @ old.rotation, old.translation + shift
            )
        return moved

    def residuals(parameters: FloatArray) -> FloatArray:
        now = unpacked(parameters)
        found = []
        for a, b, centers, rotations, spacing in pairs:
            apart = now[a].apply(centers[0]) - now[b].apply(centers[1])
            turns = (rotations[0] @ now[a].rotation.T) @ np.swapaxes(rotations[1] @ now[b].rotation.T, 1, 2)
            found += [apart.ravel() / spacing, _ARM * rotvec_from_rotation(turns).ravel()]
        return np.concatenate(found)

    # Each block is turned about the origin of the world; lengths of the world are of the order of its extent.
    extent = max(float(np.abs(start[a].apply(centers[0])).max()) for a, _, centers, _, _ in pairs)
    sizes = np.tile([1.0, 1.0, 1.0, 1.0, extent, extent, extent], len(free))
    solution = least_squares(
        residuals, np.zeros(7 * len(free)), loss="cauchy", f_scale=_LOSS_SCALE, x_scale=sizes, xtol=1e-12, ftol=1e-12
    )
    return unpacked(solution.x)


def _link(
    blocks: Sequence[Mapping[str, Rigid3]],
    pair: tuple[int, int],
    names: tuple[str, ...],
    *,
    similarities: Mapping[int, Similarity3],
) -> BlockLink:
    first, second = ([similarities[number].move_camera(blocks[number][name]) for name in names] for number in pair)
    centers = [np.array([pose.center for pose in own]) for own in (first, second)]
    turns = np.array([geodesic_angle(a.rotation, b.rotation) for a, b in zip(first, second, strict=True)])
    offsets = np.linalg.norm(centers[0] - centers[1], axis=1)
    return BlockLink(*pair, names, offsets, turns, camera_spacing(centers[0]))
