"""Find which files of a folder are the pictures of a rig of two lenses, taken at the same time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Literal

from pano_mvs.core.errors import InputError
from pano_mvs.io.images.captures import list_pictures

Layout = Literal["auto", "side_by_side", "folders", "suffixes"]


@dataclass(frozen=True, slots=True)
class RigPictures:
    """The pictures of one capture of a rig.

    Attributes:
        name: path relative to the folder, without the lens and with the extension .png.
        files: the file that contains both pictures side by side, or the file of each lens.
        problem: why the capture is incomplete; empty if it is complete.
    """

    name: str
    files: tuple[Path, ...]
    problem: str = ""


def list_rig_pictures(
    folder: Path, lens_names: Sequence[str], layout: Layout, *, notes: list[str] | None = None
) -> list[RigPictures]:
    """Return the captures in a folder and its subfolders, in natural order.

    Args:
        folder: the folder.
        lens_names: names of the two lenses.
        layout: "side_by_side": each file shows both lenses, the first on the left; "folders": one of the folders in
            the path of a file has the name of its lens, as in front/000.jpg; "suffixes": file names end with a
            separator and the name of the lens, as in 000_front.jpg. "auto": folders if a folder has the name of a lens,
            suffixes if a file does, otherwise side_by_side.
        notes: see `list_pictures`.

    Raises:
        InputError: if the folder contains no images, or none that fit the layout.
    """
    paths = list_pictures(folder, notes)
    names = [PurePosixPath(path.relative_to(folder).as_posix()) for path in paths]
    if layout == "auto":
        layout = _layout(names, lens_names)
    if layout == "side_by_side":
        return [RigPictures(str(name.with_suffix(".png")), (path,)) for name, path in zip(names, paths, strict=True)]
    found = list(_pairs(paths, names, lens_names=lens_names, layout=layout))
    if not found:
        example = f"{lens_names[0]}/000.jpg" if layout == "folders" else f"000_{lens_names[0]}.jpg"
        raise InputError(
            f"{folder}: no image belongs to a lens of the calibration ({' or '.join(lens_names)}). Call files like "
            f"{example}, or set layout: side_by_side"
        )
    return found


def _layout(names: Sequence[PurePosixPath], lens_names: Sequence[str]) -> Layout:
    for layout in ("folders", "suffixes"):
        if any(_lens_of(name, lens_names, layout) is not None for name in names):
            return layout
    return "side_by_side"


def _pairs(
    paths: Sequence[Path], names: Sequence[PurePosixPath], *, lens_names: Sequence[str], layout: Layout
) -> Iterator[RigPictures]:
    captures: dict[str, dict[int, Path]] = {}
    for path, name in zip(paths, names, strict=True):
        found = _lens_of(name, lens_names, layout)
        if found is None:
            captures.setdefault(str(name), {})
            continue
        lens_idx, shared = found
        captures.setdefault(shared, {}).setdefault(lens_idx, path)
    if not any(captures.values()):
        return
    for shared, files in captures.items():
        if not files:
            yield RigPictures(shared, (), f"does not belong to a lens: no {layout} {' or '.join(lens_names)}")
            continue
        missing = [name for idx, name in enumerate(lens_names) if idx not in files]
        problem = f"the picture of the lens {missing[0]} is missing" if missing else ""
        if len({file.suffix for file in files.values()}) > 1:
            problem = "the pictures of its lenses have different formats; save both in the same"
        yield RigPictures(f"{shared}.png", tuple(files[idx] for idx in sorted(files)), problem)


def _lens_of(name: PurePosixPath, lens_names: Sequence[str], layout: Layout) -> tuple[int, str] | None:
    """Return the lens of a file, and its path without the lens and without extension; None if it has no lens."""
    for idx, lens in enumerate(lens_names):
        if layout == "folders":
            folders = name.parts[:-1]
            if lens in folders:
                kept = [part for position, part in enumerate(name.parts) if position != folders.index(lens)]
                return idx, str(PurePosixPath(*kept).with_suffix(""))
        elif (stem := name.stem).endswith(lens) and len(stem) > len(lens) + 1 and stem[-len(lens) - 1] in "_-. ":
            return idx, str(name.with_name(stem[: -len(lens) - 1]))
    return None
