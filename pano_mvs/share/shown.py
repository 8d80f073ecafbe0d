"""What a page shows of a run: its largest group of cameras, or the whole house if links of a tour join all parts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pano_mvs.core.errors import InputError
from pano_mvs.geometry import Rigid3, Similarity3
from pano_mvs.io.house_file import HOUSE_FILE, read_house
from pano_mvs.results.run_output import RunOutput
from pano_mvs.scene import House, PlacedBy, PointCloud
from pano_mvs.scene.pose_groups import split_groups
from pano_mvs.share.mesh_file import SharedMesh, joined_meshes, run_mesh

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
    leads_to: tuple[str, ...] | None = None  # panoramas that can be seen from it, if it has no ranges


@dataclass(frozen=True, eq=False)
class Shown:
    """What a page shows."""

    cameras: tuple[ShownCamera, ...]
    cloud: PointCloud | None
    mesh: SharedMesh | None
    has_plan: bool = True  # whether floor plans of the largest group show all of it
    notes: tuple[str, ...] = ()


def shown_of(run: RunOutput, *, with_mesh: bool) -> Shown:
    """Return what the page of a run shows, in the world of the largest group or in the frame of the house."""
    house, note = _house_of(run)
    if house is not None:
        return _whole_house(run, house, with_mesh=with_mesh)
    notes = [note]
    if len(run.summary.poses.by_group()) > 1:
        notes.append("the page shows the largest group of panoramas; each group has a frame of its own")
    mesh, note = run_mesh(run) if with_mesh else (None, "")
    poses = split_groups(run.poses)[0] if run.poses is not None else None
    cameras = poses.cameras if poses is not None else {}
    return Shown(
        tuple(ShownCamera(name, pose) for name, pose in cameras.items()),
        run.cloud.groups()[0] if run.cloud is not None else None,
        mesh,
        notes=tuple(filter(None, (*notes, note))),
    )


def _house_of(run: RunOutput) -> tuple[House | None, str]:
    if not run.has_file(HOUSE_FILE):
        return None, ""
    try:
        return read_house(run.out / HOUSE_FILE), ""
    except InputError as error:
        return None, str(error)


def _whole_house(run: RunOutput, house: House, *, with_mesh: bool) -> Shown:
    groups = split_groups(run.poses) if run.poses is not None and run.poses.names else []
    clouds = run.cloud.groups() if run.cloud is not None else []
    shown_clouds, meshes, notes = list[PointCloud](), list[SharedMesh](), list[str]()
    for number, group in enumerate(groups):
        inside = [name for name, own in zip(house.names, house.groups, strict=True) if own == number]
        if not inside:
            continue  # all of its cameras are doubtful
        into_house = house.house_from_world(inside[0], group.cameras[inside[0]])
        if number < len(clouds):
            shown_clouds.append(_moved(clouds[number], into_house))
        mesh, note = run_mesh(run, number) if with_mesh else (None, "")
        notes.append(note)
        if mesh is not None:
            meshes.append(mesh.moved(into_house))
    by_links = sum(by == PlacedBy.LINKS for by in house.placed_by)
    notes.append(f"links of the tour say where {by_links} of {len(house.names)} panoramas are; their places are rough")
    cameras = [
        ShownCamera(
            name,
            house.cam_from_house(idx),
            float(house.scales[idx]) if house.groups[idx] >= 0 else None,
            _PLACED.get(PlacedBy(house.placed_by[idx]), ""),
            house.links[idx],
        )
        for idx, name in enumerate(house.names)
    ]
    return Shown(
        tuple(cameras), _joined(shown_clouds), joined_meshes(meshes), has_plan=False, notes=tuple(filter(None, notes))
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
