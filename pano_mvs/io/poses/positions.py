"""Positions of images without usable rotations: of a survey, in UTM, or of a scanner such as NavVis'.

They show which images are near each other (`pairs.position`), and give scale and heading (`poses.scale`).
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

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
_LATITUDES, _LONGITUDES = frozenset({"latitude", "lat"}), frozenset({"longitude", "lon", "lng", "long"})
_DEGREES = _LATITUDES | _LONGITUDES  # Metashape calls columns of degrees "X/Longitude" and "Y/Latitude"

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

    A file is a table (CSV, with commas, semicolons or tabulators) whose first line names the columns (`COLUMNS`, also
    as Metashape's X/Easting), or JSON: {"views": [{"image": …, "center": [x, y, z]}]}. Other columns, such as those of
    rotations, are ignored.

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


class Heading(NamedTuple):
    """The line of a table that names its columns."""

    number: int  # of the line, from 1
    delimiter: str
    columns: list[frozenset[str]]  # the names of each, in lower case: Metashape's "X/Easting" has two

    def places(self) -> dict[str, int] | None:
        """Return the position of each column of `COLUMNS`, or None if one is missing."""
        found = {}
        for key, names in COLUMNS.items():
            at = [
                idx
                for name in names
                for idx, column in enumerate(self.columns)
                if name in column and not column & _DEGREES
            ]
            if not at:
                return None
            found[key] = at[0]
        return found


def csv_cells(line: str, delimiter: str, where: str) -> list[str]:
    """Return the cells of a line of a table, without quotes and spaces around them.

    Args:
        where: the file and the line, for the message.

    Raises:
        InputError: if a cell is longer than Python's csv module reads.
    """
    try:
        (cells,) = csv.reader([line], delimiter=delimiter, skipinitialspace=True)
    except csv.Error as error:
        raise InputError(f"{where}: not a line of a CSV file ({error}): {shortened(line, 100)!r}") from error
    return [cell.strip() for cell in cells]


def latitude_heading(path: Path) -> Heading | None:
    """Return the heading of a table of images with latitudes and longitudes, or None if it is not one."""
    for heading in _headings(path):
        columns = frozenset().union(*heading.columns)
        if columns & _LATITUDES and columns & _LONGITUDES:
            return heading
    return None


def _headings(path: Path) -> Iterator[Heading]:
    """Yield the lines of a table that may name its columns: comments, and the first other line."""
    for number, line in enumerate(FilePart(path).read_text().splitlines(), 1):
        if not line.strip():
            continue
        # NavVis' tables begin with "# pano poses v1.0: ID; filename; …", Metashape's with "#Label,X/Easting,…".
        heading = line.lstrip("#").rpartition(": ")[2] if line.startswith("#") else line
        delimiter = max(",;\t", key=heading.count)
        cells = csv_cells(heading, delimiter, f"{path}:{number}")
        yield Heading(number, delimiter, [frozenset(cell.lower().split("/")) for cell in cells])
        if not line.startswith("#"):
            return


def _table(path: Path) -> tuple[Heading, dict[str, int]] | None:
    """Return the heading of a table of positions and the position of each column, or None if it is not one."""
    tables = ((heading, heading.places()) for heading in _headings(path))
    return next(((heading, places) for heading, places in tables if places is not None), None)


def _read_table(path: Path) -> dict[str, FloatArray]:
    table = _table(path)
    assert table is not None, path
    heading, places = table
    found = []
    for number, line in enumerate(FilePart(path).read_text().splitlines(), 1):
        if number <= heading.number or not line.strip() or line.startswith("#"):
            continue
        cells = csv_cells(line, heading.delimiter, f"{path}:{number}")
        try:
            position = np.array([float(cells[places[key]]) for key in "xyz"])
            found.append((cells[places["name"]].replace("\\", "/"), position))
        except (ValueError, IndexError) as error:
            raise InputError(
                f"{path}:{number}: expected a name and a position, got {shortened(line, 100)!r}"
            ) from error
    return _checked(found, path)


def _checked(found: list[tuple[str, FloatArray]], path: Path) -> dict[str, FloatArray]:
    require_distinct([name for name, _ in found], path)
    for name, position in found:
        if not np.isfinite(position).all():
            raise InputError(f"{path}: the position of {name} holds NaN or infinite numbers")
    return dict(found)
