"""Names that become files and folders: what every system takes, and what stays where it belongs."""

from __future__ import annotations

import unicodedata
from pathlib import PurePosixPath

from pano_mvs.scene.index import PAIR_SEPARATOR

MAX_NAME_LENGTH = 100
_RESERVED = {"con", "prn", "aux", "nul", *(f"{port}{digit}" for port in ("com", "lpt") for digit in "0123456789")}
_NOT_IN_NAMES = '<>:"|?*'
_OF_THE_RUN = {"logs", "run.json", "report.html"}
_PREFIXES_OF_THE_RUN = (".pano-mvs", ".tmp-")


def is_plain_name(name: object) -> bool:
    """Return whether a text is a word of letters, digits, '-', '_' and '.' that may name a file on every system."""
    if not isinstance(name, str) or not 0 < len(name) <= MAX_NAME_LENGTH or name[0] in ".-" or name[-1] == ".":
        return False
    return all(sign.isalnum() or sign in "-_." for sign in name) and not is_reserved(name)


def is_reserved(name: str) -> bool:
    """Return whether Windows takes a file of that name, whatever its extension, for a device."""
    return name.partition(".")[0].rstrip(" ").casefold() in _RESERVED


def is_printable(text: str) -> bool:
    """Return whether a text is free of control characters and of halves of characters."""
    return all(unicodedata.category(sign) not in {"Cc", "Cs"} for sign in text)


def leads_outside(path: str) -> bool:
    """Return whether a relative path with forward slashes is absolute, climbs, or means something else on Windows."""
    parts = path.split("/")
    drive = path[1:2] == ":" and path[0].isalpha()
    return path.startswith("/") or ".." in parts or "\\" in path or "\0" in path or drive


def item_problem(name: str) -> str:
    """Return why an item cannot have a name, empty if it can: files are called by it."""
    if not name or not is_printable(name):
        return f"its name {name!r} is empty or holds control characters; rename it"
    if leads_outside(name):
        return f"its name {name!r} would lead outside the output folder; rename it"
    if PAIR_SEPARATOR in name:
        return f"its name {name!r} holds {PAIR_SEPARATOR!r}, which stands between the names of a pair; rename it"
    return ""


def folder_problem(folder: str) -> str:
    """Return why a text is no folder inside the output folder, empty if it is one (or empty: that folder itself)."""
    if leads_outside(folder):
        return "must be a folder inside the output folder, such as `to: draft` (no '..', no '\\', not absolute)"
    for part in PurePosixPath(folder).parts:
        if not is_printable(part) or any(sign in part for sign in _NOT_IN_NAMES) or part.endswith((".", " ")):
            return f"{part!r} is no name of a folder on every system: use letters, digits, '-', '_' and '.'"
        if is_reserved(part):
            return f"{part!r} is a device on Windows; choose another name"
        if len(part) > MAX_NAME_LENGTH:
            return f"{part[:20]!r}… is too long; {MAX_NAME_LENGTH} characters are allowed"
    if is_of_the_run(folder):
        return f"{folder!r} is where the run itself writes; choose another folder"
    return ""


def is_of_the_run(path: str) -> bool:
    """Return whether the run itself writes at a path relative to the output folder: its results, logs, marks, locks."""
    parts = [part.casefold().rstrip(" .") for part in PurePosixPath(path).parts]
    return bool(parts) and (parts[0] in _OF_THE_RUN or any(part.startswith(_PREFIXES_OF_THE_RUN) for part in parts))
