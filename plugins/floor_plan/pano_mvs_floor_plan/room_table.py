"""The table of the rooms of a plan, as CSV."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pano_mvs_floor_plan.sheets import StoreySheet
from pano_mvs_floor_plan.sizes import volume_of


def write_rooms_csv(path: Path, storeys: Sequence[StoreySheet], *, is_metric: bool) -> None:
    """Write a row for each room: clear sizes with their standard deviations, areas, volume, doors and windows.

    What is not known is left empty.
    """
    unit = "m" if is_metric else "units"
    measures = (f"length_{unit}", f"width_{unit}", f"height_{unit}", f"area_{unit}2", f"volume_{unit}3")
    head = ["storey", "room", "is_closed", "is_rectangle"]
    head += [column for name in measures for column in (name, f"{name}_std")]
    head += [f"perimeter_{unit}", f"wall_area_{unit}2", "doors", "windows"]
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(head)
        for storey in storeys:
            for room, (name, size) in enumerate(zip(storey.room_names, storey.plan.sizes, strict=True)):
                values = [size.length, size.width, size.height, size.area, volume_of(size)]
                counts = storey.plan.opening_counts(room)
                walls = size.perimeter * size.height.value
                writer.writerow(
                    [storey.name, name, *(str(one).lower() for one in (size.is_closed, size.is_rectangle))]
                    + [_text(part) for value in values for part in value]
                    + [_text(size.perimeter), _text(walls), counts["door"], counts["window"]]
                )


def _text(value: float) -> str:
    return "" if np.isnan(value) else f"{value:.4f}"
