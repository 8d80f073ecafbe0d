"""What was computed from a file that belongs to the user, kept among the user's caches."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from pano_mvs.core.digest import digest_from_value
from pano_mvs.core.errors import StoreError
from pano_mvs.core.files import read_regular, replacing
from pano_mvs.core.kernel_cache import user_cache_folder
from pano_mvs.core.paths import resolved


@dataclass(frozen=True)
class KeptFile:
    """A file among the user's caches for what was computed from another file as it is now."""

    path: Path | None  # None if the user has no folder for caches

    @staticmethod
    def of(path: Path, what: str, settings: object, *, suffix: str) -> KeptFile:
        """Return the file for what was computed from a file.

        Args:
            path: the file; its path, size, time stamps and inode are part of the name.
            what: folder for what is stored.
            settings: plain values that it depends on.
            suffix: of the name.
        """
        try:
            stated = path.stat()
            folder = user_cache_folder()
        except OSError:
            return KeptFile(None)
        state = [str(resolved(path)), stated.st_size, stated.st_mtime_ns, stated.st_ctime_ns, stated.st_ino]
        return KeptFile(folder / "pano-mvs" / what / f"{digest_from_value([state, settings])}{suffix}")

    def read(self) -> bytes:
        """Return the contents; none if nothing was stored."""
        if self.path is not None:
            with suppress(OSError):
                return read_regular(self.path)
        return b""

    def write(self, data: bytes) -> None:
        """Store contents; a folder that cannot be written costs only time."""
        if self.path is not None:
            with suppress(OSError, StoreError), replacing(self.path) as temporary:
                temporary.write_bytes(data)
