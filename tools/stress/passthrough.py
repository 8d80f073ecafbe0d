"""A file system in user space that shows a folder at another place, and stalls or fails while a file says so.

`python passthrough.py FOLDER PLACE FLAG`: as long as the file FLAG exists, every operation waits; if its content is
`fail`, every operation fails with EIO, as those of a network file system that has lost its server do. It ends when it
is unmounted.
"""

from __future__ import annotations

import errno
import importlib
import os
import sys
import time
from pathlib import Path
from typing import Any

mfusepy: Any = importlib.import_module("mfusepy")  # mypy need not have it


class Passthrough(mfusepy.Operations):  # type: ignore[misc]
    """Passes everything on to a folder."""

    use_ns = True

    def __init__(self, folder: Path, flag: Path) -> None:
        self._folder, self._flag = folder, flag

    def _at(self, path: str) -> Path:
        """Return where something is, after waiting or failing if the flag says so."""
        while self._flag.exists():
            if self._flag.read_text() == "fail":
                raise mfusepy.FuseOSError(errno.EIO)
            time.sleep(0.02)
        return self._folder / path.lstrip("/")

    def getattr(self, path: str, fh: int | None = None) -> dict[str, int]:
        found = self._at(path).lstat()
        times = {f"st_{name}time": getattr(found, f"st_{name}time_ns") for name in "amc"}
        names = ("st_mode", "st_nlink", "st_size", "st_uid", "st_gid", "st_ino", "st_blocks")
        return times | {name: getattr(found, name) for name in names}

    def readdir(self, path: str, fh: int) -> list[str]:
        return [".", "..", *(entry.name for entry in self._at(path).iterdir())]

    def statfs(self, path: str) -> dict[str, int]:
        found = os.statvfs(self._at(path))
        return {name: getattr(found, name) for name in dir(found) if name.startswith("f_") and name != "f_fsid"}

    def open(self, path: str, flags: int) -> int:
        return os.open(self._at(path), flags)

    def create(self, path: str, mode: int, fi: Any = None) -> int:
        return os.open(self._at(path), os.O_RDWR | os.O_CREAT | os.O_EXCL, mode)

    def read(self, path: str, size: int, offset: int, fh: int) -> bytes:
        self._at(path)
        return os.pread(fh, size, offset)

    def write(self, path: str, data: bytes, offset: int, fh: int) -> int:
        self._at(path)
        return os.pwrite(fh, data, offset)

    def truncate(self, path: str, length: int, fh: int | None = None) -> None:
        os.truncate(self._at(path), length)

    def release(self, path: str, fh: int) -> None:
        os.close(fh)

    def fsync(self, path: str, datasync: int, fh: int) -> None:
        self._at(path)
        os.fsync(fh)

    def unlink(self, path: str) -> None:
        self._at(path).unlink()

    def rmdir(self, path: str) -> None:
        self._at(path).rmdir()

    def mkdir(self, path: str, mode: int) -> None:
        self._at(path).mkdir(mode)

    def rename(self, old: str, new: str) -> None:
        self._at(old).rename(self._at(new))

    def link(self, target: str, source: str) -> None:
        self._at(target).hardlink_to(self._at(source))

    def chmod(self, path: str, mode: int) -> None:
        self._at(path).chmod(mode)

    def utimens(self, path: str, times: tuple[int, int] | None = None) -> None:
        os.utime(self._at(path), ns=times) if times else os.utime(self._at(path))


if __name__ == "__main__":
    mfusepy.FUSE(Passthrough(Path(sys.argv[1]), Path(sys.argv[3])), sys.argv[2], foreground=True)
