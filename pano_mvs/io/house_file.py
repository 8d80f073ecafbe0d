"""Read and write where panoramas stand in a house, as JSON.

    {
      "camera_height": 1.25,
      "panoramas": [
        {"name": "Kitchen.png", "placed_by": "links", "part": 3, "group": null, "scale": 1.0,
         "center": [5.4, 0.0, -0.9], "rotation": [[…], […], […]], "center_std": 1.6, "turn_std_deg": 2.0,
         "links": ["Hallway.png"]},
        …
      ]
    }

The frame and the unit are those of the group of part 0, the largest. `rotation` is that of cam_from_house; `scale` is
the unit of the group's world in units of the house. A deviation that is not known is null.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from pano_mvs.core.errors import ContractError, InputError
from pano_mvs.core.file_names import item_problem
from pano_mvs.geometry import Rigid3
from pano_mvs.scene import FilePart, House

HOUSE_FILE = "house.json"


def house_document(house: House) -> dict[str, Any]:
    """Return a house as a JSON object."""

    def known(value: float) -> float | None:
        return value if np.isfinite(value) else None

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
            camera_height=document["camera_height"],
        )
        house.check()
        for name in (*house.names, *(target for targets in house.links for target in targets)):
            if problem := item_problem(name):
                raise ValueError(problem)
    except (KeyError, TypeError, ValueError, ContractError) as error:
        raise InputError(f"{path}: does not say where panoramas stand in a house ({error}). Run again") from error
    return house


def _number(value: float | None) -> float:
    return np.inf if value is None else float(value)
