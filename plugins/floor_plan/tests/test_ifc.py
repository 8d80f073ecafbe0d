"""Building models, as another library reads them."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import ifcopenshell
import numpy as np
import pytest
from ifcopenshell import geom
from ifcopenshell.util import element, placement, shape
from ifcopenshell.validate import json_logger, validate
from pano_mvs_floor_plan.door_leaves import DoorLeaf
from pano_mvs_floor_plan.ifc import BuildingSettings, write_ifc
from pano_mvs_floor_plan.rooms import Room
from pano_mvs_floor_plan.sheets import StoreySheet
from pano_mvs_floor_plan.sizes import Measure, RoomSize
from pano_mvs_floor_plan.stages import FloorPlanParams
from pano_mvs_floor_plan.walls_and_openings import Opening, StoreyPlan, WallBody

from pano_mvs.algorithms.points.plan_grid import Extent
from pano_mvs.core.arrays import FloatArray

SETTINGS = BuildingSettings("The flat", "a.jpg/b.jpg", has_north=True, origin_lla=(-33.5, 151.2, 12.0))


def rectangle(x0: float, y0: float, x1: float, y1: float) -> FloatArray:
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])


def a_room(outline: FloatArray, area: float, *, height: float = 2.5) -> tuple[Room, RoomSize]:
    one = Measure(1.0, 0.01)
    size = RoomSize(one, one, np.array([1.0, 0.0]), is_closed=True, is_rectangle=True, area=Measure(area, 0.1),
                    perimeter=14.0, height=Measure(height, 0.02), sides=[one] * 4)  # fmt: skip
    return Room(outline, [], area, outline.mean(axis=0)), size


def the_sheet(*, leaf: DoorLeaf | None = None, height: float = 2.5, floor: float = 0.4) -> StoreySheet:
    """Two rooms beside each other with a wall of .2 m and a door between them, and a window in the first one."""
    rooms = [a_room(rectangle(0, 0, 4, 3), 12.0, height=height), a_room(rectangle(4.2, 0, 7.2, 3), 9.0)]
    door = Opening(np.array([[4.1, 1.0], [4.1, 1.9]]), "door", 0.0, 2.0, (0, 1), 0.2, leaf)
    window = Opening(np.array([[1.0, 0.0], [2.5, 0.0]]), "window", 0.9, 2.1, (0,), None)
    bodies = [
        WallBody(np.array([[4.0, 0.0], [4.0, 3.0]]), 0.2, (0, 1)),
        WallBody(np.array([[0.0, 0.0], [4.0, 0.0]]), None, (0,)),
    ]
    plan = StoreyPlan([room for room, _ in rooms], [size for _, size in rooms], [], [door, window], [], bodies)
    blank = np.zeros((4, 4, 3), np.uint8), np.zeros((4, 4), np.bool_)
    return StoreySheet("storey_0", "storey 0", floor, 2.5, plan, ["Kitchen", "Room 2"], np.zeros((0, 2)), *blank,
                       Extent(0, 0, 1, (4, 4)))  # fmt: skip


def written(folder: Path, *sheets: StoreySheet, settings: BuildingSettings = SETTINGS) -> Any:
    write_ifc(folder / "plan.ifc", sheets, settings)
    return ifcopenshell.open(folder / "plan.ifc")


def volume(product: Any) -> float:
    options: Any = geom.settings()  # type: ignore[no-untyped-call]
    drawn: Any = geom.create_shape(options, product)
    return float(shape.get_volume(drawn.geometry))


@pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning")  # of ifcopenshell's own rules
@pytest.mark.slow
def test_the_model_is_valid_and_holds_rooms_walls_and_openings(tmp_path: Path) -> None:
    model = written(tmp_path, the_sheet())
    logger: Any = json_logger()  # type: ignore[no-untyped-call]
    validate(model, logger, express_rules=True)
    assert logger.statements == []
    (storey,) = model.by_type("IfcBuildingStorey")
    assert storey.Elevation == pytest.approx(0.4)
    spaces = {space.LongName: space for space in model.by_type("IfcSpace")}
    assert set(spaces) == {"Kitchen", "Room 2"}
    assert volume(spaces["Kitchen"]) == pytest.approx(4 * 3 * 2.5)
    assert placement.get_local_placement(spaces["Kitchen"].ObjectPlacement)[2, 3] == pytest.approx(0.4)
    sets = element.get_psets(spaces["Kitchen"])
    assert sets["Qto_SpaceBaseQuantities"]["NetFloorArea"] == 12
    assert sets["Qto_SpaceBaseQuantities"]["NetVolume"] == pytest.approx(30)
    assert sets["pano_mvs"]["NetFloorAreaStandardDeviation"] == pytest.approx(0.1)
    between, outer = model.by_type("IfcWall")
    assert volume(between) == pytest.approx(0.2 * (3 * 2.5 - 0.9 * 2.0), rel=1e-3)
    assert volume(outer) == pytest.approx(0.01 * (4 * 2.5 - 1.5 * 1.2), rel=1e-3)
    assert element.get_psets(between)["pano_mvs"]["ThicknessIsKnown"] is True
    assert element.get_psets(outer)["pano_mvs"]["ThicknessIsKnown"] is False
    assert "Qto_WallBaseQuantities" not in element.get_psets(outer)
    (door,), (window,) = model.by_type("IfcDoor"), model.by_type("IfcWindow")
    assert (door.OverallWidth, door.OverallHeight) == pytest.approx((0.9, 2.0))
    assert (window.OverallWidth, window.OverallHeight) == pytest.approx((1.5, 1.2))
    assert placement.get_local_placement(window.ObjectPlacement)[2, 3] == pytest.approx(0.4 + 0.9)
    assert door.FillsVoids[0].RelatingOpeningElement.VoidsElements[0].RelatingBuildingElement == between
    found: Any = element.get_decomposition(storey)
    assert {one.is_a() for one in found} >= {"IfcWall", "IfcDoor", "IfcWindow", "IfcSpace"}
    (site,) = model.by_type("IfcSite")
    assert site.RefLatitude == (-33, -30, 0, 0)
    assert site.RefLongitude == (151, 12, 0, 0)
    assert site.RefElevation == 12


@pytest.mark.parametrize("into", [1.0, -1.0])
@pytest.mark.parametrize("hinged_at", [1.0, 1.9])
def test_a_leaf_that_was_seen_has_its_swing(tmp_path: Path, into: float, hinged_at: float) -> None:
    """The leaf opens into the second room (+x) or the first one; who looks there has +y on the left or on the right."""
    face = 4.1 + into * 0.1
    hinge, other = np.array([face, hinged_at]), np.array([face, 2.9 - hinged_at])
    leaf = DoorLeaf(hinge, hinge + np.array([into * 0.9, 0.0]), other)
    model = written(tmp_path, the_sheet(leaf=leaf))  # which must outlive what is read from it
    (door,) = model.by_type("IfcDoor")
    is_left = (hinged_at > 1.5) == (into > 0)
    assert door.OperationType == ("SINGLE_SWING_LEFT" if is_left else "SINGLE_SWING_RIGHT")
    place = placement.get_local_placement(door.ObjectPlacement)
    np.testing.assert_allclose(place[:3, 1], [into, 0, 0], atol=1e-6)  # the way through
    np.testing.assert_allclose(place[:3, 3], [4.1, 1.9 if into > 0 else 1.0, 0.4], atol=1e-6)
    assert volume(door) == pytest.approx(0.9 * 2.0 * 0.04)
    (between, _) = model.by_type("IfcWall")
    assert volume(between) == pytest.approx(0.2 * (3 * 2.5 - 0.9 * 2.0), rel=1e-3)


def test_a_wide_opening_without_a_leaf_is_a_passage(tmp_path: Path) -> None:
    sheet = the_sheet()
    wide = replace(sheet.plan.openings[0], ends=np.array([[4.1, 0.5], [4.1, 2.5]]))
    model = written(tmp_path, replace(sheet, plan=replace(sheet.plan, openings=[wide])))
    assert not model.by_type("IfcDoor")
    (between, _) = model.by_type("IfcWall")
    assert volume(between) == pytest.approx(0.2 * (3 * 2.5 - 2.0 * 2.0), rel=1e-3)


def test_what_a_room_goes_around_is_not_in_its_space(tmp_path: Path) -> None:
    sheet = the_sheet()
    pillar = replace(sheet.plan.rooms[0], holes=[rectangle(1, 1, 1.5, 1.5)[::-1]])
    model = written(tmp_path, replace(sheet, plan=replace(sheet.plan, rooms=[pillar, sheet.plan.rooms[1]])))
    space = next(one for one in model.by_type("IfcSpace") if one.LongName == "Kitchen")
    assert volume(space) == pytest.approx((12 - 0.25) * 2.5)


def test_what_is_not_known_is_not_stated(tmp_path: Path) -> None:
    model = written(tmp_path, the_sheet(height=np.nan), settings=replace(SETTINGS, origin_lla=None, has_north=False))
    (door,) = model.by_type("IfcDoor")
    assert (door.OperationType, door.Representation) == ("NOTDEFINED", None)
    assert element.get_psets(door)["pano_mvs"]["LeafWasSeen"] is False
    space = next(one for one in model.by_type("IfcSpace") if one.LongName == "Kitchen")
    sets = element.get_psets(space)
    assert sets["pano_mvs"]["HeightIsKnown"] is False
    assert not {"NetVolume", "FinishCeilingHeight"} & set(sets["Qto_SpaceBaseQuantities"])
    (site,) = model.by_type("IfcSite")
    assert (site.RefLatitude, site.RefElevation) == (None, None)
    context = next(one for one in model.by_type("IfcGeometricRepresentationContext") if one.ContextType == "Model")
    assert context.TrueNorth is None


def test_the_same_plan_gives_the_same_bytes_and_another_one_other_identifiers(tmp_path: Path) -> None:
    for name in "ab":
        (tmp_path / name).mkdir()
    first, second = (written(tmp_path / name, the_sheet()) for name in "ab")
    assert (tmp_path / "a/plan.ifc").read_bytes() == (tmp_path / "b/plan.ifc").read_bytes()
    other = written(tmp_path, the_sheet(), settings=replace(SETTINGS, key="c.jpg"))
    own = {one.GlobalId for one in first.by_type("IfcRoot")}
    assert len(own) == len(second.by_type("IfcRoot"))
    assert not own & {one.GlobalId for one in other.by_type("IfcRoot")}


def test_ifc_needs_ifcopenshell(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ifcopenshell", None)
    with pytest.raises(ValueError, match=r"pip install 'pano-mvs\[ifc\]'"):
        FloorPlanParams(formats=("ifc",))


def test_storeys_stand_above_each_other(tmp_path: Path) -> None:
    upper = replace(the_sheet(floor=3.2), name="storey_1", title="storey 1")
    model = written(tmp_path, the_sheet(floor=0.0), upper)
    assert [one.Elevation for one in model.by_type("IfcBuildingStorey")] == pytest.approx([0, 3.2])
    assert len({one.GlobalId for one in model.by_type("IfcRoot")}) == len(model.by_type("IfcRoot"))
    assert len(model.by_type("IfcBuilding")[0].IsDecomposedBy[0].RelatedObjects) == 2
