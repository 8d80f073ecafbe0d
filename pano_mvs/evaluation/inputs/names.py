"""Pairing of images that two programs name differently."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import takewhile
from pathlib import PurePosixPath

from pano_mvs.io.images.names import without_extension

RANGE_SUFFIXES = (".tiff", ".tif", ".exr", ".npy", ".npz", ".png")
"""Extensions of range map files. If an image has several, the first of these extensions wins."""


def match_images(names: Iterable[str], available: Iterable[str]) -> dict[str, str]:
    """Pair image names one to one; either side may lack folders or extensions.

    Two names can match if their last parts are equal, ignoring case and image extensions. Among several candidates,
    the pair that shares most trailing folders wins, then the pair with the same extension. Names that are still
    ambiguous are left out.

    Args:
        names: image names, such as "a/001".
        available: names of the other side, such as "images/a/001.jpg".

    Returns:
        Name to available name.

    Example:
        >>> match_images(["a/1", "b/1"], ["images/b/1.jpg", "images/a/1.jpg"])
        {'a/1': 'images/a/1.jpg', 'b/1': 'images/b/1.jpg'}
    """
    candidates: dict[str, tuple[list[str], list[str]]] = {}
    for side, all_names in enumerate((names, available)):
        for name in all_names:
            candidates.setdefault(_parts(name)[-1].casefold(), ([], []))[side].append(name)
    matched: dict[str, str] = {}
    for ours, theirs in candidates.values():
        if len(ours) == len(theirs) == 1:
            matched[ours[0]] = theirs[0]
        elif ours and theirs:
            closest = {name: _closest(name, theirs) for name in ours}
            matched |= {name: other for name, other in closest.items() if other and _closest(other, ours) == name}
    return matched


def shortened_list(names: Iterable[str], count: int = 3) -> str:
    """Return the first names as text, with the total if there are more."""
    listed = list(names)
    return ", ".join(listed[:count]) + (f" … ({len(listed)} in all)" if len(listed) > count else "")


def _parts(name: str) -> tuple[str, ...]:
    return tuple(part for part in PurePosixPath(without_extension(name)).parts if part != ".") or ("",)


def _closest(name: str, others: Sequence[str]) -> str:
    """Return the closest of several names with the same last part; "" if two are equally close."""
    ranked = sorted(others, key=lambda other: _closeness(name, other), reverse=True)
    tied = len(ranked) > 1 and _closeness(name, ranked[0]) == _closeness(name, ranked[1])
    return "" if tied else ranked[0]


def _closeness(name: str, other: str) -> tuple[int, bool]:
    """Return the number of equal trailing parts, and whether the last parts are equal with their extensions."""
    pairs = zip(reversed(_parts(name)), reversed(_parts(other)), strict=False)
    common = sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], pairs))
    return common, PurePosixPath(name).name == PurePosixPath(other).name
