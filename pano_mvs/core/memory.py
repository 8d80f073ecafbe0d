"""Memory of this host, and sizes such as "2GB"."""

from __future__ import annotations

import ctypes
import os
import re
import subprocess
import sys
from pathlib import Path

from pano_mvs.core.errors import RunStoppedError

_UNITS = {
    "": 1,
    "B": 1,
    "KB": 10**3,
    "MB": 10**6,
    "GB": 10**9,
    "TB": 10**12,
    "KIB": 2**10,
    "MIB": 2**20,
    "GIB": 2**30,
    "TIB": 2**40,
}
MAX_BYTES = 2**63  # more than any address space holds
_LIBRARIES_BYTES = 10**9  # address space that a process takes which has loaded the libraries: 0.8 GB on Linux
_SIZE = re.compile(r"\s*(\d+(?:\.\d+)?)\s*([a-zA-Z]*)\s*")


def bytes_from_size(size: str | int) -> int:
    """Return the bytes of a size such as `2GB`, `1.5 GiB` or a number of bytes.

    Raises:
        ValueError: if the text is not a size, or more than `MAX_BYTES`.
    """
    match = _SIZE.fullmatch(str(size))
    if match is None or match[2].upper() not in _UNITS:
        raise ValueError("must be a size such as 500MB, 2GB or 1.5GiB")
    size_bytes = float(match[1]) * _UNITS[match[2].upper()]
    if size_bytes > MAX_BYTES:
        raise ValueError(f"must be at most {size_text(MAX_BYTES)}")
    return int(size_bytes)


def size_text(size_bytes: int) -> str:
    """Return a size as text, such as 1.3 GB."""
    size, unit = float(size_bytes), "B"
    for larger in ("kB", "MB", "GB", "TB"):
        if size >= 1000:
            size, unit = size / 1000, larger
    return f"{size:.0f} B" if unit == "B" else f"{size:.1f} {unit}"


def free_memory_bytes() -> int:
    """Return the memory that can be used without swapping, within the limit of a container; 0 if unknown."""
    found = [size for size in (_free_of_system(), _free_of_container()) if size]
    return min(found, default=0)


def total_memory_bytes() -> int:
    """Return the memory of this host, or of the container if that is less; 0 if unknown."""
    found = [size for size in (_total_of_system(), _limit_of_container()) if size]
    return min(found, default=0)


def require_address_space() -> None:
    """Refuse a limit of the address space (`ulimit -v`) below which some libraries never end to load.

    Raises:
        RunStoppedError: if the limit is smaller.
    """
    if sys.platform == "win32":
        return
    import resource

    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    if limit != resource.RLIM_INFINITY and limit < _LIBRARIES_BYTES:
        raise RunStoppedError(
            f"each process may use at most {size_text(limit)} of address space (`ulimit -v`), but the libraries alone "
            f"need up to {size_text(_LIBRARIES_BYTES)} of memory addresses. Raise the limit, such as with "
            "`ulimit -v unlimited`"
        )


def _free_of_system() -> int:
    if sys.platform == "win32":
        return _of_windows(2)
    if sys.platform == "darwin":
        # macOS fills free memory with cached files, so that its figure says little: most of the memory is available.
        return _total_of_system() * 3 // 4
    return _of_meminfo("MemAvailable")


def _total_of_system() -> int:
    if sys.platform == "win32":
        return _of_windows(1)
    if sys.platform == "darwin":
        found = subprocess.run(["/usr/sbin/sysctl", "-n", "hw.memsize"], capture_output=True, check=False).stdout
        return int(found) if found.strip().isdigit() else 0
    return _of_meminfo("MemTotal")


def _of_meminfo(field: str) -> int:
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        return next((int(line.split()[1]) * 1024 for line in lines if line.startswith(f"{field}:")), 0)
    except (OSError, ValueError):
        return 0


_CONTAINER = Path("/sys/fs/cgroup")


def _limit_of_container() -> int:
    """Return the memory limit of the container; 0 without one."""
    try:
        limit = (_CONTAINER / "memory.max").read_text(encoding="ascii").strip()
        return 0 if limit == "max" else int(limit)
    except (OSError, ValueError):
        return 0


def _free_of_container() -> int:
    limit = _limit_of_container()
    if not limit:
        return 0
    try:
        used = int((_CONTAINER / "memory.current").read_text(encoding="ascii"))
        lines = (_CONTAINER / "memory.stat").read_text(encoding="ascii").splitlines()
        files = sum(int(line.split()[1]) for line in lines if line.startswith("inactive_file "))
        return max(1, limit - used + files)  # memory of cached files is released when needed
    except (OSError, ValueError):
        return 0


def _of_windows(field: int) -> int:
    status = (ctypes.c_ulonglong * 8)()  # MEMORYSTATUSEX: two 32-bit fields, then seven of 64 bits
    ctypes.memmove(status, ctypes.byref(ctypes.c_uint32(ctypes.sizeof(status))), 4)
    kernel = getattr(ctypes, "windll").kernel32  # noqa: B009 (exists on Windows alone)
    return int(status[field]) if os.name == "nt" and kernel.GlobalMemoryStatusEx(status) else 0
