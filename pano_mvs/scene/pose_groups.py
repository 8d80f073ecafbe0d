"""Split, join and process groups of cameras that no reliable pair connects."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import RunStoppedError, UsageError
from pano_mvs.scene.poses import PER_CAMERA, Pose, Poses

ALONE = "no other image shares its frame, so its position is meaningless"
CLOSER = "Take panoramas closer together (0.5–1 m indoors) with more overlap"


def require_two_cameras(poses: Poses, *, remedy: str = CLOSER) -> None:
    """Check that poses have two cameras or more, without which there is nothing to sweep.

    Args:
        remedy: what the user can do about it.

    Raises:
        RunStoppedError: if they have fewer.
    """
    if len(poses.names) < 2:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in list(poses.rejected.items())[:8])
        raise RunStoppedError(f"no two panoramas could be registered, so there is no model. {remedy}. {reasons}")


def split_groups(poses: Poses) -> list[Poses]:
    """Return the groups of poses, the largest first, each as poses of one group.

    A group has its own cameras, in the capture's order, with their points, tracks, evidence and doubts, and its own
    frame and scale. Points that no camera sees go to group 0. Poses of one group are returned as they are; with several
    groups, `rejected` of each is empty.
    """
    if not poses.other_worlds:
        return [poses if poses.group_idx is None else replace(poses, group_idx=None)]
    groups = poses.groups
    group_of_point = np.zeros(len(poses.points_in_world), np.int32)
    group_of_point[poses.track_point_idx] = groups[poses.track_image_idx]
    return [
        _subset(poses, groups == number, group_of_point == number, number=number) for number in range(len(poses.worlds))
    ]


def join_groups(
    groups: Sequence[Poses], *, order: Sequence[str] | None = None, rejected: Mapping[str, str] | None = None
) -> Poses:
    """Return several poses, each of one group, as poses with groups.

    Groups are sorted by their number of cameras, the largest first; of groups of equal size, the one with the earliest
    image is first. A camera that is alone in its group is rejected, unless there is no other group.

    Args:
        groups: poses of one group each; no image may be in two of them. At least one.
        order: names of images in the capture's order, including all registered ones; by default the names of all
            groups in their order.
        rejected: further reasons of rejection. Images that a group registers are ignored.

    Returns:
        Cameras in the capture's order; points and tracks group by group. A single group is returned without groups.

    Raises:
        UsageError: if there is no group, one has groups itself, an image is in two groups, or `order` lacks one.
    """
    order = tuple(name for group in groups for name in group.names) if order is None else tuple(order)
    position = {name: idx for idx, name in enumerate(order)}
    if not groups:
        raise UsageError("there is no group to join")
    if any(group.other_worlds for group in groups):
        raise UsageError("a group that is joined must not have groups itself; split it first")
    names = [name for group in groups for name in group.names]
    if len(set(names)) < len(names):
        raise UsageError("an image is in two groups")
    missing = [name for name in names if name not in position]
    if missing:
        raise UsageError(f"the order of the images does not have {missing[0]!r}")
    reasons = {**(rejected or {})}
    for group in groups:
        reasons |= group.rejected
    ranked = sorted(
        (group for group in groups if group.names),
        key=lambda group: (-len(group.names), min(position[name] for name in group.names)),
    )
    kept = [group for number, group in enumerate(ranked) if number == 0 or len(group.names) > 1]
    reasons |= {name: ALONE for group in ranked if len(group.names) == 1 for name in group.names}
    kept = kept or list(groups[:1])
    registered = {name for group in kept for name in group.names}
    places = [position[name] for name in kept[0].names]
    # A capture with one group, the usual case, is not copied.
    alone = len(kept) == 1 and places == sorted(places)
    joined = replace(kept[0], group_idx=None) if alone else _concatenated(kept, position)
    return replace(joined, rejected={name: why for name, why in reasons.items() if name not in registered})


def per_group(poses: Poses, function: Callable[[Poses], Poses]) -> Poses:
    """Return poses with a function applied to each group, which gets and returns poses of one group.

    Poses of one group are simply passed to the function. Otherwise each group comes without `rejected`; what the
    function rejects is added to the reasons of all. Groups are sorted again if their sizes change.
    """
    if not poses.other_worlds:
        return function(poses)
    return join_groups([function(group) for group in split_groups(poses)], order=poses.names, rejected=poses.rejected)


def require_one_group(pose: Pose, others: Iterable[Pose]) -> None:
    """Raise UsageError unless all poses are in one group, and therefore in one world."""
    groups = {pose.group, *(other.group for other in others)}
    if len(groups) > 1:
        named = ", ".join(map(str, sorted(groups)))
        raise UsageError(
            f"a view and its sources are in groups {named} of the poses, which have different worlds. The "
            "view selector must choose sources of one group"
        )


def with_cameras(poses: Poses, kept: NDArray[np.bool_]) -> Poses:
    """Return poses of one group with a subset of its cameras; points with fewer than two of them are removed."""
    if kept.all():
        return poses
    seen = np.bincount(poses.track_point_idx[kept[poses.track_image_idx]], minlength=len(poses.points_in_world)) >= 2
    return replace(_subset(poses, kept, seen, number=0), rejected=poses.rejected)


def _subset(poses: Poses, cameras: NDArray[np.bool_], points: NDArray[np.bool_], *, number: int) -> Poses:
    names = tuple(np.array(poses.names, object)[cameras])
    tracks = cameras[poses.track_image_idx] & points[poses.track_point_idx]
    known = {name: getattr(poses, name) for name in PER_CAMERA}
    values: dict[str, Any] = {name: None if value is None else value[cameras] for name, value in known.items()}
    return replace(
        poses,
        names=names,
        rotations=poses.rotations[cameras],
        translations=poses.translations[cameras],
        points_in_world=poses.points_in_world[points],
        point_colors_rgb=poses.point_colors_rgb[points],
        point_errors_rad=poses.point_errors_rad[points],
        track_point_idx=_renumbered(points)[poses.track_point_idx[tracks]],
        track_image_idx=_renumbered(cameras)[poses.track_image_idx[tracks]],
        track_bearings=poses.track_bearings[tracks],
        track_sigmas_rad=None if poses.track_sigmas_rad is None else poses.track_sigmas_rad[tracks],
        rejected={},
        group_idx=None,
        other_worlds=(),
        evidence={name: poses.evidence[name] for name in names if name in poses.evidence},
        doubts={name: poses.doubts[name] for name in names if name in poses.doubts},
        **values,
        **poses.worlds[number]._asdict(),
    )


def _renumbered(kept: NDArray[np.bool_]) -> NDArray[np.int32]:
    """Return the new position of each kept item, (N,)."""
    positions: NDArray[np.int32] = (np.cumsum(kept) - 1).astype(np.int32)
    return positions


def _concatenated(groups: Sequence[Poses], position: Mapping[str, int]) -> Poses:
    """Return groups, numbered as they come, with their cameras in the capture's order."""
    names = [name for group in groups for name in group.names]
    order = np.array(sorted(range(len(names)), key=lambda idx: position[names[idx]]), np.intp)
    ordered = tuple(names[idx] for idx in order)
    place = np.argsort(order).astype(np.int32)
    first_camera = np.cumsum([0, *(len(group.names) for group in groups)])
    first_point = np.cumsum([0, *(len(group.points_in_world) for group in groups)])

    def joined(field: str) -> NDArray[Any]:
        return np.concatenate([getattr(group, field) for group in groups])

    points = [group.track_point_idx + np.int32(first) for group, first in zip(groups, first_point, strict=False)]
    images = [group.track_image_idx + np.int32(first) for group, first in zip(groups, first_camera, strict=False)]
    numbers = np.repeat(np.arange(len(groups), dtype=np.int32), np.diff(first_camera))
    known = [group.track_sigmas_rad for group in groups if group.track_sigmas_rad is not None]
    return replace(
        groups[0],
        names=ordered,
        rotations=joined("rotations")[order],
        translations=joined("translations")[order],
        points_in_world=joined("points_in_world"),
        point_colors_rgb=joined("point_colors_rgb"),
        point_errors_rad=joined("point_errors_rad"),
        track_point_idx=np.concatenate(points),
        track_image_idx=place[np.concatenate(images)],
        track_bearings=joined("track_bearings"),
        track_sigmas_rad=np.concatenate(known) if len(known) == len(groups) else None,
        group_idx=numbers[order] if len(groups) > 1 else None,
        other_worlds=tuple(group.worlds[0] for group in groups[1:]),
        **values_of_cameras(groups, ordered),
    )


def values_of_cameras(groups: Sequence[Poses], names: Sequence[str]) -> dict[str, Any]:
    """Return what is known of each camera of several groups, by field of `Poses`.

    Values per camera are in the order of names, NaN for groups without them, and None if no group has them.
    """
    place = {name: idx for idx, name in enumerate(name for group in groups for name in group.names)}
    order = np.array([place[name] for name in names], np.intp)
    joined: dict[str, Any] = {
        field: {name: value for group in groups for name, value in getattr(group, field).items()}
        for field in ("evidence", "doubts")
    }
    for field in PER_CAMERA:
        known = [getattr(group, field) for group in groups]
        filled = [
            np.full(len(group.names), np.nan) if values is None else values
            for group, values in zip(groups, known, strict=True)
        ]
        joined[field] = None if all(values is None for values in known) else np.concatenate(filled)[order]
    return joined
