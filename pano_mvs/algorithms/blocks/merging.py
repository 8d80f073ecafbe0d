"""Merge aligned blocks: each camera belongs to one block, and tracks meet at common images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from pano_mvs.geometry import Similarity3, angle_between
from pano_mvs.scene import Poses

FloatArray = NDArray[np.float64]

# Two observations in one image within this angle are of the same point; patch alignment moves them differently in
# different blocks.
_SAME_RAD = float(np.radians(0.03))
_MAX_ERROR_RAD = float(np.radians(0.5))


@dataclass(frozen=True, eq=False)
class MergedBlocks:
    """The cameras and points of all blocks in one world.

    Attributes:
        poses: the merged poses.
        owner: (N,) position of the block to which each camera of `poses` belongs.
    """

    poses: Poses
    owner: NDArray[np.intp]


def owners_of(blocks: Sequence[Mapping[str, FloatArray]]) -> dict[str, int]:
    """Return the block to which each camera belongs.

    A camera in several blocks belongs to the block whose own cameras, those in no other block, are nearest: half of an
    overlap goes to either side, where the block is not at its edge.

    Args:
        blocks: centres (3,) in one world of the cameras of each block, by image name.
    """
    homes: dict[str, list[int]] = {}
    for number, block in enumerate(blocks):
        for name in block:
            homes.setdefault(name, []).append(number)
    own = [np.array([block[name] for name in block if len(homes[name]) == 1]).reshape(-1, 3) for block in blocks]
    trees = [cKDTree(centers) if len(centers) else None for centers in own]

    def distance(number: int, name: str) -> float:
        tree = trees[number]
        return np.inf if tree is None else float(tree.query(blocks[number][name])[0])

    return {
        name: min(numbers, key=lambda number: (distance(number, name), number)) if len(numbers) > 1 else numbers[0]
        for name, numbers in homes.items()
    }


def merge_blocks(
    blocks: Sequence[Poses],
    world_from_block: Sequence[Similarity3],
    *,
    order: Sequence[str],
    reference: int,
) -> MergedBlocks:
    """Return the poses and points of aligned blocks as poses of one group.

    The pose of a camera is that of the block to which it belongs. Points of different blocks that the same image sees
    in the same direction become one point, at the mean of their positions. Observations that are off by more than 0.5°
    afterwards are dropped, and points that are then seen from fewer than two cameras.

    Args:
        blocks: poses of one group each.
        world_from_block: the similarity of each block.
        order: names of all cameras, in the order of the capture.
        reference: position of the block whose frame and unit of length are kept.
    """
    cameras = [
        {name: similarity.move_camera(pose) for name, pose in block.cameras.items()}
        for block, similarity in zip(blocks, world_from_block, strict=True)
    ]
    owner = owners_of([{name: pose.center for name, pose in own.items()} for own in cameras])
    names = tuple(name for name in order if name in owner)
    home = np.array([owner[name] for name in names], np.intp)
    final = [cameras[owner[name]][name] for name in names]
    world = blocks[reference].worlds[0]
    merged = replace(
        Poses.without_points(
            dict(zip(names, final, strict=True)),
            rejected={name: why for block in blocks for name, why in block.rejected.items() if name not in owner},
            frame=world.frame,
            scale=world.scale,
            metric=world.metric,
        ),
        doubts={name: blocks[owner[name]].doubts[name] for name in names if name in blocks[owner[name]].doubts},
        **_shares(blocks, names, owner),
    )
    return MergedBlocks(_with_points(merged, blocks, world_from_block), home)


def _shares(blocks: Sequence[Poses], names: Sequence[str], owner: Mapping[str, int]) -> dict[str, Any]:
    """Return the confirmed and expected shares of the cameras, by field; None if no block has them."""
    positions = [{name: idx for idx, name in enumerate(block.names)} for block in blocks]
    found: dict[str, Any] = {}
    for field in ("confirmed_shares", "expected_shares"):
        columns = [getattr(block, field) for block in blocks]
        if all(column is None for column in columns):
            continue
        found[field] = np.array(
            [
                np.nan if columns[owner[name]] is None else columns[owner[name]][positions[owner[name]][name]]
                for name in names
            ]
        )
    return found


@dataclass(frozen=True, eq=False)
class _Observations:
    """Observations of all blocks: point, image and bearing of each, and the points with the blocks they come from."""

    point_idx: NDArray[np.intp]
    image_idx: NDArray[np.intp]
    bearings: FloatArray
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
    used = errors <= _MAX_ERROR_RAD
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
    )


def _gathered(merged: Poses, blocks: Sequence[Poses], world_from_block: Sequence[Similarity3]) -> _Observations:
    position = {name: idx for idx, name in enumerate(merged.names)}
    first_point = np.cumsum([0, *(len(block.points_in_world) for block in blocks)])
    images = [np.array([position[name] for name in block.names], np.intp) for block in blocks]
    return _Observations(
        np.concatenate([block.track_point_idx + start for block, start in zip(blocks, first_point, strict=False)]),
        np.concatenate([own[block.track_image_idx] for own, block in zip(images, blocks, strict=True)]),
        np.concatenate([block.track_bearings for block in blocks]),
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
            close = cKDTree(found.bearings[of_image]).query_pairs(_SAME_RAD, output_type="ndarray")
            pairs = found.point_idx[of_image][close]
            links.append(pairs[found.block_of_point[pairs[:, 0]] != found.block_of_point[pairs[:, 1]]])
    joined = np.concatenate(links) if links else np.zeros((0, 2), np.intp)
    count = len(found.points)
    graph = coo_array((np.ones(len(joined), np.int8), (joined[:, 0], joined[:, 1])), shape=(count, count))
    label = connected_components(graph, directed=False)[1].astype(np.intp)
    return label, label[found.point_idx]


def nearest_owners(points: NDArray[np.floating[Any]], centers: FloatArray, owner: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return the block to which the camera nearest to each point (N, 3) belongs, (N,).

    Args:
        points: in the world.
        centers: (K, 3) of all cameras.
        owner: (K,) block of each.
    """
    return np.asarray(owner[cKDTree(centers).query(points)[1]], np.intp)
