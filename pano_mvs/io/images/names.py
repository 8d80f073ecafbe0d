"""Names of images: with and without folders and extensions, and names that cannot be used."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import PurePosixPath

from pano_mvs.io.images.captures import PICTURE_SUFFIXES

_SEPARATOR = "|"  # between the two names of a pair
_EXTENSIONS = PICTURE_SUFFIXES | {".exr", ".npy", ".npz"}


def match_image_names(wanted: Iterable[str], available: Iterable[str]) -> dict[str, str]:
    """Return, for each wanted image name that has exactly one counterpart, that counterpart.

    The first rule that finds candidates decides: equal names; names of which one is the other with further folders in
    front; names that are equal without folders; names that are equal without folders and extensions. A name is left
    out if that rule finds several candidates.

    Args:
        wanted: names relative to a capture, such as "a/001.jpg".
        available: names in another file, such as "images/a/001.jpg" or "./001.png".

    Returns:
        Wanted name to available name.
    """
    candidates = list(available)
    cleaned = {name: _clean(name) for name in candidates}
    matched: dict[str, str] = {}
    for name in wanted:
        parts = _clean(name)
        rules = (
            lambda other, parts=parts: other == parts,
            lambda other, parts=parts: _ends_with(other, parts) or _ends_with(parts, other),
            lambda other, parts=parts: other[-1:] == parts[-1:],
            lambda other, parts=parts: _stem(other) == _stem(parts),
        )
        for rule in rules:
            found = [candidate for candidate in candidates if rule(cleaned[candidate])]
            if found:
                if len(found) == 1:
                    matched[name] = found[0]
                break
    return matched


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


def _clean(name: str) -> tuple[str, ...]:
    return tuple(part for part in PurePosixPath(name.replace("\\", "/")).parts if part != ".")


def _ends_with(longer: tuple[str, ...], shorter: tuple[str, ...]) -> bool:
    return bool(shorter) and longer[-len(shorter) :] == shorter


def _stem(parts: tuple[str, ...]) -> str:
    return PurePosixPath(parts[-1]).stem.casefold() if parts else ""
