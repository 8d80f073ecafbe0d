"""Export of floor plans."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from pano_mvs.algorithms.points.plan_grid import Extent, Orthophoto, Storey, bar_length, find_storeys
from pano_mvs.api import (
    All,
    Context,
    Files,
    One,
    Params,
    PointCloud,
    Poses,
    RangeMap,
    WorldAxes,
    chunks,
    split_groups,
    stage,
    write_png,
)
from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.paths import children
from pano_mvs.geometry import Rigid3
from pano_mvs.scene.surfaces import Structure
from pano_mvs.scene.upright import world_up, z_up_from_world
from pano_mvs_floor_plan.evidence import CloudViews, Evidence, PlanView, range_view
from pano_mvs_floor_plan.ifc import IFC_REMEDY, BuildingSettings, has_ifcopenshell, write_ifc
from pano_mvs_floor_plan.plan_drawings import (
    DXF_REMEDY,
    DrawnRoom,
    PlanDrawing,
    draw_plan,
    has_ezdxf,
    strip_px,
    svg_text,
    world_file_text,
    write_dxf,
)
from pano_mvs_floor_plan.room_table import write_rooms_csv
from pano_mvs_floor_plan.rooms import Room
from pano_mvs_floor_plan.sheets import SheetSettings, StoreySheet, page_bytes, write_sheets
from pano_mvs_floor_plan.sizes import RoomSize
from pano_mvs_floor_plan.wall_lines import Line
from pano_mvs_floor_plan.walls_and_openings import plan_storey

Points = tuple[FloatArray, FloatArray, NDArray[np.uint8]]

_EDGE_QUANTILE = 0.01
_CEILING_CUT = 0.8  # of the storey's height, above which the plan of the ceiling shows it
_LONGEST_NAME = 40
_MARGIN = 0.03
_MAX_SIDE_PX = 4096


class FloorPlanParams(Params):
    """Settings of export.floor_plan."""

    formats: tuple[Literal["png", "svg", "dxf", "ifc"], ...] = Field(
        default=("png", "svg"),
        min_length=1,
        description="png with world file, svg and dxf of the wall lines, ifc of the building",
    )
    width_px: int = Field(
        default=1600, ge=100, le=_MAX_SIDE_PX, description="longer side of the plan in pixels, if `pixel` is 0"
    )
    pixel: float = Field(default=0.0, ge=0, description="edge of a pixel in scene units; 0: by `width_px`")
    cut: float = Field(default=0.9, gt=0, le=2, description="height of the cut of the orthophoto, in camera heights")
    min_wall_share: float = Field(
        default=0.4,
        gt=0,
        le=1,
        description="share of the height of the room that a wall must show, over 15 % of it along",
    )
    sheets: tuple[Literal["pdf", "svg", "png"], ...] = Field(
        default=("pdf",), description="sheets at a scale, with the sizes of rooms and the plan of the ceiling"
    )
    paper: Literal["a4", "a3", "a2", "a1", "a0", "letter", "tabloid"] = Field(
        default="a4", description="paper of the sheets"
    )
    scale: int = Field(
        default=0, ge=0, le=100_000, description="denominator of the scale of sheets; 0: the largest scale that fits"
    )
    title: str = Field(default="Floor plan", min_length=1, max_length=60, description="title of the sheets")
    room_names: dict[str, str] = Field(
        default={}, description="names of rooms, by the name of an image that was taken in each"
    )
    min_views: int = Field(default=2, ge=0, le=255, description="minimum number of views that agree on a point")

    @field_validator("title")
    @classmethod
    def _is_text(cls, title: str) -> str:
        return shown_text(title)

    @field_validator("room_names")
    @classmethod
    def _are_names(cls, names: dict[str, str]) -> dict[str, str]:
        for name in names.values():
            if len(name) > _LONGEST_NAME:
                raise ValueError(f"the name of a room has at most {_LONGEST_NAME} characters: {name}")
        return {image: shown_text(name) for image, name in names.items()}

    @field_validator("formats")
    @classmethod
    def _can_be_written(cls, formats: tuple[str, ...]) -> tuple[str, ...]:
        if "dxf" in formats and not has_ezdxf():
            raise ValueError(DXF_REMEDY)
        if "ifc" in formats and not has_ifcopenshell():
            raise ValueError(IFC_REMEDY)
        return tuple(dict.fromkeys(formats))


def shown_text(text: str) -> str:
    """Return a text that drawings show, without spaces around it.

    Raises:
        ValueError: if it is empty or has characters that are not shown.
    """
    if not text.strip() or not text.isprintable():
        raise ValueError(f"{text!r} must have letters, and no line breaks or control characters")
    return text.strip()


def plan_memory_bytes(params: FloorPlanParams, inputs: Mapping[str, Any]) -> int:
    """Return the memory for the grids of one storey, for what cameras see, parts of the cloud, and pictures of pages.

    A pixel takes 50 bytes; the photo of each storey's ceiling is kept, 4 bytes a pixel, for up to ten storeys.
    """
    return (
        500_000_000
        + 900_000 * len(inputs["poses"].names)
        + 90 * (_MAX_SIDE_PX if params.pixel else params.width_px) ** 2
        + (page_bytes(params.paper) if params.sheets else 0)
    )


@stage("export.floor_plan", memory=plan_memory_bytes)
def floor_plan(
    cloud: One[PointCloud],
    poses: One[Poses],
    ranges: All[RangeMap] | None,
    planes: One[Structure] | None,
    params: FloorPlanParams,
    ctx: Context,
) -> Files:
    """Write plans of all storeys: floor_plan/storey_0.png with .pgw, storey_0.svg …, and floor_plan.json about them.

    sheets.pdf shows them at a scale, with sizes of rooms and plans of the ceilings; rooms.csv is a table of the rooms.

    Rooms are those in which a camera stands; their outlines are closed, and lie on lines of walls. The PNG shows the
    floor from above, cut below the cameras, with the walls, doors and windows, cameras and a scale bar. The coordinates
    are those of cloud.ply: z up. Without range maps, the cloud alone shows the walls. The cloud is read in chunks:
    memory does not grow with its size. Further groups of poses, each in its own frame, are in floor_plan_1/,
    floor_plan_2/ …
    """
    files: dict[str, Path] = {}
    walls = rooms = storeys = 0
    for number, (group, own) in enumerate(zip(cloud.groups(), split_groups(poses), strict=False)):
        which = f"group {number}: " if poses.other_worlds else ""
        kept = int((group.view_counts >= params.min_views).sum())
        known = ranges if ranges and any(name in ranges for name in own.names) else {}
        if kept < 100 and not known:
            ctx.note(f"{which}no floor plan: {kept} points of the cloud are seen from {params.min_views} views")
            continue
        folder = f"floor_plan_{number}" if number else "floor_plan"
        (ctx.scratch / folder).mkdir()
        plan = _GroupPlan(group, own, params, ranges=known, planes=planes, number=number, folder=ctx.scratch / folder)
        about = plan.write()
        (ctx.scratch / folder / "floor_plan.json").write_text(json.dumps(about, indent=1), encoding="utf-8")
        files |= {f"{folder}/{path.name}": path for path in children(ctx.scratch / folder)}
        for note in plan.notes:
            ctx.note(f"{which}{note}")
        storeys += len(about["storeys"])
        walls += sum(len(entry["walls"]) for entry in about["storeys"])
        rooms += sum(len(entry["rooms"]) for entry in about["storeys"])
    for image in sorted(params.room_names.keys() - set(poses.names)):
        ctx.note(f"room_names: there is no camera {image}")
    ctx.metric("storeys", storeys)
    ctx.metric("rooms", rooms)
    ctx.metric("walls", walls)
    return Files(files)


class _GroupPlan:
    """The plans of one group."""

    def __init__(
        self,
        cloud: PointCloud,
        poses: Poses,
        params: FloorPlanParams,
        *,
        ranges: All[RangeMap],
        planes: Structure | None,
        number: int,
        folder: Path,
    ) -> None:
        self.cloud = cloud
        self.poses = poses
        self.params = params
        self.folder = folder
        self.turn = z_up_from_world(world_up(poses))
        self.centers = poses.centers @ self.turn.T
        self.notes: list[str] = []
        self.known = _lines(planes, number, self.turn)
        self.view = self._views(ranges)

    def write(self) -> dict[str, Any]:
        """Write the files of all storeys, and return what floor_plan.json states."""
        # Copies: parts of arrays would hold all of them.
        views = map(self.view, range(len(self.poses.names)))
        sampled = [(one.points[::16].copy(), one.normals[::16].copy()) for one in views]
        points, normals = (np.concatenate(parts) for parts in zip(*sampled, strict=True))
        storeys = find_storeys(points[:, 2], normals[:, 2], self.centers[:, 2])
        extent = self._extent([points[:, :2] for points, _ in sampled if len(points)])
        entries, sheets = [], []
        for number, storey in enumerate(storeys):
            entry, sheet = self._storey(number, storey, extent)
            entries.append(entry)
            sheets.append(sheet)
        self._write_sheets(entries, sheets)
        if not storeys:
            self.notes.append("no floor plan: no view has confirmed ranges of surfaces")
        if not all(storey.has_floor for storey in storeys):
            self.notes.append("no level surface was found below some cameras: the floor of the plan is a guess")
        return {
            "unit": "metre" if self.poses.metric else "scene unit",
            "frame": f"z up; x_in_plan = file_from_world x_in_world; world: {self.poses.frame}",
            "file_from_world": self.turn.tolist(),
            "storeys": entries,
        }

    def _views(self, ranges: All[RangeMap]) -> Callable[[int], PlanView]:
        """Return a function that loads what a camera sees: its range map, or without any, what the cloud shows."""
        plan_from_world = Rigid3(self.turn, np.zeros(3))
        cams = [self.poses.cam_from_world(idx) @ plan_from_world.inverse() for idx in range(len(self.poses.names))]
        if ranges:
            nothing, nowhere = np.full((1, 2), np.nan), np.zeros((0, 3))
            unseen = np.zeros((1, 2), np.bool_)
            empty = PlanView(np.zeros(3), np.eye(3), nothing, nothing, nothing, unseen, nowhere, nowhere, np.zeros(0))
            names = self.poses.names
            return lambda idx: range_view(ranges[names[idx]], cams[idx]) if names[idx] in ranges else empty
        views = CloudViews(cams)
        for points, normals, _ in self._chunks():
            views.add(points, normals)
        return views.view

    def _chunks(self) -> Iterator[Points]:
        for chunk in chunks(len(self.cloud)):
            kept = self.cloud.view_counts[chunk] >= self.params.min_views
            points = self.cloud.points_in_world[chunk][kept].astype(np.float64) @ self.turn.T
            normals = self.cloud.normals_in_world[chunk][kept].astype(np.float64) @ self.turn.T
            yield points, normals, self.cloud.colors_rgb[chunk][kept]

    def _extent(self, seen_xy: Sequence[FloatArray]) -> Extent:
        """Return an extent with the cameras and most of what each of them sees, (N, 2) each."""
        corners = [np.quantile(xy, [_EDGE_QUANTILE, 1 - _EDGE_QUANTILE], axis=0) for xy in seen_xy]
        places = np.concatenate([self.centers[:, :2], *corners])
        low, high = places.min(axis=0), places.max(axis=0)
        side = max(float((high - low).max()), 1e-6)
        low, high = low - _MARGIN * side, high + _MARGIN * side
        side *= 1 + 2 * _MARGIN
        pixel = self.params.pixel or side / self.params.width_px
        if side / pixel > _MAX_SIDE_PX:
            pixel = side / _MAX_SIDE_PX
            self.notes.append(f"pixels of {self.params.pixel:g} would be too many; the plan has pixels of {pixel:.3g}")
        columns, rows = np.maximum(1, np.ceil((high - low) / pixel)).astype(int).tolist()
        return Extent(float(low[0]), float(high[1]), pixel, (rows, columns))

    def _write_sheets(self, entries: Sequence[dict[str, Any]], sheets: Sequence[StoreySheet]) -> None:
        """Write the sheets and the table of rooms of all storeys, and enter their names."""
        write_rooms_csv(self.folder / "rooms.csv", sheets, is_metric=self.poses.metric)
        has_north = self.poses.axes is WorldAxes.NORTH
        if "ifc" in self.params.formats and not any(sheet.plan.rooms for sheet in sheets):
            self.notes.append("no plan.ifc: no room was found")
        elif "ifc" in self.params.formats and self.poses.metric:
            key = "/".join([self.params.title, *sorted(self.poses.names)])
            settings = BuildingSettings(self.params.title, key, has_north=has_north, origin_lla=self.poses.origin_lla)
            write_ifc(self.folder / "plan.ifc", sheets, settings)
        elif "ifc" in self.params.formats:
            self.notes.append("no plan.ifc: lengths of a building are in metres, and the scale is not known")
        if not self.params.sheets:
            return
        sheet_settings = SheetSettings(
            self.params.title,
            is_metric=self.poses.metric,
            source=self.poses.scale,
            has_north=has_north,
            paper=self.params.paper,
            scale=self.params.scale,
        )
        files, notes = write_sheets(self.folder, sheets, sheet_settings, self.params.sheets)
        self.notes += notes
        for entry, sheet in zip(entries, sheets, strict=True):
            entry |= files.get(sheet.name, {})

    def _storey(self, number: int, storey: Storey, extent: Extent) -> tuple[dict[str, Any], StoreySheet]:
        """Write the drawings of one storey, and return its entry in floor_plan.json, and what its sheets show."""
        heights = self.centers[list(storey.cameras), 2]
        eyes = float(np.median(heights)) if len(heights) else storey.ceiling
        photo = Orthophoto(storey, extent, cut=storey.floor + self.params.cut * (eyes - storey.floor))
        above = Orthophoto(storey, extent, cut=storey.floor + _CEILING_CUT * storey.height, from_below=True)
        for points, _, colors in self._chunks():
            photo.add(points, colors)
            above.add(points, colors)
        side = extent.pixel * max(extent.size_hw)
        evidence = Evidence(storey, extent.with_pixel(max(storey.height / 80, side / 1500)))
        for idx in storey.cameras:
            evidence.add(self.view(idx))
        cameras = self.centers[list(storey.cameras), :2]
        plan = plan_storey(
            evidence,
            self.known,
            views=lambda: map(self.view, storey.cameras),
            cameras=cameras,
            min_share=self.params.min_wall_share,
        )
        places = self.centers[:, :2].tolist()
        names = {self.poses.names[idx]: (places[idx][0], places[idx][1]) for idx in storey.cameras}
        rows, columns = extent.size_hw
        width, height = columns * extent.pixel, rows * extent.pixel
        bar = bar_length(width)
        unit = "m" if self.poses.metric else "scene unit" if bar == 1 else "scene units"
        box = ((extent.left, extent.top - height), (extent.left + width, extent.top))
        drawing = PlanDrawing(
            f"storey {number}",
            np.array([wall.ends for wall in plan.walls]).reshape(-1, 2, 2),
            plan.solids,
            [(opening.kind, opening.ends) for opening in plan.openings],
            [
                DrawnRoom(room.outline, self._room_text(size), room.label_xy)
                for room, size in zip(plan.rooms, plan.sizes, strict=True)
            ],
            names,
            box,
            bar,
            unit,
            self.poses.metric,
        )
        files = self._write_files(f"storey_{number}", photo, drawing)
        room_names = self._room_names(plan.rooms, names)
        sheet = StoreySheet(
            f"storey_{number}",
            f"storey {number}",
            storey.floor,
            storey.height,
            plan,
            room_names,
            cameras,
            *above.picture(),
            extent,
        )
        return {
            **files,
            "z_range": [storey.floor, storey.ceiling],
            "has_floor": storey.has_floor,
            "has_ceiling": storey.has_ceiling,
            "units_per_pixel": extent.pixel,
            "metres_per_pixel": extent.pixel if self.poses.metric else None,
            "origin_xy": [extent.left, extent.top],
            "size_px": [extent.size_hw[1], extent.size_hw[0] + strip_px(extent.size_hw)],
            "plan_size_px": [extent.size_hw[1], extent.size_hw[0]],
            "rooms": [
                {
                    "name": name,
                    "outline": room.outline.tolist(),
                    "holes": [hole.tolist() for hole in room.holes],
                    "area": room.area,
                    "area_std": _known(size.area.std),
                    "lengths": [side.value for side in size.sides],
                    "length_stds": [_known(side.std) for side in size.sides],
                    "size": [_known(size.length.value), _known(size.width.value)],
                    "size_stds": [_known(size.length.std), _known(size.width.std)],
                    "is_closed": size.is_closed,
                    "is_rectangle": size.is_rectangle,
                    "height": _known(size.height.value),
                    "height_std": _known(size.height.std),
                }
                for room, size, name in zip(plan.rooms, plan.sizes, room_names, strict=True)
            ],
            "walls": [
                {"ends": wall.ends.tolist(), "room": wall.room, "thickness": wall.thickness} for wall in plan.walls
            ],
            "openings": [
                {
                    "kind": opening.kind,
                    "ends": opening.ends.tolist(),
                    "width": opening.width,
                    "bottom": opening.bottom,
                    "top": opening.top,
                    "rooms": list(opening.rooms),
                    "leaf": opening.leaf and {name: xy.tolist() for name, xy in vars(opening.leaf).items()},
                }
                for opening in plan.openings
            ],
            "cameras": {name: list(place) for name, place in names.items()},
        }, sheet

    def _room_text(self, size: RoomSize) -> list[str]:
        """Return what the drawings state of a room; nothing without a unit that one knows."""
        if not self.poses.metric:
            return []
        return [f"{size.area.value:.1f} m²", f"{size.extent_text} m"]

    def _room_names(self, rooms: Sequence[Room], cameras: Mapping[str, tuple[float, float]]) -> list[str]:
        """Return the names that the settings give rooms by panoramas in them, or else their numbers."""
        names: dict[int, str] = {}
        for image, name in self.params.room_names.items():
            if image in cameras:
                place = np.array([cameras[image]])
                room = next((idx for idx, one in enumerate(rooms) if one.contains(place)[0]), None)
                if room is None:
                    self.notes.append(f"room_names: {image} is in no room that was found")
                elif names.setdefault(room, name) != name:
                    self.notes.append(f"room_names: {image} is in the room {names[room]}, which it would call {name}")
        return [names.get(idx, f"Room {idx + 1}") for idx in range(len(rooms))]

    def _write_files(self, stem: str, photo: Orthophoto, drawing: PlanDrawing) -> dict[str, str]:
        """Write the files of a storey in all formats, and return their names."""
        files: dict[str, str] = {}
        extent = photo.extent
        if "png" in self.params.formats:
            files |= {"png": f"{stem}.png", "world_file": f"{stem}.pgw"}
            write_png(self.folder / files["png"], draw_plan(*photo.picture(), drawing))
            text = world_file_text(extent.pixel, extent.left, extent.top)
            (self.folder / files["world_file"]).write_text(text, encoding="ascii")
        if "svg" in self.params.formats:
            files["svg"] = f"{stem}.svg"
            (self.folder / files["svg"]).write_text(svg_text(drawing), encoding="utf-8")
        if "dxf" in self.params.formats:
            files["dxf"] = f"{stem}.dxf"
            write_dxf(self.folder / files["dxf"], drawing)
        return files


def _known(value: float) -> float | None:
    return None if np.isnan(value) else value


def _lines(planes: Structure | None, group: int, turn: FloatArray) -> list[Line]:
    """Return the lines of the upright planes of a group, in the plan."""
    if planes is None:
        return []
    upright = (planes.group_idx == group) & (np.abs(planes.normals_in_world[:, 1]) < 0.5)
    normals = (planes.normals_in_world[upright] @ turn.T)[:, :2]
    lengths = np.linalg.norm(normals, axis=1)
    return [
        Line(normal / length, float(offset / length))
        for normal, length, offset in zip(normals, lengths, planes.offsets[upright], strict=True)
    ]
