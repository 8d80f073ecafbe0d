"""What a page shows of a run: its largest group of cameras, or the whole house if links of a tour join all parts."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from pano_mvs.core.errors import InputError
from pano_mvs.core.text import plural
from pano_mvs.geometry import Rigid3, Similarity3
from pano_mvs.io.house_file import HOUSE_FILE, read_house
from pano_mvs.results.run_output import RunOutput
from pano_mvs.scene import House, PlacedBy, PointCloud, Poses, RoomOutline
from pano_mvs.scene.pose_groups import split_groups
from pano_mvs_page.mesh_file import SharedMesh, joined_meshes, run_mesh
from pano_mvs_page.outlined import closed_walls, room_cloud, room_mesh

_PLACED = {
    PlacedBy.LINKS: "placed by links of the tour",
    PlacedBy.NOTHING: "beside the house: nothing says where it is",
}


@dataclass(frozen=True, eq=False)
class ShownCamera:
    """A panorama of the page."""

    name: str
    cam_from_world: Rigid3
    scale: float | None = 1.0  # unit of its ranges; None if these do not fit the place where it is shown
    placed: str = ""  # what says where it is, unless matches do
    leads_to: tuple[str, ...] | None = None  # panoramas to which links of a tour lead; None without them
    room: RoomOutline | None = None  # the room around it, if it has no ranges
    camera_height: float = 1.0  # above the floor of this room


@dataclass(frozen=True, eq=False)
class Shown:
    """What a page shows."""

    cameras: tuple[ShownCamera, ...]
    cloud: PointCloud | None
    mesh: SharedMesh | None
    metric: bool = False  # whether the unit is the metre
    is_level: bool = False  # whether y points down along gravity
    has_plan: bool = True  # whether floor plans of the largest group show all of it
    notes: tuple[str, ...] = ()


Picture = Callable[[str], NDArray[np.uint8] | None]


def shown_of(run: RunOutput, *, with_mesh: bool, picture: Picture | None = None) -> Shown:
    """Return what the page of a run shows, in the world of the largest group or in the frame of the house.

    `picture`: returns a panorama (H, W, 3) by its name, if it can be read; it colours the room that it
    outlines.
    """
    house, note = _house_of(run)
    if house is not None:
        return _whole_house(run, house, with_mesh=with_mesh, picture=picture or (lambda _: None))
    notes = [note]
    largest, *others = run.summary.poses.by_group()
    if others:
        notes.append("the page shows the largest group of panoramas; each group has a frame of its own")
    mesh, note = run_mesh(run) if with_mesh else (None, "")
    poses = split_groups(run.poses)[0] if run.poses is not None else None
    cameras = poses.cameras if poses is not None else {}
    return Shown(
        tuple(ShownCamera(name, pose) for name, pose in cameras.items()),
        run.cloud.groups()[0] if run.cloud is not None else None,
        mesh,
        metric=largest.metric,
        is_level=largest.axes.is_level,
        notes=tuple(filter(None, (*notes, note))),
    )


def _house_of(run: RunOutput) -> tuple[House | None, str]:
    if not run.has_file(HOUSE_FILE):
        return None, ""
    try:
        return read_house(run.out / HOUSE_FILE), ""
    except InputError as error:
        return None, str(error)


def _whole_house(run: RunOutput, house: House, *, with_mesh: bool, picture: Picture) -> Shown:
    groups = split_groups(run.poses) if run.poses is not None and run.poses.names else []
    clouds = run.cloud.groups() if run.cloud is not None else []
    shown_clouds, meshes, notes = list[PointCloud](), list[SharedMesh](), list[str]()
    for number, group in enumerate(groups):
        moves = _moves(group, house, number)
        if not any(moves):
            continue  # all of its cameras are doubtful
        if number < len(clouds):
            nearest = _nearest_cameras(clouds[number].points_in_world, group)
            for move, cameras in _by_move(moves):
                shown_clouds.append(_moved(clouds[number].some(np.isin(nearest, cameras)), move))
        mesh, note = run_mesh(run, number) if with_mesh else (None, "")
        notes.append(note)
        if mesh is not None:
            nearest = _nearest_cameras(mesh.vertices, group)
            for move, cameras in _by_move(moves):
                inside = np.asarray(np.isin(nearest, cameras)[mesh.faces].all(axis=1))
                if inside.any():
                    meshes.append(_some_faces(mesh, inside).moved(move))
    rooms, drawn = _outlined_rooms(house), 0
    for name, (room, height) in rooms.items():
        image, pose = picture(name), house.cam_from_house(house.names.index(name))
        if image is None:
            continue
        drawn += 1
        shown_clouds.append(room_cloud(room, image, pose, camera_height=height))
        # A mesh hides the cloud, so that rooms have one only if the groups do.
        if with_mesh and (meshes or not groups):
            textured = not meshes or meshes[0].texture is not None
            drawn_as = room_mesh(room, image, pose, camera_height=height, textured=textured, count=len(rooms))
            meshes.append(drawn_as)
    if drawn:
        notes.append(
            f"{plural(drawn, 'a room', f'{drawn} rooms')} without ranges {plural(drawn, 'is', 'are')} "
            "drawn as the picture outlines them: floor, ceiling and walls, with furniture flat on them"
        )
    count = sum(by == PlacedBy.LINKS for by in house.placed_by)
    notes.append(
        f"links of the tour say where {count} of {len(house.names)} panoramas {plural(count, 'is', 'are')}; their "
        f"{plural(count, 'place is', 'places are')} rough"
    )
    if run.cloud is not None and len(run.cloud) and not shown_clouds:
        notes.append("the cloud is not shown, because all cameras that see it are doubtful")
    cameras_of_house = [
        ShownCamera(
            name,
            house.cam_from_house(idx),
            float(house.scales[idx]) if house.groups[idx] >= 0 else None,
            _PLACED.get(PlacedBy(house.placed_by[idx]), ""),
            house.links[idx],
            *rooms.get(name, (None, 1.0)),
        )
        for idx, name in enumerate(house.names)
    ]
    first = next((int(group) for part, group in zip(house.parts, house.groups, strict=True) if part == 0), -1)
    known = run.summary.poses.by_group()
    world = known[first] if 0 <= first < len(known) else None
    return Shown(
        tuple(cameras_of_house),
        _joined(shown_clouds),
        joined_meshes(meshes),
        metric=world is not None and world.metric,
        is_level=world is None or world.axes.is_level,
        has_plan=False,
        notes=tuple(filter(None, notes)),
    )


def _outlined_rooms(house: House) -> dict[str, tuple[RoomOutline, float]]:
    """Return the rooms of single panoramas, which have no ranges, each with the height of its camera."""
    height = house.camera_height
    if height is None:
        return {}
    single = {name for name, group in zip(house.names, house.groups, strict=True) if group < 0}
    return {
        name: (room, height)
        for name, room in house.rooms.items()
        if name in single and np.isfinite(closed_walls(room)).any()
    }


def _moves(group: Poses, house: House, number: int) -> list[tuple[int, Similarity3] | None]:
    """Return the part of each camera of a group and how it moves into the house; None for doubtful cameras."""
    part_of = {
        name: int(part) for name, part, own in zip(house.names, house.parts, house.groups, strict=True) if own == number
    }
    cameras = group.cameras
    move_of: dict[int, Similarity3] = {}
    for name, part in part_of.items():
        if part not in move_of and name in cameras:
            move_of[part] = house.house_from_world(name, cameras[name])
    return [(part_of[name], move_of[part_of[name]]) if name in part_of else None for name in group.names]


def _by_move(moves: Sequence[tuple[int, Similarity3] | None]) -> Iterator[tuple[Similarity3, list[int]]]:
    """Yield how the parts of a group move, each with the positions of its cameras."""
    known = {move[0]: move[1] for move in moves if move is not None}
    for part, move in known.items():
        yield move, [idx for idx, own in enumerate(moves) if own is not None and own[0] == part]


def _nearest_cameras(points: NDArray[np.float32], group: Poses) -> NDArray[np.intp]:
    """Return the position of the camera nearest to each point (P, 3): what it saw moves with it."""
    return np.asarray(scipy.spatial.cKDTree(group.centers).query(points)[1], np.intp)


def _some_faces(mesh: SharedMesh, chosen: NDArray[np.bool_]) -> SharedMesh:
    """Return some faces of a mesh with the vertices that they use: others would move to where nothing is."""
    used, faces = np.unique(mesh.faces[chosen], return_inverse=True)
    return replace(
        mesh,
        vertices=mesh.vertices[used],
        faces=faces.reshape(-1, 3).astype(np.int32),
        colors_rgb=None if mesh.colors_rgb is None else mesh.colors_rgb[used],
        uv=None if mesh.uv is None else mesh.uv[used],
    )


def _moved(cloud: PointCloud, into_house: Similarity3) -> PointCloud:
    scaled = None if cloud.uncertainty is None else (cloud.uncertainty * into_house.scale).astype(np.float32)
    return replace(
        cloud,
        points_in_world=into_house.apply(cloud.points_in_world).astype(np.float32),
        normals_in_world=(cloud.normals_in_world @ into_house.rotation.T).astype(np.float32),
        uncertainty=scaled,
    )


def _joined(clouds: Sequence[PointCloud]) -> PointCloud | None:
    return replace(PointCloud.of_groups(clouds), group_sizes=()) if clouds else None
