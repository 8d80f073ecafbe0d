"""Digests of the user's files, valid while size, time stamps and inode stay the same."""

from __future__ import annotations

import json
import os
import time
from pathlib import Path
from typing import TypeAlias

from pano_mvs.core.digest import IS_DIGEST, digest_from_file, digest_from_value
from pano_mvs.core.errors import InputError
from pano_mvs.core.files import CACHE_MARK, checked_body, read_regular, write_checked
from pano_mvs.core.paths import below, is_file, is_folder, reason_of, resolved

# A file that changed this shortly before it was hashed may change again without a new time stamp.
_SETTLE_S = 2.0
_MAX_ENTRIES = 500_000

Entry: TypeAlias = "list[int | str]"
"""Size, modification time (mtime) and change time (ctime) in ns, inode, digest."""

State: TypeAlias = "tuple[int, int, int, int]"  # an entry without the digest


class StatCache:
    """Stores file digests in one JSON file, below a digest of its text. Losing it costs only time."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._entries = _read(path)
        self._new: dict[str, Entry] = {}

    def digest(self, path: Path) -> str:
        """Return the digest of a file, or of the relative names and the contents of the files in a folder.

        Raises:
            InputError: if it cannot be read.
        """
        try:
            if is_folder(path):
                files = files_of_folder(path)
                return digest_from_value([[file.relative_to(path).as_posix(), self._file(file)] for file in files])
            return self._file(path)
        except (OSError, ValueError) as error:  # ValueError: an impossible file name
            raise InputError(
                f"{path}: cannot be read ({reason_of(error)}). Check that it exists and may be read"
            ) from error

    @staticmethod
    def state(path: Path) -> State | None:
        """Return the state under which a file's digest is stored, or None if the file cannot be examined."""
        try:
            return _state(path.stat())
        except (OSError, ValueError):
            return None

    def forget(self, path: Path) -> None:
        """Remove the entry of a file whose digest turned out to be wrong."""
        self._new.pop(str(resolved(path)), None)
        self._entries.pop(str(resolved(path)), None)

    def save(self) -> None:
        """Add new digests to the file, to which other runs may have added in the meantime.

        If there are too many entries, the oldest are dropped, as their files may no longer exist.
        """
        if self._new:
            kept = {name: entry for name, entry in _read(self._path).items() if name not in self._new}
            entries = [*kept.items(), *self._new.items()][-_MAX_ENTRIES:]
            write_checked(self._path, json.dumps(dict(entries)).encode(), temporary_in=self._path.parent / "tmp")
            self._entries, self._new = dict(entries), {}

    def _file(self, path: Path) -> str:
        stat = path.stat()
        state = [*_state(stat)]
        key = str(resolved(path))
        known = self._entries.get(key)
        if known is not None and known[:4] == state:
            return str(known[4])
        digest = digest_from_file(path)
        if time.time() - max(stat.st_mtime, stat.st_ctime) > _SETTLE_S:
            self._entries[key] = self._new[key] = [*state, digest]
        return digest


def files_of_folder(folder: Path) -> list[Path]:
    """Return the files below a folder, sorted by path, without those of a cache inside it."""
    found = below(folder)
    caches = [path.parent for path in found if path.name == CACHE_MARK and path.parent != folder]
    return [path for path in found if is_file(path) and not any(path.is_relative_to(cache) for cache in caches)]


def _state(stat: os.stat_result) -> State:
    return stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns, stat.st_ino


def _read(path: Path) -> dict[str, Entry]:
    """Return the entries in a file; none if it is damaged."""
    try:
        entries = json.loads(checked_body(read_regular(path)))
    except (OSError, ValueError, RecursionError):
        return {}
    return {} if not isinstance(entries, dict) else {name: entry for name, entry in entries.items() if _is_entry(entry)}


def _is_entry(value: object) -> bool:
    if not isinstance(value, list) or len(value) != 5 or not isinstance(value[4], str):
        return False
    return all(type(number) is int for number in value[:4]) and IS_DIGEST.fullmatch(value[4]) is not None
