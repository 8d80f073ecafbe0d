"""Tracks: key points of several images that show the same point, and their triangulation with given poses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
import scipy
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray, IndexArray
from pano_mvs.core.settings import Setting, checks_settings
from pano_mvs.scene import Features, Poses, TwoView
from pano_mvs.scene.pose_groups import per_group

TwoViews = Mapping[tuple[str, str], TwoView]


@dataclass(frozen=True, eq=False)
class Tracks:
    """Observations sorted by track, then by image; no track has two key points in one image."""

    names: tuple[str, ...]  # image names, in the capture's order
    track_idx: IndexArray  # (T,) the track of each observation, 0 … count − 1
    image_idx: IndexArray  # (T,) its image, a position in `names`
    keypoint_idx: IndexArray  # (T,) its key point in that image
    bearings: FloatArray  # (T, 3) its unit ray in the camera frame
    colors_rgb: NDArray[np.uint8]  # (T, 3) uint8 its colour
    count: int  # number of tracks

    def __len__(self) -> int:
        return self.count


def build_tracks(features: Mapping[str, Features], two_views: TwoViews) -> Tracks:
    """Return the tracks that verified matches form, by union of all matches.

    If the union would join two key points of one image, the matches are added again one at a time, those with the
    smallest residual first, and matches that would cause such a conflict are left out.

    Args:
        features: key points by image name, in the capture's order.
        two_views: verified pairs; those without a general geometry are ignored.
    """
    names = tuple(features)
    offsets = np.cumsum([0, *(len(features[name]) for name in names)])
    nodes, residuals = _match_nodes(names, offsets, two_views)
    image_of_node = np.repeat(np.arange(len(names)), np.diff(offsets))
    total = int(offsets[-1])
    label = _labels(nodes, total)
    order = np.lexsort((image_of_node, label))
    same = (np.diff(label[order]) == 0) & (np.diff(image_of_node[order]) == 0)
    conflicting = np.zeros(len(label) + 1, np.bool_)
    conflicting[label[order[1:][same]]] = True
    inside = conflicting[label[nodes[:, 0]]]
    kept = _without_conflicts(nodes[inside], residuals[inside], image_of_node)
    label = _labels(np.concatenate([nodes[~inside], kept]), total)
    members = np.flatnonzero(np.bincount(label, minlength=total)[label] >= 2)
    members = members[np.lexsort((members, label[members]))]
    track_idx = np.unique(label[members], return_inverse=True)[1].astype(np.int32)
    image_idx = image_of_node[members].astype(np.int32)
    bearings = np.concatenate([np.zeros((0, 3)), *(features[name].bearings for name in names)])
    colors = np.concatenate([np.zeros((0, 3), np.uint8), *(features[name].colors_rgb for name in names)])
    return Tracks(
        names=names,
        track_idx=track_idx,
        image_idx=image_idx,
        keypoint_idx=(members - offsets[image_idx]).astype(np.int32),
        bearings=bearings[members],
        colors_rgb=colors[members],
        count=int(track_idx.max(initial=-1)) + 1,
    )


@checks_settings
def triangulate_tracks(
    poses: Poses,
    features: Mapping[str, Features],
    two_views: TwoViews,
    *,
    max_error_deg: Annotated[float, Setting("observations with a larger error are dropped", gt=0)] = 0.4,
    min_angle_deg: Annotated[float, Setting("minimum angle between the rays of a point", gt=0)] = 1.0,
) -> Poses:
    """Return the same poses with points triangulated from the verified matches; the poses stay exactly as they are.

    Matches between images of different groups are left out, since each group has its own world frame.

    Args:
        poses: known poses; its points, if any, are replaced.
        features: key points by image name.
        two_views: verified pairs.
        max_error_deg: largest angle between an observed ray and the ray to its point.
        min_angle_deg: smallest angle between the rays of a point that is seen twice.
    """

    def triangulated(group: Poses) -> Poses:
        known = {name: features[name] for name in group.names if name in features}
        inside = {pair: view for pair, view in two_views.items() if pair[0] in known and pair[1] in known}
        return poses_with_points(
            group, build_tracks(known, inside), max_error_deg=max_error_deg, min_angle_deg=min_angle_deg
        )

    return per_group(poses, triangulated)


def poses_with_points(poses: Poses, tracks: Tracks, *, max_error_deg: float, min_angle_deg: float) -> Poses:
    """Return the same poses with the points of tracks; images of tracks without a pose are ignored.

    A track that is seen from several groups gives a separate point in each of them.
    """
    return per_group(
        poses, lambda group: _with_points(group, tracks, max_error_deg=max_error_deg, min_angle_deg=min_angle_deg)
    )


def _with_points(poses: Poses, tracks: Tracks, *, max_error_deg: float, min_angle_deg: float) -> Poses:
    position = {name: idx for idx, name in enumerate(poses.names)}
    pose_of_image = np.array([position.get(name, -1) for name in tracks.names], np.int32)
    seen = pose_of_image[tracks.image_idx] >= 0
    track_idx, image_idx = tracks.track_idx[seen], pose_of_image[tracks.image_idx[seen]]
    bearings = tracks.bearings[seen]
    found = triangulate_observations(
        poses.centers[image_idx],
        np.einsum("nji,nj->ni", poses.rotations[image_idx], bearings),
        track_idx,
        count=tracks.count,
        max_error_rad=float(np.deg2rad(max_error_deg)),
        min_angle_rad=float(np.deg2rad(min_angle_deg)),
    )
    used = found.used
    point_idx = (np.cumsum(found.valid) - 1)[track_idx[used]].astype(np.int32)
    count = int(found.valid.sum())
    sizes = np.maximum(np.bincount(point_idx, minlength=count), 1)
    colors = np.stack([np.bincount(point_idx, c, count) / sizes for c in tracks.colors_rgb[seen][used].T], axis=1)
    return replace(
        poses,
        points_in_world=found.points_in_world[found.valid],
        point_colors_rgb=np.rint(colors).astype(np.uint8),
        point_errors_rad=(np.bincount(point_idx, found.errors_rad[used], count) / sizes).astype(np.float32),
        track_point_idx=point_idx,
        track_image_idx=image_idx[used].astype(np.int32),
        track_bearings=bearings[used],
        track_sigmas_rad=None,
    )


def _match_nodes(
    names: tuple[str, ...], offsets: NDArray[np.intp], two_views: TwoViews
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Return all matches between nodes (key points numbered across all images), (M, 2), and their residuals."""
    start = {name: int(offset) for name, offset in zip(names, offsets[:-1], strict=True)}
    nodes, residuals = [np.zeros((0, 2), np.int64)], [np.zeros(0, np.float32)]
    for first, second in sorted(pair for pair, view in two_views.items() if view):
        view = two_views[first, second]
        nodes.append((view.matches_idx + np.array([start[first], start[second]])).astype(np.int64))
        residuals.append(view.residuals_rad)
    return np.concatenate(nodes), np.concatenate(residuals)


def _labels(nodes: NDArray[np.int64], total: int) -> NDArray[np.intp]:
    graph = scipy.sparse.coo_array((np.ones(len(nodes), np.int8), (nodes[:, 0], nodes[:, 1])), shape=(total, total))
    return np.asarray(scipy.sparse.csgraph.connected_components(graph, directed=False)[1], np.intp)


def _without_conflicts(
    nodes: NDArray[np.int64], residuals: NDArray[np.float32], image_of_node: NDArray[np.intp]
) -> NDArray[np.int64]:
    """Return the matches that can be joined, best first, without two key points of one image in a track."""
    members: dict[int, dict[int, int]] = {}
    root: dict[int, int] = {}
    kept = np.zeros(len(nodes), np.bool_)
    for match in np.lexsort((nodes[:, 1], nodes[:, 0], residuals)):
        a, b = (root.setdefault(node, node) for node in nodes[match].tolist())
        for r in (a, b):
            members.setdefault(r, {int(image_of_node[r]): r})
        if a == b:
            kept[match] = True
        elif not members[a].keys() & members[b].keys():
            kept[match] = True
            members[a].update(members[b])
            root.update(dict.fromkeys(members.pop(b).values(), a))
    return nodes[kept]


@dataclass(frozen=True, eq=False)
class Triangulated:
    """Triangulated points of tracks, and the observations that support them."""

    points_in_world: FloatArray  # (P, 3), NaN if a track gives no point
    valid: NDArray[np.bool_]  # (P,) bool
    used: NDArray[np.bool_]  # (T,) bool, the observations that fit a valid point
    errors_rad: FloatArray  # (T,) angle between the observed ray and the ray to the point; π if there is no point


def triangulate_observations(
    centers: FloatArray,
    rays_in_world: FloatArray,
    point_idx: IndexArray,
    *,
    count: int,
    max_error_rad: float,
    min_angle_rad: float,
) -> Triangulated:
    """Triangulate tracks; the worst observation of a track is removed until all remaining ones fit.

    Args:
        centers: (T, 3) camera centre of every observation, in the world.
        rays_in_world: (T, 3) its unit ray, rotated into the world.
        point_idx: (T,) the track of every observation, ascending.
        count: P, number of tracks.
        max_error_rad: largest angle between an observed ray and the ray to the point.
        min_angle_rad: smallest angle between the rays of a track of two; longer tracks must be as well conditioned.
    """
    # Importing numba takes most of a second, so import it only where it is used.
    from pano_mvs.algorithms.poses.adjustment.kernels_points import triangulate

    starts = np.searchsorted(point_idx, np.arange(count + 1))
    # For two rays at angle α the smallest eigenvalue of Σ (I − r rᵀ) is 1 − cos α; more rays only increase it.
    least = float(1 - np.cos(min_angle_rad))
    return Triangulated(
        *triangulate(
            np.ascontiguousarray(centers), np.ascontiguousarray(rays_in_world), starts, least, max_error_rad, 8
        )
    )
