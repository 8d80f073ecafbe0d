"""Put the groups of cameras and the single panoramas of a tour into one house, by its links."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy

from pano_mvs.algorithms.poses.frame.vertical_lines import Picture, find_segments, wall_azimuth
from pano_mvs.algorithms.poses.joining.floors import height_over_points
from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import UP, Rigid3, Similarity3, rotation_from_rotvec, rotation_from_two_vectors
from pano_mvs.scene import House, PlacedBy, Poses, RoomOutline, SceneLink
from pano_mvs.scene.pose_groups import split_groups, with_cameras
from pano_mvs.scene.upright import mean_up_direction
from pano_mvs_tours.layout import Place, layout
from pano_mvs_tours.parts import Part, part_links

_SHARED_POINTS = 15  # least number of points that two cameras of one part see
_BESIDE = 3.0  # distance of what no link joins from the house, in camera heights


@dataclass(frozen=True, eq=False)
class _Levelled:
    """A part, with the rotation from the world of its group into its level frame."""

    part: Part
    level_from_world: Rigid3
    height_of_cameras: float  # y of the cameras in the level frame
    group: int  # number of the group; -1 for a single panorama


class _Row(NamedTuple):
    """A panorama of a house, as `House` has it."""

    cam_from_house: Rigid3
    part: int
    group: int
    scale: float
    placed_by: PlacedBy
    center_std: float
    turn_std_rad: float


def house_of_links(
    poses: Poses,
    links: Mapping[str, Sequence[SceneLink]],
    pictures: Mapping[str, Picture],
    *,
    up_in_cam: Mapping[str, Sequence[float]] | None = None,
    rooms: Mapping[str, RoomOutline] | None = None,
) -> House:
    """Return where all panoramas of a tour stand, in the frame and unit of the group of the largest part.

    Cameras of a tour stand at one height above the floor, so that groups and single panoramas have one unit. Links
    give directions and rough distances (see `layout`), and the lines of walls the exact turn around the vertical. All
    floors are put at one level: links say nothing about storeys.

    Doubtful cameras stand where links say, not where matches do, and cameras that only these connect with a group do
    not belong to it: what makes them doubtful is that rooms look alike, and then links know better.

    Args:
        poses: of the panoramas that are in groups; others are single.
        links: image name to its links. If none joins two parts, no picture is loaded.
        pictures: image name to a function that loads it, of all panoramas in the capture's order.
        up_in_cam: direction away from gravity by sensors of cameras; others are taken to be level.
        rooms: by image name; these say better how a camera is tilted, and how walls are turned.
    """
    rooms = {name: room for name, room in (rooms or {}).items() if room.ceiling is not None}
    levels = {
        name: rotation_from_two_vectors(np.asarray(up, np.float64), UP) for name, up in (up_in_cam or {}).items()
    } | {name: room.cam_from_level.T for name, room in rooms.items()}
    groups = split_groups(poses) if poses.names else []
    is_tour = any(link.direction_deg is not None for own in links.values() for link in own)
    levelled = [
        _of_group(with_cameras(group, np.isin(group.names, names)), number)
        for number, group in enumerate(groups)
        for names in (_certain(group) if is_tour else [group.names])
    ]
    levelled.sort(key=lambda one: -len(one.part.cameras))
    grouped = {name for one in levelled for name in one.part.cameras}
    for name in pictures:
        if name not in grouped:
            level = Rigid3(levels.get(name, np.eye(3)), np.zeros(3))
            levelled.append(_Levelled(Part({name: level.inverse()}), Rigid3.identity(), 0.0, -1))
    parts = [one.part for one in levelled]
    between = any(link.parts[0] != link.parts[1] for link in part_links(parts, links))
    if between:
        parts = [_with_walls(part, pictures, rooms) for part in parts]
        places = layout(parts, part_links(parts, links), rng=np.random.default_rng(0))
    else:
        places = [Place(np.zeros(2), 0.0, _scale(part), 0.0, 0.0) for part in parts[:1]] + [None] * len(parts[1:])
    return _house(levelled, places, links, order=tuple(pictures)).with_rooms(rooms)


def _certain(group: Poses) -> list[list[str]]:
    """Return the cameras of a group that are not doubtful and share points, in parts of two or more, largest first."""
    seen = scipy.sparse.coo_array(
        (np.ones(len(group.track_image_idx)), (group.track_image_idx, group.track_point_idx)),
        (len(group.names), len(group.points_in_world)),
    ).tocsr()
    certain = np.array([name not in group.doubts for name in group.names], np.bool_)
    shared = scipy.sparse.coo_array(seen @ seen.T)
    joins = (shared.data >= _SHARED_POINTS) & certain[shared.row] & certain[shared.col]
    ends = np.stack([shared.row[joins], shared.col[joins]]).astype(np.intp)
    if not len(group.points_in_world):  # poses from a file: nothing speaks against their connection
        ends = np.stack([np.flatnonzero(certain)[:-1], np.flatnonzero(certain)[1:]])
    graph = scipy.sparse.coo_array((np.ones(ends.shape[1]), (ends[0], ends[1])), (len(certain), len(certain)))
    labels = scipy.sparse.csgraph.connected_components(graph, directed=False)[1]
    parts = [np.flatnonzero(certain & (labels == label)) for label in np.unique(labels[certain])]
    parts.sort(key=lambda part: (-len(part), int(part[0])))
    return [[group.names[idx] for idx in part] for part in parts if len(part) > 1]


def _of_group(group: Poses, number: int) -> _Levelled:
    cameras = list(group.cameras.values())
    up = None if group.worlds[0].axes.is_level else mean_up_direction([camera.rotation for camera in cameras])
    rotation = np.eye(3) if up is None else rotation_from_two_vectors(up, UP)
    level = Rigid3(rotation, -rotation @ np.mean([camera.center for camera in cameras], axis=0))
    own = {name: camera @ level.inverse() for name, camera in group.cameras.items()}
    ups = [camera.rotation @ UP for camera in own.values()]
    height = height_over_points(level.apply(group.points_in_world), list(own.values()), ups)
    return _Levelled(
        Part(own, height=height or np.nan),
        level,
        float(np.median([camera.center[1] for camera in own.values()])),
        number,
    )


def _with_walls(part: Part, pictures: Mapping[str, Picture], rooms: Mapping[str, RoomOutline]) -> Part:
    if part.is_single and (room := rooms.get(next(iter(part.cameras)))) is not None:
        return Part(part.cameras, part.height, room.wall_rad or 0.0)
    rotations = {name: camera.rotation for name, camera in part.cameras.items()}
    return Part(part.cameras, part.height, wall_azimuth(find_segments(pictures, rotations)))


def _house(
    levelled: Sequence[_Levelled],
    places: Sequence[Place | None],
    links: Mapping[str, Sequence[SceneLink]],
    *,
    order: Sequence[str],
) -> House:
    """Return the house in which parts stand at their places; those without a place stand beside it."""
    if not levelled:
        return _of_rows({}, links, order=order, camera_height=None)
    first = places[0]
    assert first is not None
    world_from_level = levelled[0].level_from_world.inverse()
    world_from_first = Similarity3(1.0, world_from_level.rotation, world_from_level.translation)
    joined = sum(place is not None for place in places) > 1
    rows: dict[str, _Row] = {}
    right = max(_reach(one.part, place) for one, place in zip(levelled, places, strict=True) if place is not None)
    for number, (one, place) in enumerate(zip(levelled, places, strict=True)):
        by = PlacedBy.MATCHES if not number and not one.part.is_single else PlacedBy.LINKS
        if not number and one.part.is_single and not joined:
            by = PlacedBy.NOTHING
        if place is None:
            scale = _scale(one.part)
            beside = Place(np.zeros(2), 0.0, scale, np.inf, np.inf)
            left = -_reach(one.part, beside, sign=-1)
            place = Place(np.array([right + _BESIDE + left, 0.0]), 0.0, scale, np.inf, np.inf)
            right, by = _reach(one.part, place), PlacedBy.NOTHING
        scale = place.scale / first.scale
        x, z = place.position / first.scale
        height = levelled[0].height_of_cameras - scale * one.height_of_cameras
        level_from_part = Similarity3(scale, rotation_from_rotvec((0.0, place.turn_rad, 0.0)), np.array([x, height, z]))
        house_from_part = world_from_first @ level_from_part
        for name, camera in one.part.cameras.items():
            pose = house_from_part.move_camera(camera)
            deviations = place.position_std / first.scale, place.turn_std_rad
            rows[name] = _Row(pose, number, one.group, scale if one.group >= 0 else 1.0, by, *deviations)
    height = levelled[0].part.height
    known = float(height) if np.isfinite(height) else float(1 / first.scale) if joined else None
    return _of_rows(rows, links, order=order, camera_height=known)


def _of_rows(
    rows: Mapping[str, _Row],
    links: Mapping[str, Sequence[SceneLink]],
    *,
    order: Sequence[str],
    camera_height: float | None,
) -> House:
    names = tuple(name for name in order if name in rows)
    found = [rows[name] for name in names]
    return House(
        names=names,
        rotations=np.array([row.cam_from_house.rotation for row in found]).reshape(-1, 3, 3),
        translations=np.array([row.cam_from_house.translation for row in found]).reshape(-1, 3),
        parts=np.array([row.part for row in found], np.int32),
        groups=np.array([row.group for row in found], np.int32),
        scales=np.array([row.scale for row in found], np.float64),
        placed_by=tuple(str(row.placed_by) for row in found),
        center_stds=np.array([row.center_std for row in found], np.float64),
        turn_stds_rad=np.array([row.turn_std_rad for row in found], np.float64),
        links=tuple(tuple(link.name for link in links.get(name, ()) if link.name in names) for name in names),
        camera_height=camera_height,
    )


def _scale(part: Part) -> float:
    """Return the unit of a part in camera heights; 1 if its height above the floor is not known."""
    return 1 / part.height if not part.is_single and np.isfinite(part.height) else 1.0


def _reach(part: Part, place: Place, *, sign: int = 1) -> float:
    """Return the largest x of the cameras of a part at a place, or its smallest one, in camera heights."""
    sine, cosine = np.sin(place.turn_rad), np.cos(place.turn_rad)
    centers: FloatArray = np.array([camera.center for camera in part.cameras.values()])
    along = place.scale * (cosine * centers[:, 0] + sine * centers[:, 2]) + place.position[0]
    return float(along.max() if sign > 0 else along.min())
