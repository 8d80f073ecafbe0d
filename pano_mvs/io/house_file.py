"""Read and write where panoramas stand in a house, as JSON.

    {
      "camera_height": 1.25,
      "panoramas": [
        {"name": "Kitchen.png", "placed_by": "links", "part": 3, "group": null, "scale": 1.0,
         "center": [5.4, 0.0, -0.9], "rotation": [[…], […], […]], "center_std": 1.6, "turn_std_deg": 2.0,
         "links": ["Hallway.png"],
         "room": {"ceiling": 0.62, "wall_deg": 41.2, "rotation": [[…], […], […]],
                  "distances": [1.31, …], "probabilities": [0.92, …]}},
        …
      ]
    }

The frame and the unit are those of the group of part 0, the largest. `rotation` is that of cam_from_house; `scale` is
the unit of the group's world in units of the house. A deviation that is not known is null. `room` is the room around a
panorama by its picture alone, in heights of the camera above the floor, or null: the height of the ceiling above the
camera, an azimuth of a wall, the rotation of cam_from_level, and the level distance of the wall at each degree of
azimuth there, from z towards x, with the probability that it is within 5 % of the truth; both are null where the wall
is not known.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import ContractError, InputError
from pano_mvs.core.file_names import item_problem
from pano_mvs.geometry import Rigid3
from pano_mvs.scene import FilePart, House, RoomOutline

HOUSE_FILE = "house.json"


def house_document(house: House) -> dict[str, Any]:
    """Return a house as a JSON object."""

    def known(value: float) -> float | None:
        return value if np.isfinite(value) else None

    rooms = house.rooms
    return {
        "camera_height": house.camera_height,
        "panoramas": [
            {
                "name": name,
                "placed_by": house.placed_by[idx],
                "part": int(house.parts[idx]),
                "group": int(house.groups[idx]) if house.groups[idx] >= 0 else None,
                "scale": float(house.scales[idx]),
                "center": house.cam_from_house(idx).center.tolist(),
                "rotation": house.rotations[idx].tolist(),
                "center_std": known(float(house.center_stds[idx])),
                "links": list(house.links[idx]),
                "room": _room_document(rooms[name]) if name in rooms else None,
                "turn_std_deg": known(float(np.rad2deg(house.turn_stds_rad[idx]))),
            }
            for idx, name in enumerate(house.names)
        ],
    }


def read_house(path: Path) -> House:
    """Return the house of a file that `house_document` describes.

    Raises:
        InputError: if the file cannot be read, or holds something else.
    """
    try:
        document = json.loads(FilePart(path).read_text())
        rows = document["panoramas"]
        poses = [Rigid3.from_center(np.array(row["rotation"], np.float64), np.array(row["center"])) for row in rows]
        house = House(
            names=tuple(str(row["name"]) for row in rows),
            rotations=np.array([pose.rotation for pose in poses]).reshape(-1, 3, 3),
            translations=np.array([pose.translation for pose in poses]).reshape(-1, 3),
            parts=np.array([row["part"] for row in rows], np.int32),
            groups=np.array([-1 if row["group"] is None else row["group"] for row in rows], np.int32),
            scales=np.array([row["scale"] for row in rows], np.float64),
            placed_by=tuple(str(row["placed_by"]) for row in rows),
            center_stds=np.array([_number(row["center_std"]) for row in rows], np.float64),
            turn_stds_rad=np.deg2rad([_number(row["turn_std_deg"]) for row in rows]).astype(np.float64),
            links=tuple(tuple(map(str, row["links"])) for row in rows),
            camera_height=None if document["camera_height"] is None else float(document["camera_height"]),
        ).with_rooms({str(row["name"]): _room(row["room"]) for row in rows if row.get("room") is not None})
        house.check()
        for name in (*house.names, *(target for targets in house.links for target in targets)):
            if problem := item_problem(name):
                raise ValueError(problem)
    except (KeyError, TypeError, ValueError, OverflowError, ContractError) as error:
        raise InputError(f"{path}: does not say where panoramas stand in a house ({error}). Run again") from error
    return house


def _number(value: float | None) -> float:
    return np.inf if value is None else float(value)


def _room_document(room: RoomOutline) -> dict[str, Any]:
    """Return a room as a JSON object; distances are exact to some percent."""

    def rounded(values: NDArray[np.float32]) -> list[float | None]:
        return [round(value, 4) if np.isfinite(value) else None for value in values.tolist()]

    assert room.wall_rad is not None
    assert room.ceiling is not None
    return {
        "ceiling": round(room.ceiling, 4),
        "distances": rounded(room.distances),
        "probabilities": rounded(room.probabilities),
        "rotation": room.cam_from_level.tolist(),
        "wall_deg": round(float(np.rad2deg(room.wall_rad)), 3),
    }


def _room(document: dict[str, Any]) -> RoomOutline:
    def known(values: list[float | None]) -> NDArray[np.float32]:
        return np.array([np.nan if value is None else value for value in values], np.float32)

    return RoomOutline(
        np.array(document["rotation"], np.float64),
        float(np.deg2rad(document["wall_deg"])),
        float(document["ceiling"]),
        known(document["distances"]),
        known(document["probabilities"]),
    )
