"""Digests of user files, remembered while size, time stamps and inode stay the same."""

from __future__ import annotations

import json
import time
from pathlib import Path

from pano_mvs.core.digest import digest_from_file, digest_from_value
from pano_mvs.core.errors import InputError
from pano_mvs.core.files import write_text

# A file changed within this time of being hashed may change again without its time stamp showing it.
_SETTLE_S = 2.0


class StatCache:
    """Remembers file digests in one JSON file; losing it costs time and nothing else."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._changed = False
        self._entries: dict[str, list[object]] = {}
        try:
            entries = json.loads(path.read_bytes())
        except (OSError, ValueError):
            entries = None
        if isinstance(entries, dict):
            self._entries = entries

    def digest(self, path: Path) -> str:
        """Return the digest of a file, or of a folder's relative names and files.

        Raises:
            InputError: if it cannot be read.
        """
        try:
            if path.is_dir():
                files = sorted(file for file in path.rglob("*") if file.is_file())
                return digest_from_value([[file.relative_to(path).as_posix(), self._file(file)] for file in files])
            return self._file(path)
        except OSError as error:
            reason = error.strerror or str(error)
            raise InputError(f"{path}: cannot be read ({reason}). Check that it exists and may be read") from error

    def save(self) -> None:
        """Write what was learnt."""
        if self._changed:
            write_text(self._path, json.dumps(self._entries))
            self._changed = False

    def _file(self, path: Path) -> str:
        stat = path.stat()
        state = [stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns, stat.st_ino]
        key = str(path.resolve())
        known = self._entries.get(key)
        if isinstance(known, list) and len(known) == 5 and known[:4] == state:
            return str(known[4])
        digest = digest_from_file(path)
        if time.time() - max(stat.st_mtime, stat.st_ctime) > _SETTLE_S:
            self._entries[key] = [*state, digest]
            self._changed = True
        return digest
