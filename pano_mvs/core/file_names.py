"""Names of files and folders: valid on every system, and inside the folder they belong to.

A name that a file states (a model, run.json, poses, a tour, an archive) passes `path_problem` when it is read, or
`path_inside` or `file_inside` before anything is written or read.
"""

from __future__ import annotations

import unicodedata
from pathlib import Path, PurePosixPath

from pano_mvs.core.errors import InputError
from pano_mvs.core.paths import is_file, is_inside

MAX_NAME_LENGTH = 100
PAIR_SEPARATOR = " | "
"""Stands between the two names of a pair. Windows allows no vertical bar in a file name, and few files have one."""

_MAX_PART_BYTES = 255 - 40  # file systems allow 255; exports add up to 40, such as "_front.png.geometric.bin"
_RESERVED = {"con", "prn", "aux", "nul", *(f"{port}{digit}" for port in ("com", "lpt") for digit in "0123456789")}
_INVALID_CHARACTERS = '<>:"|?*'
_RUN_FILES = {"logs", "run.json", "report.html"}
_RUN_PREFIXES = (".pano-mvs", ".tmp-")


def is_plain_name(name: object) -> bool:
    """Return whether a name has only letters, digits, '-', '_' and '.', and is a valid file name on every system."""
    if not isinstance(name, str) or not 0 < len(name) <= MAX_NAME_LENGTH or name[0] in ".-" or name[-1] == ".":
        return False
    return all(sign.isalnum() or sign in "-_." for sign in name) and not is_reserved(name)


def is_reserved(name: str) -> bool:
    """Return whether a name, without its extension, is that of a device on Windows."""
    return name.partition(".")[0].rstrip(" ").casefold() in _RESERVED


def is_printable(text: str) -> bool:
    """Return whether a text has no control characters and no surrogates."""
    return all(unicodedata.category(sign) not in {"Cc", "Cs"} for sign in text)


def leads_outside(path: str) -> bool:
    """Return whether a path with forward slashes is absolute, has a "..", or means something else on Windows."""
    parts = path.split("/")
    drive = path[1:2] == ":" and path[0].isalpha()
    return path.startswith("/") or ".." in parts or "\\" in path or "\0" in path or drive


def plain_title(text: str) -> str:
    """Return a title as a part of a path that is valid on every system, of at most 96 bytes; "" if nothing is left.

    >>> plain_title("Hall/2nd floor: east?")
    'Hall 2nd floor east'
    """
    kept = "".join(sign if is_printable(sign) and sign not in _INVALID_CHARACTERS + "/\\" else " " for sign in text)
    return " ".join(kept.split()).encode()[:96].decode(errors="ignore").strip(" .")


def path_problem(name: str) -> str:
    """Return why a name with forward slashes cannot be that of a file below a folder, or "" if it can."""
    if not name or not is_printable(name):
        return f"its name {name!r} is empty or has control characters; rename it"
    if leads_outside(name):
        return f"its name {name!r} would lead outside the output folder; rename it"
    if any(map(is_reserved, name.split("/"))):
        return f"its name {name!r} is that of a device on Windows; rename it"
    return ""


def item_problem(name: str) -> str:
    """Return why a name cannot be that of an item, or "" if it can; results are named after items."""
    if problem := path_problem(name):
        return problem
    if PAIR_SEPARATOR in name:
        return f"its name {name!r} contains {PAIR_SEPARATOR!r}, which separates the names of a pair; rename it"
    longest = max(len(part.encode()) for part in name.split("/"))
    if longest > _MAX_PART_BYTES:
        return (
            f"its name {name[:20]!r}… has {longest} bytes, and {_MAX_PART_BYTES} are possible, because the names of "
            "results are longer; rename it"
        )
    return ""


def path_inside(folder: Path, name: str) -> Path:
    """Return the path of a file below a folder, whose name a file states.

    Raises:
        InputError: if it would not be below the folder: it is absolute, has a "..", or a link leads outside.
    """
    if problem := path_problem(name):
        raise InputError(f"{folder}: a file cannot be used: {problem}")
    path = folder / name
    if not is_inside(path, folder):
        raise InputError(f"{path}: a link leads outside of {folder}. Replace it by the file to which it points")
    return path


def file_inside(folder: Path, name: str, *, through_links: bool = False) -> Path | None:
    """Return the path of a file below a folder, whose name a file states; None if there is no such file below it.

    Args:
        name: of the file, with forward slashes.
        through_links: whether links may lead out of the folder, as in folders of images.
    """
    path = folder / name if not path_problem(name) else None
    return path if path is not None and is_file(path) and (through_links or is_inside(path, folder)) else None


def folder_problem(folder: str) -> str:
    """Return why a path cannot be a folder inside the output folder, or "" if it can; "" is that folder itself."""
    if leads_outside(folder):
        return "must be a folder inside the output folder, such as `to: draft` (no '..', no '\\', not absolute)"
    for part in PurePosixPath(folder).parts:
        if not is_printable(part) or any(sign in part for sign in _INVALID_CHARACTERS) or part.endswith((".", " ")):
            return f"{part!r} is not a valid folder name on every system: use letters, digits, '-', '_' and '.'"
        if is_reserved(part):
            return f"{part!r} is a device on Windows; choose another name"
        if len(part) > MAX_NAME_LENGTH:
            return f"{part[:20]!r}… is too long; {MAX_NAME_LENGTH} characters are allowed"
    if is_of_the_run(folder):
        return f"{folder!r} is used by the run itself; choose another folder"
    return ""


def is_of_the_run(path: str) -> bool:
    """Return whether the run itself writes to a path in the output folder: its summary, logs, marks and locks."""
    parts = [part.casefold().rstrip(" .") for part in PurePosixPath(path).parts]
    return bool(parts) and (parts[0] in _RUN_FILES or any(part.startswith(_RUN_PREFIXES) for part in parts))
