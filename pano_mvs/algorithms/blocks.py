"""Blocks of a large capture: divide it, align the blocks by the cameras they have in common, and merge them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, permutations
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from pano_mvs.algorithms.poses.adjustment.refine import refine_poses
from pano_mvs.algorithms.poses.frame.gauge import moved_back
from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import (
    Rigid3,
    Similarity3,
    angle_between,
    geodesic_angle,
    nearest_rotation,
    rotation_from_rotvec,
    rotvec_from_rotation,
    similarity_from_points,
)
from pano_mvs.scene import Poses
from pano_mvs.scene.pose_groups import values_of_cameras, with_cameras


def divide_capture(
    names: Sequence[str],
    *,
    size: int,
    overlap: int,
    loop: bool = False,
    positions: Mapping[str, FloatArray] | None = None,
) -> list[list[str]]:
    """Return the names of the images of each block, in the order of the capture.

    Blocks are stretches of about equal length along the order of the images, each overlapping the next.

    `names`: all images, in the order in which they were taken. `size`: maximum number of images in a stretch.
    `overlap`: number of images that two consecutive stretches have in common. `loop`: whether the path ends where it
    began: the last block and the first one overlap, too. `positions`: rough positions (3,) of images in one frame, by
    name. Where the path comes near an image of another block that is more than `overlap` images before or after it,
    both blocks get the nearest such images of each other, at most `overlap` in all.

    Raises:
        UsageError: if the overlap is not less than half of the size, or fewer than three.
    """
    if overlap < 3:
        raise UsageError(f"blocks are aligned by 3 or more common images: an overlap of {overlap} is too small")
    if 2 * overlap >= size:
        raise UsageError(f"an overlap of {overlap} must be less than half of the size of a block, {size}")
    count = len(names)
    if count <= size:
        return [list(names)]
    length = count + (overlap if loop else 0)
    number = -(-(length - overlap) // (size - overlap))
    starts = np.linspace(0, length - overlap, number + 1).round().astype(int)
    stretches = [
        {idx % count for idx in range(start, min(stop + overlap, length))}
        for start, stop in zip(starts[:-1].tolist(), starts[1:].tolist(), strict=True)
    ]
    if positions is not None:
        stretches = _with_returns(names, stretches, positions, overlap=overlap)
    return [[names[idx] for idx in sorted(stretch)] for stretch in stretches]


def _with_returns(
    names: Sequence[str], stretches: Sequence[set[int]], positions: Mapping[str, FloatArray], *, overlap: int
) -> list[set[int]]:
    """Return the stretches with the images of other stretches where the path returns."""
    known = [[idx for idx in sorted(stretch) if names[idx] in positions] for stretch in stretches]
    centers = [np.array([positions[names[idx]] for idx in own]).reshape(-1, 3) for own in known]
    steps = [np.linalg.norm(np.diff(own, axis=0), axis=1) for own in centers if len(own) > 1]
    # Images of two blocks are of one place if they are this near, in median steps of the path.
    reach = 1.5 * float(np.median(np.concatenate(steps))) if steps else 0.0
    found = [set(stretch) for stretch in stretches]
    trees = [scipy.spatial.cKDTree(own) if len(own) else None for own in centers]
    for here, there in permutations(range(len(stretches)), 2):
        first, second = trees[there], trees[here]
        if first is None or second is None:
            continue
        near = first.sparse_distance_matrix(second, reach, output_type="ndarray")
        there_idx, here_idx = np.array(known[there])[near["i"]], np.array(known[here])[near["j"]]
        apart = np.abs(there_idx - here_idx)
        returns = np.minimum(apart, len(names) - apart) > overlap
        nearest = there_idx[returns][np.argsort(near["v"][returns], kind="stable")].tolist()
        added = [idx for idx in dict.fromkeys(nearest) if idx not in stretches[here]]
        found[here].update(added[: -(-overlap // 2)])
    return found


MIN_COMMON = 3
"""Number of common cameras that two blocks need."""

# A rotation is compared with a position at this distance, in median distances between neighbouring cameras.
_ARM = 3.0


@dataclass(frozen=True)
class BlockLink:
    """How well two blocks agree about their common cameras, after all blocks have been aligned.

    `first`: position of a block. `second`: position of the other one. `names`: the common cameras. `offsets`: (N,)
    distance between the two positions of each, in units of the merged world. `turns_rad`: (N,) angle between its two
    orientations. `spacing`: median distance between a common camera and its nearest neighbour in the first block.
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

    `reference`: position of the reference block. `world_from_block`: similarity of each block; None if it shares too
    few cameras with the others. `links`: the pairs of blocks with common cameras.
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

    `blocks`: cam_from_block of the cameras of each block, by image name. `reference`: position of the block whose world
    is kept.
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

    `source`: cam_from_source of each camera; at least three. `target`: cam_from_target of the same cameras.
    """
    before, after = _reference_points(source), _reference_points(target)
    weights = np.ones(len(before))
    found = Similarity3(1.0, np.eye(3), np.zeros(3))
    for _ in range(30):
        # Rotation and translation are those of all points, as Umeyama's. The scale is that of the centres alone,
        # because the arms have the length of the spacing in either frame.
        share = np.repeat(weights / weights.sum() / before.shape[1], before.shape[1])
        a, b = before.reshape(-1, 3), after.reshape(-1, 3)
        mean_a, mean_b = share @ a, share @ b
        rotation = nearest_rotation((b - mean_b).T @ ((a - mean_a) * share[:, None]))
        of_camera = weights / weights.sum()
        centers_a, centers_b = before[:, 0], after[:, 0]
        middle_a, middle_b = of_camera @ centers_a, of_camera @ centers_b
        turned = (centers_a - middle_a) @ rotation.T
        spread = float(of_camera @ np.sum(turned**2, axis=1))
        scale = float(of_camera @ np.sum(turned * (centers_b - middle_b), axis=1)) / max(spread, 1e-300)
        scale = scale if scale > 0 else 1.0
        found = Similarity3(scale, rotation, middle_b - scale * rotation @ middle_a)
        errors = np.linalg.norm(found.apply(before) - after, axis=-1).max(axis=1)
        weights = 1 / (errors + 1e-9 + 0.01 * float(np.median(errors)))
    return found


def camera_spacing(centers: FloatArray) -> float:
    """Return the median distance between a camera and its nearest neighbour, of centres (N, 3)."""
    apart = np.asarray(scipy.spatial.cKDTree(centers).query(centers, k=[2])[0])  # the nearest one is the camera itself
    return max(float(np.median(apart)), 1e-12)


def _reference_points(cameras: Sequence[Rigid3]) -> FloatArray:
    """Return the centre of each camera, and a point on each of its axes, (N, 4, 3)."""
    centers = np.array([camera.center for camera in cameras])
    axes = np.array([camera.rotation for camera in cameras])  # the rows are the axes in the world
    return np.concatenate([centers[:, None], centers[:, None] + _ARM * camera_spacing(centers) * axes], axis=1)


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
    # In median distances between neighbouring cameras.
    solution = scipy.optimize.least_squares(
        residuals, np.zeros(7 * len(free)), loss="cauchy", f_scale=0.02, x_scale=sizes, xtol=1e-12, ftol=1e-12
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


@dataclass(frozen=True, eq=False)
class MergedBlocks:
    """The cameras and points of all blocks in one world.

    `poses`: the merged poses. `owner`: (N,) position of the block to which each camera of `poses` belongs. `before`:
    the poses before all blocks were adjusted together; None if they were not.
    """

    poses: Poses
    owner: NDArray[np.intp]
    before: Poses | None = None

    def move(
        self, points: NDArray[np.floating[Any]], vectors: NDArray[np.floating[Any]], camera_idx: NDArray[np.intp]
    ) -> tuple[FloatArray, FloatArray]:
        """Return points (N, 3) in the world, and vectors (N, 3) at them, moved as each one's camera was adjusted."""
        assert self.before is not None
        turns = np.swapaxes(self.poses.rotations, 1, 2) @ self.before.rotations
        chosen, old, new = turns[camera_idx], self.before.centers[camera_idx], self.poses.centers[camera_idx]
        return (
            new + np.einsum("nij,nj->ni", chosen, points - old),
            np.einsum("nij,nj->ni", chosen, vectors),
        )


def owners_of(blocks: Sequence[Mapping[str, FloatArray]]) -> dict[str, int]:
    """Return the block to which each camera belongs.

    A camera in several blocks belongs to the block whose own cameras, those in no other block, are nearest: half of an
    overlap goes to either side, where the block is not at its edge.

    `blocks`: centres (3,) in one world of the cameras of each block, by image name.
    """
    homes: dict[str, list[int]] = {}
    for number, block in enumerate(blocks):
        for name in block:
            homes.setdefault(name, []).append(number)
    own = [np.array([block[name] for name in block if len(homes[name]) == 1]).reshape(-1, 3) for block in blocks]
    trees = [scipy.spatial.cKDTree(centers) if len(centers) else None for centers in own]

    def distance(number: int, name: str) -> float:
        tree = trees[number]
        return np.inf if tree is None else float(tree.query(blocks[number][name])[0])

    return {
        name: min(numbers, key=lambda number: (distance(number, name), number)) if len(numbers) > 1 else numbers[0]
        for name, numbers in homes.items()
    }


def merge_blocks(
    blocks: Sequence[Poses], world_from_block: Sequence[Similarity3], *, order: Sequence[str], reference: int
) -> MergedBlocks:
    """Return the poses and points of aligned blocks as poses of one group.

    The pose of a camera is that of the block to which it belongs. Points of different blocks that the same image sees
    in the same direction become one point, at the mean of their positions. Observations that are off by more than 0.5°
    afterwards are dropped, and points that are then seen from fewer than two cameras.

    `blocks`: poses of one group each. `world_from_block`: the similarity of each block. `order`: names of all cameras,
    in the order of the capture. `reference`: position of the block whose frame and unit of length are kept.
    """
    cameras = [
        {name: similarity.move_camera(pose) for name, pose in block.cameras.items()}
        for block, similarity in zip(blocks, world_from_block, strict=True)
    ]
    owner = owners_of([{name: pose.center for name, pose in own.items()} for own in cameras])
    names = tuple(name for name in order if name in owner)
    home = np.array([owner[name] for name in names], np.intp)
    final = [cameras[owner[name]][name] for name in names]
    own = [
        with_cameras(
            replace(block, center_stds=None, rotation_stds_rad=None),
            np.array([owner[name] == number for name in block.names], np.bool_),
        )
        for number, block in enumerate(blocks)
    ]
    merged = replace(
        Poses.without_points(
            dict(zip(names, final, strict=True)),
            rejected={name: why for block in blocks for name, why in block.rejected.items() if name not in owner},
            **blocks[reference].worlds[0]._asdict(),
        ),
        **values_of_cameras(own, names),
    )
    return MergedBlocks(_with_points(merged, blocks, world_from_block), home)


def adjust_merged(merged: MergedBlocks) -> MergedBlocks:
    """Return merged blocks after a bundle adjustment of all cameras and points together.

    Blocks are rigid when they are aligned. Where they bend differently, the adjustment distributes the difference over
    the cameras, so that it does not remain at the seams. The cameras as a whole stay in place. If the adjustment leaves
    out a camera, the blocks are returned as they are.
    """
    refined = refine_poses(merged.poses)
    if refined.names != merged.poses.names:
        return merged
    refined = moved_back(refined, similarity_from_points(refined.centers, merged.poses.centers))
    return replace(merged, poses=refined, before=merged.poses)


@dataclass(frozen=True, eq=False)
class _Observations:
    """Observations of all blocks: point, image and bearing of each, and the points with the blocks they come from."""

    point_idx: NDArray[np.intp]
    image_idx: NDArray[np.intp]
    bearings: FloatArray
    sigmas_rad: NDArray[np.float32] | None
    points: FloatArray
    block_of_point: NDArray[np.intp]
    colors: NDArray[np.uint8]


def _with_points(merged: Poses, blocks: Sequence[Poses], world_from_block: Sequence[Similarity3]) -> Poses:
    everything = _gathered(merged, blocks, world_from_block)
    label, point_idx = _joined_points(everything)
    count = int(label.max(initial=-1)) + 1
    sizes = np.maximum(np.bincount(label, minlength=count), 1)
    points = np.stack([np.bincount(label, axis, count) / sizes for axis in everything.points.T], axis=1)
    colors = np.zeros((count, 3), np.uint8)
    colors[label[::-1]] = everything.colors[::-1]
    # Each image sees a point once.
    _, first = np.unique(np.stack([point_idx, everything.image_idx]), axis=1, return_index=True)
    point_idx, image_idx, bearings = point_idx[first], everything.image_idx[first], everything.bearings[first]
    in_cam = np.einsum("tij,tj->ti", merged.rotations[image_idx], points[point_idx] - merged.centers[image_idx])
    errors = angle_between(in_cam, bearings)
    used = errors <= float(np.radians(0.5))
    seen = np.bincount(point_idx[used], minlength=count) >= 2
    used &= seen[point_idx]
    totals = np.bincount(point_idx[used], errors[used], count)
    return replace(
        merged,
        points_in_world=points[seen],
        point_colors_rgb=colors[seen],
        point_errors_rad=(totals / np.maximum(np.bincount(point_idx[used], minlength=count), 1))[seen].astype(
            np.float32
        ),
        track_point_idx=(np.cumsum(seen) - 1)[point_idx[used]].astype(np.int32),
        track_image_idx=image_idx[used].astype(np.int32),
        track_bearings=bearings[used],
        track_sigmas_rad=None if everything.sigmas_rad is None else everything.sigmas_rad[first][used],
    )


def _gathered(merged: Poses, blocks: Sequence[Poses], world_from_block: Sequence[Similarity3]) -> _Observations:
    position = {name: idx for idx, name in enumerate(merged.names)}
    first_point = np.cumsum([0, *(len(block.points_in_world) for block in blocks)])
    images = [np.array([position[name] for name in block.names], np.intp) for block in blocks]
    sigmas = [block.track_sigmas_rad for block in blocks if block.track_sigmas_rad is not None]
    return _Observations(
        np.concatenate([block.track_point_idx + start for block, start in zip(blocks, first_point, strict=False)]),
        np.concatenate([own[block.track_image_idx] for own, block in zip(images, blocks, strict=True)]),
        np.concatenate([block.track_bearings for block in blocks]),
        np.concatenate(sigmas) if len(sigmas) == len(blocks) else None,
        np.concatenate(
            [
                similarity.apply(block.points_in_world)
                for similarity, block in zip(world_from_block, blocks, strict=True)
            ]
        ),
        np.repeat(np.arange(len(blocks)), np.diff(first_point)),
        np.concatenate([block.point_colors_rgb for block in blocks]),
    )


def _joined_points(found: _Observations) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the number of the merged point of each point, and of each observation."""
    order = np.argsort(found.image_idx, kind="stable")
    starts = np.flatnonzero(np.diff(found.image_idx[order], prepend=-1))
    links = []
    for of_image in np.split(order, starts[1:]):
        if len(of_image) > 1:
            # Two observations in one image within this angle are of the same point; patch alignment moves them
            # differently in different blocks.
            close = scipy.spatial.cKDTree(found.bearings[of_image]).query_pairs(
                float(np.radians(0.03)), output_type="ndarray"
            )
            pairs = found.point_idx[of_image][close]
            links.append(pairs[found.block_of_point[pairs[:, 0]] != found.block_of_point[pairs[:, 1]]])
    joined = np.concatenate(links) if links else np.zeros((0, 2), np.intp)
    count = len(found.points)
    graph = scipy.sparse.coo_array((np.ones(len(joined), np.int8), (joined[:, 0], joined[:, 1])), shape=(count, count))
    label = scipy.sparse.csgraph.connected_components(graph, directed=False)[1].astype(np.intp)
    return label, label[found.point_idx]


def nearest_cameras(points: NDArray[np.floating[Any]], centers: FloatArray) -> NDArray[np.intp]:
    """Return the camera that is nearest to each point (N, 3), (N,).

    `points`: in the world. `centers`: (K, 3) of all cameras.
    """
    return np.asarray(scipy.spatial.cKDTree(centers).query(points)[1], np.intp)
