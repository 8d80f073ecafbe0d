"""Write a run as a page that opens in any browser, with its panoramas by room."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from html import escape
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from pano_mvs.algorithms.panoramas import reduced_panorama
from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.errors import InputError, WorkflowError
from pano_mvs.core.paths import resolved
from pano_mvs.core.yaml_text import parse_yaml
from pano_mvs.geometry import Rigid3, pixel_from_ray, pixel_solid_angle, ray_grid
from pano_mvs.results.colors import probability_color
from pano_mvs.results.figures import share as share_text
from pano_mvs.results.origin import Origin, RunName
from pano_mvs.results.run_output import RunOutput, load
from pano_mvs.results.summary import INTERRUPTED
from pano_mvs.scene import FilePart
from pano_mvs.scene.image_file import decode_image
from pano_mvs.scene.upright import WORLD_UP, mean_up_direction
from pano_mvs_page.maps import run_plans
from pano_mvs_page.mesh_file import thinned
from pano_mvs_page.outlined import room_map
from pano_mvs_page.page_folder import PageFolder
from pano_mvs_page.scene_parts import (
    RANGES_HW,
    ShareOptions,
    outline,
    put_camera,
    put_cloud,
    put_maps,
    put_mesh,
    reduced,
    shown_cloud,
)
from pano_mvs_page.shown import Shown, ShownCamera, shown_of

_ROOM_WIDTH_PX = 2048  # of the pictures whose colours outlined rooms have


def page_from_world(cameras: Sequence[Rigid3], *, is_level: bool = False) -> Rigid3:
    """Return the transform into the frame of the page.

    Args:
        cameras: the poses, cam_from_world. Up is the cameras' common up direction, or -y of the world if they were
            turned at random.
        is_level: whether y of the world points down along gravity, so that -y is up whatever the cameras say.
    """
    common = mean_up_direction([camera.rotation for camera in cameras]) if cameras and not is_level else None
    up = np.array(WORLD_UP) if common is None else common
    ahead = cameras[0].rotation[2] if cameras else np.array([0.0, 0.0, 1.0])
    right = np.cross(ahead, up)
    if np.linalg.norm(right) < 1e-6:
        right = np.cross(np.eye(3)[int(np.argmin(np.abs(up)))], up)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, up, np.cross(right, up)])
    centers = np.array([camera.center for camera in cameras]).reshape(-1, 3)
    origin = np.median(centers, axis=0) if len(centers) else np.zeros(3)
    return Rigid3(rotation, -rotation @ origin)


Progress = Callable[[int, int], None]  # receives the number of panoramas that are written, and of all


@dataclass(frozen=True)
class Shared:
    """What was written."""

    page: Path  # the page to open, which needs its folder
    single_file: Path | None  # the same as one file; None if it would be too large
    points: int
    panoramas: int
    triangles: int  # number of triangles of the mesh; 0 without one
    total_bytes: int  # size of the data
    notes: tuple[str, ...] = ()  # what is missing

    def _repr_html_(self) -> str:
        """Return the page for a notebook, which keeps it; only where it is if it is too large for one file."""
        if self.single_file is None:
            return f"<p>Open {escape(str(self.page))} in a browser: the page is too large for a notebook.</p>"
        page = self.single_file.read_text(encoding="utf-8")
        # The page cannot reach the notebook from its sandbox.
        return f'<iframe srcdoc="{escape(page)}" sandbox="allow-scripts" width="100%" height="600"></iframe>'


def share_run(
    run: RunOutput | str | Path,
    folder: str | Path,
    options: ShareOptions | None = None,
    *,
    images: str | Path | None = None,
    progress: Progress | None = None,
) -> Shared:
    """Write a page with the cloud, the mesh, the cameras and the panoramas of a run.

    Of several groups of cameras, the largest is shown, or all with the single panoramas if links of a tour say where
    they stand.

    >>> shared = share_run("out", "page")
    >>> shared.page.name, shared.panoramas
    ('index.html', 4)

    Args:
        run: the output of a run, or its folder.
        folder: a new folder, or one that holds an earlier page.
        options: what the page contains.
        images: folder of the panoramas, if they were moved.
        progress: is called after each panorama.

    Raises:
        InputError: if the run has neither a cloud nor cameras, or the rooms cannot be read.
        UsageError: if the folder holds something else, or cannot be written.
        StoreError: if a file cannot be written.
    """
    run, folder, options = run if isinstance(run, RunOutput) else load(run), Path(folder), options or ShareOptions()
    images = Path(images) if images is not None else None
    rooms = given_rooms(options.rooms) if options.rooms is not None else None
    shown = shown_of(
        run,
        with_mesh=bool(options.max_triangles),
        picture=lambda name: _small_image(run, name, images),
    )
    cloud, names = shown.cloud, tuple(camera.name for camera in shown.cameras)
    if not names and (cloud is None or not len(cloud)):
        raise InputError(f"{run.out}: has neither a cloud nor cameras to show. Look at its report.html")
    if (cloud is None or not len(cloud)) and not any(_may_have_image(run, name, images) for name in names):
        raise InputError(
            f"{run.out}: there is neither a cloud nor a panorama to show. Finish the run, or give the folder of the "
            "panoramas with --images DIR"
        )
    notes = [] if run.cloud is not None else ["the run has no cloud; the page shows the panoramas alone"]
    if run.summary.exit_code == INTERRUPTED:
        notes.append("the run was interrupted; the page shows what it had finished")
    notes += shown.notes
    cameras = [camera.cam_from_world for camera in shown.cameras]
    frame = page_from_world(cameras, is_level=shown.is_level)
    page = PageFolder(folder)
    Origin("share", (RunName.of(run.summary),)).write(folder)
    source = resolved(run.summary.source_folder or run.out)
    # The name of the folder of the capture, which may hold its images in `images`; else of the output.
    title = options.title or (source.parent if source.name == "images" else source).name
    scene: dict[str, Any] = {"title": title, "unit": "m" if shown.metric else "units", "ranges": list(RANGES_HW)}
    centers = np.array([frame.apply(camera.center) for camera in cameras]).reshape(-1, 3)
    geometry, more = _put_geometry(page, run, shown, frame=frame, centers=centers, options=options)
    scene |= geometry
    notes += more
    notes += [f"--rooms: {name} matches no panorama of the page" for name in unmatched(names, rooms or {})]
    described, sights = _put_cameras(
        page, run, shown.cameras, frame=frame, options=options, images=images, progress=progress
    )
    for entry, room in zip(described, rooms_of(names, sights, rooms), strict=True):
        entry["room"] = room
    scene["cameras"] = described
    if missing := [entry["name"] for entry in scene["cameras"] if not entry["levels"]]:
        notes.append(
            f"{len(missing)} of {len(cameras)} panoramas could not be read, such as {missing[0]}; give their folder "
            "with --images DIR"
        )
    page.put("scene", scene)
    return Shared(
        folder / "index.html",
        page.finish(title, max_single_file_bytes=options.max_single_file_bytes),
        points=sum(node["count"] for node in scene["nodes"]),
        panoramas=len(cameras) - len(missing),
        triangles=sum(piece["faces"] for piece in scene["mesh"]["pieces"]) if scene["mesh"] else 0,
        total_bytes=sum(page.written.values()),
        notes=tuple(notes),
    )


def _put_geometry(
    page: PageFolder,
    run: RunOutput,
    shown: Shown,
    *,
    frame: Rigid3,
    centers: NDArray[np.float64],
    options: ShareOptions,
) -> tuple[dict[str, Any], list[str]]:
    """Write cloud, mesh and maps; return what the page needs to know of them, and notes."""
    cloud = shown_cloud(shown.cloud, frame, max_points=options.max_points)
    described = put_cloud(page, cloud)
    notes = []
    mesh = shown.mesh
    described["mesh"] = None
    if mesh is not None:
        mesh, note = thinned(mesh, options.max_triangles)
        notes.append(note)
        described["mesh"] = put_mesh(page, mesh.moved(frame), cloud, jpeg_quality=options.jpeg_quality)
    described["outline"] = outline(mesh.moved(frame).vertices if mesh is not None else cloud.cloud.points_in_world)
    plans, note = run_plans(run, frame) if shown.has_plan else ([], "")
    notes.append(note)
    described["maps"] = put_maps(page, cloud, plans, centers=centers)
    return described, [note for note in notes if note]


def _put_cameras(
    page: PageFolder,
    run: RunOutput,
    cameras: Sequence[ShownCamera],
    *,
    frame: Rigid3,
    options: ShareOptions,
    images: Path | None,
    progress: Progress | None,
) -> tuple[list[dict[str, Any]], dict[str, Sight]]:
    """Write the panoramas, and return what the page needs to know of each camera, and what cameras see by name."""
    described: list[dict[str, Any]] = []
    sights = {}
    number = {camera.name: idx for idx, camera in enumerate(cameras)}
    for idx, one in enumerate(cameras):
        name = one.name
        ranges, relative = _ranges_of(run, one)
        image = _image(run, name, images, max_width=options.max_width)
        pose = one.cam_from_world @ frame.inverse()
        probability = run.summary.poses.p_right.get(name)
        judged = (
            {} if probability is None else {"right": share_text(probability), "color": probability_color(probability)}
        )
        camera = put_camera(
            page, idx, ranges=ranges, relative=relative, image=image, cam_from_page=pose, options=options
        )
        placed: dict[str, Any] = {"placed": one.placed} if one.placed else {}
        if one.leads_to is not None:
            placed["leadsTo"] = [number[target] for target in one.leads_to if target in number]
        described.append({"name": name, **judged, **placed, **camera})
        if ranges is not None and one.room is None:
            sights[name] = Sight(pose, ranges)
        if progress is not None:
            progress(idx + 1, len(cameras))
    return described, sights


def _ranges_of(run: RunOutput, camera: ShownCamera) -> tuple[NDArray[np.float32] | None, NDArray[np.float32] | None]:
    """Return the ranges of a panorama in units of the page, at `RANGES_HW`, and their relative deviations, if known."""
    view = run.views.get(camera.name) if camera.scale is not None else None
    if view is not None and view.range_map is not None:
        relative = view.uncertainty
        ranges = reduced(view.range_map) * np.float32(camera.scale or 1.0)
        return ranges, None if relative is None else reduced(relative)
    if camera.room is None:
        return None, None
    return room_map(camera.room, RANGES_HW, camera_height=camera.camera_height)


def _small_image(run: RunOutput, name: str, images: Path | None) -> NDArray[np.uint8] | None:
    image = _image(run, name, images, max_width=_ROOM_WIDTH_PX)
    return None if image is None else reduced_panorama(image, _ROOM_WIDTH_PX)


def _image(run: RunOutput, name: str, images: Path | None, *, max_width: int) -> NDArray[np.uint8] | None:
    """Return a panorama from the given folder, else from where the run found it; None if it is not there.

    What the run found is loaded at the resolution of its file, which may be higher than that of the run.
    """
    panorama = run.values.panorama(name) if images is None else None
    if panorama is not None:
        width = min(panorama.source_size_hw[1], max_width) // 4 * 4
        return replace(panorama, size_hw=(width // 2, width)).load()
    if images is None and (view := run.views.get(name)) is not None:
        return view.image
    path = run.summary.source_file(name, images)
    return decode_image(path) if path is not None else None


def _may_have_image(run: RunOutput, name: str, images: Path | None) -> bool:
    if images is None and (name in run.views or run.values.panorama(name) is not None):
        return True
    return run.summary.source_file(name, images) is not None


_SAMPLED_HW = (16, 32)
_TOLERANCE = 0.1


@dataclass(frozen=True, eq=False)
class Sight:
    """What a panorama saw."""

    cam_from_page: Rigid3  # its pose
    ranges: NDArray[np.float32]  # (H, W) float32; NaN where there is none


def given_rooms(given: Mapping[str, Sequence[str]] | str | Path) -> dict[str, tuple[str, ...]]:
    """Return the names of panoramas, or patterns of them, of each room.

    Args:
        given: these; or a YAML file with the name of each room, and a list such as `[IMG_0001.jpg, kitchen/*]`.

    Raises:
        InputError: if the file cannot be read, or what is given has another layout.
    """
    rooms: object = given
    if isinstance(given, (str, Path)):
        try:
            rooms = parse_yaml(FilePart(Path(given)).read_bytes().decode("utf-8", "replace"), str(given)).plain()
        except WorkflowError as error:
            raise InputError(f"--rooms: {error}") from error
    option = f"--rooms {given}" if isinstance(given, (str, Path)) else "rooms"
    if not isinstance(rooms, Mapping) or not all(isinstance(names, (list, tuple)) for names in rooms.values()):
        raise InputError(f"{option}: give rooms with lists of panoramas, such as `Kitchen: [IMG_0001.jpg]`")
    for room, names in rooms.items():
        for name in names:
            if not isinstance(name, str):
                raise InputError(
                    f"{option}: {room}: {name!r} is not text. Give names of panoramas, in quotes if they look like "
                    "something else"
                )
    return {str(room): tuple(names) for room, names in rooms.items()}


def unmatched(names: Sequence[str], given: Mapping[str, Sequence[str]]) -> list[str]:
    """Return the given names and patterns that match no panorama.

    Args:
        names: paths of the panoramas relative to the capture.
        given: names or patterns of panoramas by room.
    """
    wanted = [each for patterns in given.values() for each in patterns]
    return [each for each in wanted if not any(_matches(name, each) for name in names)]


def _matches(name: str, pattern: str) -> bool:
    return name == pattern or fnmatchcase(name, pattern)


def rooms_of(
    names: Sequence[str], sights: Mapping[str, Sight], given: Mapping[str, Sequence[str]] | None = None
) -> list[str]:
    """Return the room of each panorama; "" where it is not known.

    Rooms are taken from the first of these that distinguishes them: what the user gave; the folders of the panoramas;
    their names, if these are words without digits; and which panoramas see mostly the same surfaces.

    Args:
        names: paths of the panoramas relative to the capture.
        sights: what they saw, by their names; those without ranges may be missing.
        given: names or patterns of panoramas by room.
    """
    if given is not None:
        return [
            next((room for room, patterns in given.items() if any(_matches(name, each) for each in patterns)), "")
            for name in names
        ]
    paths = [PurePosixPath(name) for name in names]
    for told in ([path.parent.name for path in paths], [path.stem.replace("_", " ") for path in paths]):
        if len(set(told)) > 1 and all(name and not any(sign.isdigit() for sign in name) for name in told):
            return told
    known = [name for name in names if name in sights]
    numbers = dict(zip(known, rooms_by_sight([sights[name] for name in known]), strict=True))
    if len(set(numbers.values())) < 2:
        return [""] * len(names)
    return [f"Room {numbers[name]}" if name in numbers else "" for name in names]


def rooms_by_sight(sights: Sequence[Sight]) -> list[int]:
    """Return a number of the room of each panorama, from 1 in the order of their first panoramas.

    Panoramas belong to one room if on average each sees more than half of what the other one sees, in terms of solid
    angle: through a door one sees less. More than 400 panoramas are not divided.
    """
    if not 1 < len(sights) <= 400:  # all pairs are compared
        return [1] * len(sights)
    shared = np.array([[_share(first, second) for second in sights] for first in sights])
    apart = 1 - np.minimum(shared, shared.T)
    np.fill_diagonal(apart, 0)
    labels = scipy.cluster.hierarchy.fcluster(
        scipy.cluster.hierarchy.linkage(scipy.spatial.distance.squareform(apart), "average"), 0.5, "distance"
    ).tolist()
    order = {label: number for number, label in enumerate(dict.fromkeys(labels), 1)}
    return [order[label] for label in labels]


def _share(first: Sight, second: Sight) -> float:
    """Return the part of what the first panorama saw, in solid angle, that the second one saw as well."""
    rays = ray_grid(_SAMPLED_HW)
    ranges = _at(first.ranges, rays)
    points = first.cam_from_page.inverse().apply(ranges[..., None] * rays)
    there = second.cam_from_page.apply(np.nan_to_num(points))
    distances = np.linalg.norm(there, axis=-1)
    known = np.isfinite(ranges) & (distances > 0)
    seen = known & (_at(second.ranges, np.where(known[..., None], there, 1.0)) > (1 - _TOLERANCE) * distances)
    weights = np.broadcast_to(pixel_solid_angle(_SAMPLED_HW)[:, None], known.shape)
    return float(weights[seen].sum() / max(weights[known].sum(), 1e-12))


def _at(ranges: NDArray[np.float32], rays: FloatArray) -> NDArray[np.float32]:
    """Return the ranges of the pixels in which rays arrive."""
    height, width = ranges.shape
    columns, rows = np.moveaxis(np.floor(pixel_from_ray(rays, (height, width))).astype(int), -1, 0)
    return np.asarray(ranges[rows.clip(0, height - 1), columns % width], np.float32)
