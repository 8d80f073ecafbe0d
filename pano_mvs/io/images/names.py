"""Names of images: with and without folders and extensions, and names that cannot be used."""

from __future__ import annotations

import glob
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from itertools import takewhile
from pathlib import Path, PurePosixPath

from pano_mvs.core.errors import InputError
from pano_mvs.core.paths import below, children, is_file, is_folder
from pano_mvs.io.images.captures import PICTURE_SUFFIXES

_SEPARATOR = "|"  # between the two names of a pair
_EXTENSIONS = PICTURE_SUFFIXES | {".bmp", ".dng", ".exr", ".npy", ".npz"}


def match_image_names(wanted: Iterable[str], available: Iterable[str]) -> dict[str, str]:
    """Return, for each wanted image name that has one closest counterpart, that counterpart.

    Counterparts have the same last part, ignoring case and image extensions. Of several, the closest is the one that
    shares most trailing folders, then the one that is the wanted name with folders in front or without some, then the
    one with the same extension. A name is left out if two are equally close. Several names may have one counterpart;
    see `pair_image_names`.

    Returns:
        Wanted name to available name.
    """
    found: dict[str, str] = {}
    for ours, theirs in _with_same_last_part(wanted, available):
        found |= {name: other for name in ours if (other := _closest(name, theirs))}
    return found


def without_shared(matched: Mapping[str, str]) -> dict[str, str]:
    """Return the matches of names whose counterpart no other name has, or which are exactly their counterpart.

    >>> without_shared({"a/1.jpg": "1.jpg", "b/1.jpg": "1.jpg", "2.jpg": "2.png"})
    {'2.jpg': '2.png'}
    """
    claims = Counter(matched.values())
    return {name: there for name, there in matched.items() if claims[there] == 1 or there == name}


def pair_image_names(names: Iterable[str], available: Iterable[str]) -> dict[str, str]:
    """Pair image names one to one: those that are the closest to each other, as in `match_image_names`.

    Returns:
        Name to available name.

    Example:
        >>> pair_image_names(["a/1", "b/1"], ["images/b/1.jpg", "images/a/1.jpg"])
        {'a/1': 'images/a/1.jpg', 'b/1': 'images/b/1.jpg'}
    """
    paired: dict[str, str] = {}
    for ours, theirs in _with_same_last_part(names, available):
        closest = {name: _closest(name, theirs) for name in ours}
        paired |= {name: other for name, other in closest.items() if other and _closest(other, ours) == name}
    return paired


def without_extension(name: str) -> str:
    """Return a name with forward slashes and without an image's or range map's extension; other endings stay.

    >>> without_extension("a/001.JPG"), without_extension("v1.5")
    ('a/001', 'v1.5')
    """
    plain = name.replace("\\", "/")
    stem, dot, ending = plain.rpartition(".")
    return stem if dot and f".{ending.casefold()}" in _EXTENSIONS and not stem.endswith("/") and stem else plain


def printable_name(name: str) -> tuple[str, str]:
    """Return a file name with unprintable characters replaced, and why the file cannot be used; "" if it can."""
    shown = name.encode(errors="replace").decode()
    if _SEPARATOR not in name and shown == name:
        return name, ""
    what = repr(_SEPARATOR) if _SEPARATOR in name else "bytes that are not UTF-8"
    return shown, f"{shown}: a file name with {what} cannot be used; rename it"


def _with_same_last_part(names: Iterable[str], others: Iterable[str]) -> Iterable[tuple[list[str], list[str]]]:
    """Return the names of both sides in groups with the same last part."""
    groups: dict[str, tuple[list[str], list[str]]] = {}
    for side, all_names in enumerate((names, others)):
        for name in all_names:
            groups.setdefault(_parts(without_extension(name))[-1].casefold(), ([], []))[side].append(name)
    return groups.values()


def _closest(name: str, others: Sequence[str]) -> str:
    """Return the closest of several names with the same last part; "" if there is none, or two are equally close."""
    ranked = sorted(((_closeness(name, other), other) for other in others), reverse=True)
    tied = len(ranked) > 1 and ranked[0][0] == ranked[1][0]
    return ranked[0][1] if ranked and not tied else ""


def _closeness(name: str, other: str) -> tuple[bool, int, bool, bool]:
    """Return how close two names are: equal; equal trailing parts; one ends with the other; same extension."""
    ours, theirs = _parts(name), _parts(other)
    plain, other_plain = _parts(without_extension(name)), _parts(without_extension(other))
    pairs = zip(reversed(plain), reversed(other_plain), strict=False)
    common = sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], pairs))
    return ours == theirs, common, common == min(len(plain), len(other_plain)), ours[-1] == theirs[-1]


def _parts(name: str) -> tuple[str, ...]:
    return tuple(part for part in PurePosixPath(name.replace("\\", "/")).parts if part != ".") or ("",)


def find_mask(folder: Path, name: str) -> Path | None:
    """Return the mask file of an image, or None if it has none.

    The mask of `a/b.jpg` is `a/b.jpg.png`, as COLMAP names it, else `a/b.png`. The mask of `a/b`, whose extension is
    not known, is `a/b.png` with any image extension before the last (`a/b.JPG.png`), else `a/b.png`.
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
