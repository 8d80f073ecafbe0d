"""Free space on the disk of a cache: the minimum for starting a unit, and the recognition of a full disk."""

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
_FULL_BELOW_BYTES = 1_000_000


class DiskGuard:
    """Watches the disk that holds a cache."""

    def __init__(self, root: Path, *, min_free_bytes: int) -> None:
        """Watch the disk of the folder `root`; no unit starts with less than `min_free_bytes` free."""
        self._root = root
        self._min_free_bytes = min_free_bytes

    def require(self) -> None:
        """Raise StoreError if there is too little free space to start a unit."""
        free = self._free_bytes()
        if free < self._min_free_bytes:
            raise StoreError(
                f"{free / 1e6:.0f} MB are free on the disk of the cache {self._root}, but "
                f"{self._min_free_bytes / 1e6:.0f} MB must stay free (--min-free). Make room (`pano-mvs cache gc` "
                "shows what can be deleted) and run the same command again: finished units stay in the cache"
            )

    @contextmanager
    def scratch(self, parent: Path) -> Iterator[Path]:
        """Yield an empty folder, removed afterwards.

        Raises:
            StoreError: if the disk is too full to start, or becomes full inside the context.
        """
        self.require()
        try:
            parent.mkdir(parents=True, exist_ok=True)
            folder = Path(tempfile.mkdtemp(dir=parent, prefix=temporary_prefix()))
        except OSError as error:
            raise self.cannot_write(error) from error
        try:
            yield folder
            # A library that does not check its writes may have truncated a file on a full disk: keep nothing.
            if self._is_full():
                raise self._full()
        except StoreError:
            raise
        except Exception as error:
            # Libraries report a full disk in many ways: errors without a number, errors of their own, or not at all.
            if is_full_disk(error) or self._is_full():
                raise self._full() from error
            raise
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    def cannot_write(self, error: OSError) -> StoreError:
        """Return the error for a cache that cannot be written."""
        if is_full_disk(error):
            return self._full()
        return StoreError(
            f"cache {self._root} cannot be written: {error.strerror or error}. Check its permissions, "
            "or choose another cache with --cache DIR"
        )

    def _is_full(self) -> bool:
        return self._free_bytes() < _FULL_BELOW_BYTES

    def _free_bytes(self) -> int:
        try:
            return shutil.disk_usage(self._root).free
        except OSError as error:
            raise StoreError(
                f"cache {self._root} cannot be read: {error.strerror}. Check its permissions, or choose another cache "
                "with --cache DIR"
            ) from error

    def _full(self) -> StoreError:
        return StoreError(
            f"the disk of the cache {self._root} is full, or your quota is used up. Make room (`pano-mvs cache gc` "
            "shows what can be deleted) and run the same command again: finished units stay in the cache"
        )


def is_full_disk(error: BaseException | None) -> bool:
    """Return whether a system error means that the disk is full or a quota is used up."""
    return isinstance(error, OSError) and error.errno in _FULL
