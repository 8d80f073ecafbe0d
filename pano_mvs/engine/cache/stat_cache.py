"""Digests of user files, remembered while size, time stamps and inode stay the same."""

from __future__ import annotations

import json
import os
import time
from pathlib import Path
from typing import TypeAlias

from pano_mvs.core.digest import IS_DIGEST, digest_from_bytes, digest_from_file, digest_from_value
from pano_mvs.core.errors import InputError
from pano_mvs.core.files import CACHE_MARK, write_text
from pano_mvs.core.paths import below, is_file, is_folder, reason_of, resolved

# A file changed within this time of being hashed may change again without its time stamp showing it.
_SETTLE_S = 2.0
_MOST_ENTRIES = 500_000

Entry: TypeAlias = "list[int | str]"
"""Size, time of the last change of the bytes and of the file in ns, inode; digest."""

State: TypeAlias = "tuple[int, int, int, int]"
"""An entry without the digest."""


class StatCache:
    """Remembers file digests in one file, JSON under a digest of it; losing it costs time and nothing else."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._entries = _read(path)
        self._learnt: dict[str, Entry] = {}

    def digest(self, path: Path) -> str:
        """Return the digest of a file, or of a folder's relative names and files.

        Raises:
            InputError: if it cannot be read.
        """
        try:
            if is_folder(path):
                files = files_of_folder(path)
                return digest_from_value([[file.relative_to(path).as_posix(), self._file(file)] for file in files])
            return self._file(path)
        except (OSError, ValueError) as error:  # ValueError: a name that no file can have
            raise InputError(
                f"{path}: cannot be read ({reason_of(error)}). Check that it exists and may be read"
            ) from error

    @staticmethod
    def state(path: Path) -> State | None:
        """Return what a file's digest is remembered by; None if the file cannot be looked at."""
        try:
            return _state(path.stat())
        except (OSError, ValueError):
            return None

    def times_of_change(self) -> dict[str, float]:
        """Return, by digest, when the known files of these bytes were last touched, in seconds; the latest of several.

        Files that are not as they were when they were read are left out.
        """
        found: dict[str, float] = {}
        for name, (size, changed, touched, inode, digest) in self._entries.items():
            if self.state(Path(name)) == (size, changed, touched, inode):
                assert isinstance(touched, int)
                assert isinstance(changed, int)
                found[str(digest)] = max(found.get(str(digest), 0.0), max(changed, touched) / 1e9)
        return found

    def forget(self, path: Path) -> None:
        """Forget a file whose bytes turned out to be others."""
        self._learnt.pop(str(resolved(path)), None)
        self._entries.pop(str(resolved(path)), None)

    def save(self) -> None:
        """Add what was learnt to the file, to which other runs may have added meanwhile.

        What was learnt long ago goes when there is too much: it may be of files that are long gone.
        """
        if self._learnt:
            kept = {name: entry for name, entry in _read(self._path).items() if name not in self._learnt}
            entries = [*kept.items(), *self._learnt.items()][-_MOST_ENTRIES:]
            body = json.dumps(dict(entries))
            text = f"{digest_from_bytes(body.encode())}\n{body}"
            write_text(self._path, text, temporary_in=self._path.parent / "tmp")
            self._entries, self._learnt = dict(entries), {}

    def _file(self, path: Path) -> str:
        stat = path.stat()
        state = [*_state(stat)]
        key = str(resolved(path))
        known = self._entries.get(key)
        if known is not None and known[:4] == state:
            return str(known[4])
        digest = digest_from_file(path)
        if time.time() - max(stat.st_mtime, stat.st_ctime) > _SETTLE_S:
            self._entries[key] = self._learnt[key] = [*state, digest]
        return digest


def files_of_folder(folder: Path) -> list[Path]:
    """Return the files below a folder, in order of their paths, without those of a cache that lies in it."""
    found = below(folder)
    caches = [path.parent for path in found if path.name == CACHE_MARK and path.parent != folder]
    return [path for path in found if is_file(path) and not any(path.is_relative_to(cache) for cache in caches)]


def _state(stat: os.stat_result) -> State:
    return stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns, stat.st_ino


def _read(path: Path) -> dict[str, Entry]:
    """Return the entries of a file, none if it is damaged."""
    try:
        checksum, _, body = path.read_bytes().partition(b"\n")
        entries = json.loads(body) if checksum.decode() == digest_from_bytes(body) else None
    except (OSError, ValueError, RecursionError):
        return {}
    if not isinstance(entries, dict):
        return {}
    return {name: entry for name, entry in entries.items() if _is_entry(entry)}


def _is_entry(value: object) -> bool:
    if not isinstance(value, list) or len(value) != 5 or not isinstance(value[4], str):
        return False
    return all(type(number) is int for number in value[:4]) and IS_DIGEST.fullmatch(value[4]) is not None
