"""The floor plans that a run exported (`export.floor_plan`), as maps of the page."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import InputError
from pano_mvs.core.file_names import path_inside
from pano_mvs.geometry import Rigid3
from pano_mvs.results.run_output import RunOutput
from pano_mvs.scene import FilePart
from pano_mvs.scene.image_files.image_file import decode_image
from pano_mvs.share.top_view import MAP_PIXELS, MapPlace

PLAN = "floor_plan/floor_plan.json"

_SHARPER = 2  # a drawing needs more pixels than a picture of points


@dataclass(frozen=True, eq=False)
class StoreyMap:
    """The plan of one storey.

    Attributes:
        picture: (H, W, 3) uint8 RGB.
        place: where it lies in the page.
        heights: the y of the page between which it lies.
    """

    picture: NDArray[np.uint8]
    place: MapPlace
    heights: tuple[float, float]


def run_plans(run: RunOutput, page_from_world: Rigid3) -> tuple[list[StoreyMap], str]:
    """Return the floor plans of the largest group of a run, one per storey, and a note, or "".

    Args:
        run: the output of a run.
        page_from_world: the frame of the page.
    """
    if not run.has_file(PLAN):
        return [], ""
    path = run.out / PLAN
    try:
        about = json.loads(FilePart(path).read_bytes())
        file_from_world = np.array(about["file_from_world"], np.float64).reshape(3, 3)
        page_from_file = page_from_world @ Rigid3(file_from_world.T, np.zeros(3))
        storeys = [entry for entry in about["storeys"] if "png" in entry]
        plans = [
            _storey(entry, decode_image(path_inside(path.parent, str(entry["png"]))), page_from_file)
            for entry in storeys
        ]
    except (ValueError, KeyError, TypeError, InputError) as error:
        return [], f"{path} was left out: it is not as export.floor_plan writes it ({error})"
    return plans, ""


def _storey(entry: dict[str, Any], picture: NDArray[np.uint8], page_from_file: Rigid3) -> StoreyMap:
    left, top = entry["origin_xy"]
    lower, upper = entry["z_range"]
    width, height = (entry["units_per_pixel"] * count for count in entry["size_px"])
    corners = [(left, top, lower), (left + width, top, lower), (left, top - height, lower), (left, top, upper)]
    corner, right, down, above = page_from_file.apply(np.array(corners, np.float64))
    flat = [0, 2]
    shrink = min(1.0, _SHARPER * MAP_PIXELS / max(picture.shape[:2]))
    size = (max(1, round(picture.shape[1] * shrink)), max(1, round(picture.shape[0] * shrink)))
    return StoreyMap(
        np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8),
        MapPlace(corner[flat], (right - corner)[flat], (down - corner)[flat]),
        (float(corner[1]), float(above[1])),
    )
