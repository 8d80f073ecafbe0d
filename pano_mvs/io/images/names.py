"""The same picture under two names: with and without folders, with another extension."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import PurePosixPath

_SEPARATOR = "|"  # of the two names of a pair


def match_image_names(wanted: Iterable[str], available: Iterable[str]) -> dict[str, str]:
    """Return, for each wanted image name that has exactly one counterpart, that counterpart.

    The first rule that gives candidates decides: the same name; one name is the other with folders in front; the
    same without folders; the same without folders and extension. Two candidates are none.

    Args:
        wanted: names relative to a capture, say, "a/001.jpg".
        available: names as another file has them, say, "images/a/001.jpg" or "./001.png".

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


def printable_name(name: str) -> tuple[str, str]:
    """Return a file's name as an item may have it, and why the file cannot be used under it; empty if it can."""
    shown = name.encode(errors="replace").decode()
    if _SEPARATOR not in name and shown == name:
        return name, ""
    what = repr(_SEPARATOR) if _SEPARATOR in name else "bytes that are no UTF-8"
    return shown, f"{shown}: a file name with {what} cannot be used; rename it"


def _clean(name: str) -> tuple[str, ...]:
    return tuple(part for part in PurePosixPath(name.replace("\\", "/")).parts if part != ".")


def _ends_with(longer: tuple[str, ...], shorter: tuple[str, ...]) -> bool:
    return bool(shorter) and longer[-len(shorter) :] == shorter


def _stem(parts: tuple[str, ...]) -> str:
    return PurePosixPath(parts[-1]).stem.casefold() if parts else ""
