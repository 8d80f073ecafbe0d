"""DiskGuard on the disk of a store: how much must be free to begin, and how a full disk is told from a fault of a unit."""

from __future__ import annotations

import errno
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pano_mvs.core.errors import StoreError
from pano_mvs.core.files import temporary_prefix

_FULL = {errno.ENOSPC, getattr(errno, "EDQUOT", errno.ENOSPC), errno.EFBIG}
_NOTHING_LEFT_BYTES = 1_000_000


class DiskGuard:
    """The disk under a store."""

    def __init__(self, root: Path, *, least_free_bytes: int) -> None:
        """Remember which store it is, and below how many free bytes no unit is begun."""
        self._root = root
        self._least_free_bytes = least_free_bytes

    def require(self) -> None:
        """Raise StoreError if there is too little room to begin anything."""
        free = self._free_bytes()
        if free < self._least_free_bytes:
            raise StoreError(
                f"{free / 1e6:.0f} MB are free where the cache {self._root} is, {self._least_free_bytes / 1e6:.0f} MB "
                "are kept (--min-free). Make room (`pano-mvs cache gc` shows what can go) and run the same command "
                "again: what was finished is kept"
            )

    @contextmanager
    def scratch(self, parent: Path) -> Iterator[Path]:
        """Yield an empty folder, removed afterwards.

        Raises:
            StoreError: if the disk is too full to begin, or was filled by what was done inside.
        """
        self.require()
        try:
            parent.mkdir(parents=True, exist_ok=True)
            folder = Path(tempfile.mkdtemp(dir=parent, prefix=temporary_prefix()))
        except OSError as error:
            raise self.cannot_write(error) from error
        try:
            yield folder
            # A library that does not check what it writes may have cut a file short on a full disk: keep nothing.
            if self._is_full():
                raise self._full()
        except StoreError:
            raise
        except Exception as error:
            # Libraries tell of a full disk in many ways: an error without a number, one of their own, none at all.
            if is_full_disk(error) or self._is_full():
                raise self._full() from error
            raise
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    def cannot_write(self, error: OSError) -> StoreError:
        """Return the error that says that the store cannot be written."""
        if is_full_disk(error):
            return self._full()
        return StoreError(f"cache {self._root} cannot be written: {error.strerror or error}. Mend it, or choose "
                          "another with --cache DIR")  # fmt: skip

    def _is_full(self) -> bool:
        return self._free_bytes() < _NOTHING_LEFT_BYTES

    def _free_bytes(self) -> int:
        try:
            return shutil.disk_usage(self._root).free
        except OSError as error:
            raise StoreError(f"cache {self._root} cannot be read: {error.strerror}. Mend it, or choose another with "
                             "--cache DIR")  from error  # fmt: skip

    def _full(self) -> StoreError:
        return StoreError(f"the disk of the cache {self._root} is full, or what you may use of it. Make room "
                          "(`pano-mvs cache gc` shows what can go) and run the same command again: what was finished "
                          "is kept")  # fmt: skip


def is_full_disk(error: BaseException | None) -> bool:
    """Return whether an error of the system says that the disk, or what one may use of it, is full."""
    return isinstance(error, OSError) and error.errno in _FULL
