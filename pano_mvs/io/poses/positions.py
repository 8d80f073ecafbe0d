"""Positions of images without usable rotations: of a survey, in UTM, or of a scanner such as NavVis'.

They show which images are near each other (`pairs.position`), and give scale and heading (`poses.scale`).
"""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np

from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.errors import InputError
from pano_mvs.core.text import shortened
from pano_mvs.io.poses.json_files import image_name, number_array, read_json_value, require_distinct
from pano_mvs.scene import FilePart

COLUMNS = {
    "name": ("name", "image", "imagename", "image_name", "file", "filename", "label"),
    "x": ("x", "pano_pos_x", "easting", "east"),
    "y": ("y", "pano_pos_y", "northing", "north"),
    "z": ("z", "pano_pos_z", "height", "altitude", "elevation"),
}
"""What the columns of a table may be called, in any case."""

NO_POSES = (
    "it has positions, but no rotations that could be used. Let a preset find the poses, and give the positions to "
    "pairs.position (`path`) and to poses.scale (`positions`)"
)


def holds_positions(path: Path) -> bool:
    """Return whether a file has positions of images and is not a file of poses."""
    if path.suffix.lower() == ".csv":
        return _table(path) is not None
    value = read_json_value(path) if path.suffix.lower() == ".json" else None
    return bool(_views(value)) and all("center" in view and "R" not in view for view in _views(value))


def read_positions(path: Path) -> dict[str, FloatArray]:
    """Return the position (3,) of each image in a file that `holds_positions`, as it states them: x, y, and z up.

    A file is a table (CSV, with commas, semicolons or tabulators) whose first line names the columns (`COLUMNS`), or
    JSON: {"views": [{"image": …, "center": [x, y, z]}]}. Other columns, such as those of rotations, are ignored.

    Raises:
        InputError: if a number is missing; it names the line or the view.
    """
    if path.suffix.lower() == ".csv":
        return _read_table(path)
    found = []
    for idx, view in enumerate(_views(read_json_value(path))):
        where = f"{path}: views[{idx}]"
        found.append((image_name(view, "image", where), number_array(view, "center", (3,), where=where)))
    return _checked(found, path)


def _views(value: Any) -> list[dict[str, Any]]:
    views = value.get("views") if isinstance(value, dict) else None
    return views if isinstance(views, list) and all(isinstance(view, dict) for view in views) else []


def _table(path: Path) -> tuple[int, str, dict[str, int]] | None:
    """Return the number of the line with the names of the columns, the delimiter, and the position of each column."""
    for number, line in enumerate(FilePart(path).read_text().splitlines()):
        # NavVis' tables begin with "# pano poses v1.0: ID; filename; …".
        heading = line.rpartition(": ")[2] if line.startswith("#") else line
        delimiter = max(",;\t", key=heading.count)
        cells = [cell.strip().lower() for cell in heading.split(delimiter)]
        places = {key: [cells.index(name) for name in names if name in cells] for key, names in COLUMNS.items()}
        if all(places[key] for key in ("name", "x", "y", "z")):
            return number, delimiter, {key: found[0] for key, found in places.items()}
        if line.strip() and not line.startswith("#"):
            return None
    return None


def _read_table(path: Path) -> dict[str, FloatArray]:
    table = _table(path)
    assert table is not None, path
    first, delimiter, places = table
    found = []
    for number, line in enumerate(FilePart(path).read_text().splitlines()):
        if number <= first or not line.strip() or line.startswith("#"):
            continue
        cells = [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter))]
        try:
            position = np.array([float(cells[places[key]]) for key in "xyz"])
            found.append((cells[places["name"]].replace("\\", "/"), position))
        except (ValueError, IndexError) as error:
            raise InputError(
                f"{path}:{number + 1}: expected a name and a position, got {shortened(line, 100)!r}"
            ) from error
    return _checked(found, path)


def _checked(found: list[tuple[str, FloatArray]], path: Path) -> dict[str, FloatArray]:
    require_distinct([name for name, _ in found], path)
    for name, position in found:
        if not np.isfinite(position).all():
            raise InputError(f"{path}: the position of {name} holds NaN or infinite numbers")
    return dict(found)
