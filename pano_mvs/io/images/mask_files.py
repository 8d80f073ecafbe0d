"""Find the mask file of an image."""

from __future__ import annotations

import glob
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from pano_mvs.core.errors import InputError
from pano_mvs.core.paths import below, children, is_file, is_folder
from pano_mvs.io.images.names import without_extension


def find_mask(folder: Path, name: str) -> Path | None:
    """Return the mask file of an image, or None if it has none.

    The mask of `a/b.jpg` is `a/b.jpg.png`, as COLMAP names it, else `a/b.png`. The mask of `a/b`, whose extension is
    not known, is `a/b.png` with any image extension before the last (`a/b.JPG.png`), else `a/b.png`.

    Args:
        folder: the folder of the masks.
        name: the image's path relative to the capture, with or without its extension.
    """
    plain = without_extension(name)
    if plain == name:
        stem = PurePosixPath(plain).name
        full_names = [
            path
            for path in children((folder / plain).parent, f"{glob.escape(stem)}.*.png")
            if without_extension(path.stem) == stem
        ]
    else:
        full_names = [folder / f"{name}.png"]
    return next((path for path in (*full_names, folder / f"{plain}.png") if is_file(path)), None)


def require_masks(folder: Path, names: Sequence[str]) -> None:
    """Check that a folder holds a mask of at least one image.

    Raises:
        InputError: if it does not, or if it is not a folder.
    """
    if not is_folder(folder):
        raise InputError(f"{folder}: masks must be a folder. Set one mask for all images with `mask`")
    if any(find_mask(folder, name) for name in names):
        return
    files = [path.relative_to(folder).as_posix() for path in below(folder) if is_file(path)]
    others = f" and {len(files) - 1} more" if len(files) > 1 else ""
    content = f"it holds {files[0]}{others}" if files else "it is empty"
    raise InputError(
        f"{folder}: no mask in it belongs to an image of the capture ({content}). The mask of {names[0]} must be "
        f"called {names[0]}.png, or {without_extension(names[0])}.png"
    )
