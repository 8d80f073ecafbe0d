"""Plans as building models: storeys, spaces, walls, doors and windows in an IFC4 file.

The schema: https://standards.buildingsmart.org/IFC/RELEASE/IFC4/ADD2_TC1/HTML/
"""

from __future__ import annotations

import importlib.util
import uuid
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.errors import UsageError
from pano_mvs_floor_plan.door_leaves import DoorLeaf
from pano_mvs_floor_plan.sheets import StoreySheet
from pano_mvs_floor_plan.sizes import volume_of
from pano_mvs_floor_plan.walls_and_openings import Opening, WallBody

if TYPE_CHECKING:
    import ifcopenshell

IFC_REMEDY = "IFC files need the package ifcopenshell: pip install 'pano-mvs[ifc]'"

_UNKNOWN_THICKNESS = 0.01  # metres, of the body that stands for a wall of which one side was seen
_MARGIN = 0.05  # metres, by which the volume of an opening goes beyond its wall
_WIDEST_DOOR = 0.5  # of the storey's height; wider openings without a leaf are passages
_LEAF, _PANE = 0.04, 0.02  # metres, thickness of what is drawn in openings
_DIGITS, _ANGLE_DIGITS = 4, 6  # of lengths in metres, and of unit vectors
_NAMESPACE = uuid.UUID("5f0c7d0e-3a5e-4d0b-9b39-6f2b1a0c9d51")


@dataclass(frozen=True)
class BuildingSettings:
    """What a building model states.

    Attributes:
        title: name of the project.
        key: text from which identifiers are made; the same for a newer model of the same place.
        has_north: whether +y is north.
        origin_lla: latitude (deg), longitude (deg) and altitude (m) of the origin; None if unknown.
    """

    title: str
    key: str
    has_north: bool
    origin_lla: tuple[float, float, float] | None


def has_ifcopenshell() -> bool:
    """Return whether IFC files can be written."""
    return importlib.util.find_spec("ifcopenshell") is not None


def write_ifc(path: Path, storeys: Sequence[StoreySheet], settings: BuildingSettings) -> None:
    """Write the storeys of a plan with rooms in metres, z up, as a building.

    Rooms are spaces with their quantities; walls have their openings, and these their windows and doors. A wall of
    which one side was seen is 1 cm thick, and its properties say that the thickness is not known. The same plan gives
    the same bytes.

    Raises:
        UsageError: if ifcopenshell is not installed.
    """
    if not has_ifcopenshell():
        raise UsageError(IFC_REMEDY)
    building = _Building(settings)
    for storey in storeys:
        building.add(storey)
    building.write(path)


class _Building:
    """A model that grows storey by storey."""

    def __init__(self, settings: BuildingSettings) -> None:
        import ifcopenshell

        self._settings = settings
        self._model: ifcopenshell.file = ifcopenshell.file(schema="IFC4")
        self._origin = self._placement(None, (0.0, 0.0, 0.0))
        north = self._new("IfcDirection", (0.0, 1.0)) if settings.has_north else None
        axes = self._new("IfcAxis2Placement3D", self._point(0.0, 0.0, 0.0))
        context = self._new("IfcGeometricRepresentationContext", None, "Model", 3, 1e-5, axes, north)
        self._context = self._new(
            "IfcGeometricRepresentationSubContext", "Body", "Model", None, None, None, None, context, None,
            "MODEL_VIEW", None,
        )  # fmt: skip
        units = [
            self._new("IfcSIUnit", None, kind, None, name)
            for kind, name in (
                ("LENGTHUNIT", "METRE"),
                ("AREAUNIT", "SQUARE_METRE"),
                ("VOLUMEUNIT", "CUBIC_METRE"),
                ("PLANEANGLEUNIT", "RADIAN"),
            )
        ]
        project = self._root("IfcProject", "project", settings.title, None, None, None, None, [context],
                             self._new("IfcUnitAssignment", units))  # fmt: skip
        lla = settings.origin_lla
        where = (_degrees(lla[0]), _degrees(lla[1]), float(lla[2])) if lla else (None, None, None)
        site = self._root("IfcSite", "site", "Site", None, None, self._origin, None, None, "ELEMENT", *where)
        self._building = self._root("IfcBuilding", "building", settings.title, None, None,
                                    self._placement(self._origin, (0.0, 0.0, 0.0)), None, None, "ELEMENT")  # fmt: skip
        self._aggregate("project", project, [site])
        self._aggregate("site", site, [self._building])
        self._storeys: list[Any] = []

    def write(self, path: Path) -> None:
        """Write the file, without a date or versions, which would change its bytes."""
        if self._storeys:
            self._aggregate("building", self._building, self._storeys)
        header = self._model.header
        header.file_description.description = ("ViewDefinition [DesignTransferView_V1.0]",)
        header.file_name.name = path.name
        header.file_name.time_stamp = "1970-01-01T00:00:00"
        header.file_name.preprocessor_version = header.file_name.originating_system = "pano_mvs"
        self._model.write(str(path))

    def add(self, sheet: StoreySheet) -> None:
        """Add a storey."""
        plan, name, low = sheet.plan, sheet.name, sheet.floor
        place = self._placement(self._origin, (0.0, 0.0, low))
        storey = self._root(
            "IfcBuildingStorey", name, sheet.title, None, None, place, None, None, "ELEMENT", _rounded(low)
        )
        self._storeys.append(storey)
        spaces = []
        for number, (room, size, title) in enumerate(zip(plan.rooms, plan.sizes, sheet.room_names, strict=True)):
            is_known = not np.isnan(size.height.value)
            shape = self._extruded(
                room.outline, height=size.height.value if is_known else sheet.height, holes=room.holes
            )
            key = f"{name}/space/{number}"
            own = self._placement(place, (0.0, 0.0, 0.0))
            space = self._root("IfcSpace", key, title, None, None, own, shape, title, "ELEMENT", "INTERNAL")
            spaces.append(space)
            volume = volume_of(size)
            heights = [
                ("IfcQuantityLength", "FinishCeilingHeight", size.height.value),
                ("IfcQuantityVolume", "NetVolume", volume.value),
            ]
            heights = [one for one in heights if not np.isnan(one[2])]
            self._quantities(key, space, "Qto_SpaceBaseQuantities", [
                ("IfcQuantityArea", "NetFloorArea", size.area.value),
                ("IfcQuantityLength", "NetPerimeter", size.perimeter),
                *heights,
            ])  # fmt: skip
            known = {"Length": size.length, "Width": size.width, "NetFloorArea": size.area,
                     "FinishCeilingHeight": size.height, "NetVolume": volume}  # fmt: skip
            self._properties(key, space, {
                "HeightIsKnown": is_known,
                "WallsSeenOnAllSides": size.is_closed,
                **{which: one.value for which, one in list(known.items())[:2] if not np.isnan(one.value)},
                **{f"{which}StandardDeviation": one.std for which, one in known.items() if not np.isnan(one.std)},
            })  # fmt: skip
        if spaces:
            self._aggregate(name, storey, spaces)
        elements: list[Any] = []
        for number, body in enumerate(plan.bodies):
            elements += self._wall(f"{name}/wall/{number}", body, sheet, place=place)
        if elements:
            self._root("IfcRelContainedInSpatialStructure", f"{name}/contained", None, None, elements, storey)

    def _wall(self, key: str, body: WallBody, sheet: StoreySheet, *, place: Any) -> list[Any]:
        """Add a wall with what is in it, and return what its storey contains."""
        thickness = body.thickness or _UNKNOWN_THICKNESS
        footprint = np.concatenate([body.ends, body.ends[::-1] + thickness * body.back])[::-1]
        shape = self._extruded(footprint, height=sheet.height)
        own = self._placement(place, (0.0, 0.0, 0.0))
        wall = self._root("IfcWall", key, f"Wall {key.rpartition('/')[2]}", None, None, own, shape, None, "NOTDEFINED")
        self._properties(key, wall, {"ThicknessIsKnown": body.thickness is not None})
        if body.thickness is not None:
            self._quantities(key, wall, "Qto_WallBaseQuantities", [("IfcQuantityLength", "Width", body.thickness)])
        elements = [wall]
        for number, opening in enumerate(sheet.plan.openings_of(body)):
            hole = self._hole(f"{key}/{number}", opening, body, place=place)
            self._root("IfcRelVoidsElement", f"{key}/{number}/voids", None, None, wall, hole)
            if opening.leaf or opening.kind == "window" or opening.width < _WIDEST_DOOR * sheet.height:
                elements.append(self._filling(f"{key}/{number}", opening, hole))
        return elements

    def _hole(self, key: str, opening: Opening, body: WallBody, *, place: Any) -> Any:
        """Add an opening, whose y axis is the way through it, for a door to the side on which its leaf opens."""
        thickness = body.thickness or _UNKNOWN_THICKNESS
        through = body.back
        if opening.leaf and (opening.leaf.open_end - opening.leaf.hinge) @ through < 0:
            through = -through
        right = np.array([through[1], -through[0]])
        corner = min(opening.ends, key=lambda end: float(end @ right))
        if body.thickness is None:  # from the side that was seen into the middle
            corner = corner + thickness / 2 * body.back
        own = self._placement(place, (*corner, opening.bottom), right=right)
        deep = thickness + 2 * _MARGIN
        shape = self._box(opening, deep)
        return self._root("IfcOpeningElement", f"{key}/hole", "Opening", None, None, own, shape, None, "OPENING")

    def _box(self, opening: Opening, deep: float) -> Any:
        """Return the shape of what is as wide and as high as an opening, from its left edge on."""
        half, wide = deep / 2, opening.width
        outline = np.array([[0.0, -half], [wide, -half], [wide, half], [0.0, half]])
        return self._extruded(outline, height=opening.top - opening.bottom)

    def _filling(self, key: str, opening: Opening, hole: Any) -> Any:
        """Add the window or the door in an opening."""
        inside = self._placement(hole.ObjectPlacement, (0.0, 0.0, 0.0))
        sizes = (_rounded(opening.top - opening.bottom), _rounded(opening.width))
        if opening.kind == "window":
            shape = self._box(opening, _PANE)
            filling = self._root("IfcWindow", key, "Window", None, None, inside, shape, None, *sizes, "WINDOW")
        else:
            # What closes it is only shown where it was seen.
            shape = self._box(opening, _LEAF) if opening.leaf else None
            kind = ("DOOR", _swing(opening.leaf)) if opening.leaf else ("NOTDEFINED", "NOTDEFINED")
            filling = self._root("IfcDoor", key, "Door", None, None, inside, shape, None, *sizes, *kind)
            self._properties(key, filling, {"LeafWasSeen": opening.leaf is not None})
        self._root("IfcRelFillsElement", f"{key}/fills", None, None, hole, filling)
        return filling

    def _new(self, kind: str, *values: Any) -> Any:
        return self._model.create_entity(kind, *values)

    def _root(self, kind: str, key: str, *values: Any) -> Any:
        """Add an object with an identifier that its key tells; its values follow the owner history."""
        from ifcopenshell import guid

        unique = uuid.uuid5(_NAMESPACE, f"{self._settings.key}/{kind}/{key}")
        return self._new(kind, guid.compress(unique.hex), None, *values)

    def _aggregate(self, key: str, whole: Any, parts: Sequence[Any]) -> None:
        self._root("IfcRelAggregates", key, None, None, whole, list(parts))

    def _properties(self, key: str, owner: Any, values: dict[str, bool | float]) -> None:
        properties = [
            self._new("IfcPropertySingleValue", name, None,
                      self._new("IfcBoolean", value) if isinstance(value, bool) else
                      self._new("IfcReal", _rounded(value)), None)
            for name, value in values.items()
        ]  # fmt: skip
        group = self._root("IfcPropertySet", f"{key}/properties", "pano_mvs", None, properties)
        self._root("IfcRelDefinesByProperties", f"{key}/properties", None, None, [owner], group)

    def _quantities(self, key: str, owner: Any, name: str, values: Sequence[tuple[str, str, float]]) -> None:
        quantities = [self._new(kind, which, None, None, _rounded(value)) for kind, which, value in values]
        group = self._root("IfcElementQuantity", f"{key}/quantities", name, None, None, quantities)
        self._root("IfcRelDefinesByProperties", f"{key}/quantities", None, None, [owner], group)

    def _point(self, *values: float) -> Any:
        return self._new("IfcCartesianPoint", tuple(_rounded(value) for value in values))

    def _placement(self, within: Any, origin: tuple[float, float, float], *, right: FloatArray | None = None) -> Any:
        """Return a place within another one, with z up and x to the right, as there by default."""
        turn = []
        if right is not None:
            directions = ((0.0, 0.0, 1.0), (*(round(float(one), _ANGLE_DIGITS) + 0.0 for one in right), 0.0))
            turn = [self._new("IfcDirection", direction) for direction in directions]
        return self._new("IfcLocalPlacement", within, self._new("IfcAxis2Placement3D", self._point(*origin), *turn))

    def _extruded(self, outline: FloatArray, *, height: float, holes: Sequence[FloatArray] = ()) -> Any:
        """Return the shape of an outline (N, 2), counter-clockwise, that goes up by a height."""
        curves = [
            self._new("IfcPolyline", [*(corners := [self._point(*xy) for xy in one.tolist()]), corners[0]])
            for one in (outline, *holes)
        ]
        kind = "IfcArbitraryProfileDefWithVoids" if holes else "IfcArbitraryClosedProfileDef"
        profile = self._new(kind, "AREA", None, curves[0], *([curves[1:]] if holes else []))
        axes = self._new("IfcAxis2Placement3D", self._point(0.0, 0.0, 0.0))
        up = self._new("IfcDirection", (0.0, 0.0, 1.0))
        solid = self._new("IfcExtrudedAreaSolid", profile, axes, up, max(_rounded(height), 10.0**-_DIGITS))
        shape = self._new("IfcShapeRepresentation", self._context, "Body", "SweptSolid", [solid])
        return self._new("IfcProductDefinitionShape", None, None, [shape])


def _rounded(value: float) -> float:
    return round(float(value), _DIGITS) + 0.0


def _swing(leaf: DoorLeaf) -> str:
    """Return on which side a leaf is hinged for one who looks towards the side on which it opens."""
    closed, opened = leaf.closed_end - leaf.hinge, leaf.open_end - leaf.hinge
    is_left = closed[0] * opened[1] - closed[1] * opened[0] > 0
    return "SINGLE_SWING_LEFT" if is_left else "SINGLE_SWING_RIGHT"


def _degrees(angle: float) -> tuple[int, int, int, int]:
    """Return an angle as degrees, minutes, seconds and millionths of a second, all of its sign."""
    sign, left = (-1 if angle < 0 else 1), round(abs(angle) * 3600e6)
    seconds, millionths = divmod(left, 1_000_000)
    minutes, seconds = divmod(seconds, 60)
    degrees, minutes = divmod(minutes, 60)
    return sign * degrees, sign * minutes, sign * seconds, sign * millionths
