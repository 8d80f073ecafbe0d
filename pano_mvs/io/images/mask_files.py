"""Mask files: which file masks which picture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from pano_mvs.core.errors import InputError
from pano_mvs.core.paths import below, is_file, is_folder


def find_mask(name: str, folder: Path) -> Path | None:
    """Return the mask of a picture: `a/b.jpg.png` as COLMAP names it, else `a/b.png`; None if there is none.

    Args:
        name: of the picture, relative to the capture.
        folder: the masks'.
    """
    candidates = (folder / f"{name}.png", folder / PurePosixPath(name).with_suffix(".png"))
    return next((candidate for candidate in candidates if is_file(candidate)), None)


def require_masks(names: Sequence[str], folder: Path) -> None:
    """Check that a folder has a mask for one of the pictures at least.

    Raises:
        InputError: if it has none, or is none.
    """
    if not is_folder(folder):
        raise InputError(f"{folder}: masks must be a folder. Give one mask for all pictures as `mask`")
    if any(find_mask(name, folder) for name in names):
        return
    files = [path.relative_to(folder).as_posix() for path in below(folder) if is_file(path)]
    there = (
        f"it holds {files[0]}" + (f" and {len(files) - 1} more" if len(files) > 1 else "") if files else "it is empty"
    )
    raise InputError(
        f"{folder}: no mask in it belongs to a picture of the capture ({there}). The mask of {names[0]} must be called "
        f"{names[0]}.png, or {PurePosixPath(names[0]).with_suffix('.png')}"
    )
