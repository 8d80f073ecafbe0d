"""The world around a run: a disk that fills up, a wrong clock, a file system that stalls, a limit of memory.

What this machine or this user cannot have raises `ImpossibleHereError`.
"""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from tools.stress.bad_items import FULL_VARIABLE

_CLOCK = r"""
#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <stdlib.h>
#include <sys/time.h>
#include <time.h>
#include <unistd.h>

static long shift_s(void) {
    char text[32] = {0};
    int file = open(getenv("CLOCK_SHIFT"), O_RDONLY);
    if (file < 0) return 0;
    if (read(file, text, sizeof text - 1) < 0) text[0] = 0;
    close(file);
    return atol(text);
}

int clock_gettime(clockid_t clock, struct timespec *now) {
    static int (*real)(clockid_t, struct timespec *);
    if (!real) real = dlsym(RTLD_NEXT, "clock_gettime");
    int code = real(clock, now);
    if (!code && clock == CLOCK_REALTIME) now->tv_sec += shift_s();
    return code;
}

time_t time(time_t *place) {
    struct timespec now;
    clock_gettime(CLOCK_REALTIME, &now);
    if (place) *place = now.tv_sec;
    return now.tv_sec;
}

int gettimeofday(struct timeval *restrict now, void *restrict zone) {
    struct timespec exact;
    clock_gettime(CLOCK_REALTIME, &exact);
    now->tv_sec = exact.tv_sec;
    now->tv_usec = exact.tv_nsec / 1000;
    return 0;
}
"""


_ROOMY = "size=8g,nr_inodes=1000000"
_LOOK_S = 0.2


class ImpossibleHereError(Exception):
    """This machine or this user cannot have what a fault needs."""


class Disk:
    """A disk that can be full: a small one that grows, or one that the plugin plays."""

    def __init__(self, folder: Path, *, mounted: bool) -> None:
        self.folder = folder
        self.is_mounted = mounted
        self._flag = folder.with_suffix(".full")
        self.environment = os.environ | {"COLUMNS": "400"} | ({} if mounted else {FULL_VARIABLE: str(self._flag)})

    def fill_after(self, records: int, process: subprocess.Popen[bytes]) -> None:
        """Fill the disk when so many records are stored, or when the process has ended."""
        while process.poll() is None and _count(self.folder / "cache" / "records") < records:
            time.sleep(_LOOK_S)
        self.fill()

    def fill(self, *, inodes: bool = False) -> None:
        """Leave no room for bytes, or for further files."""
        if not self.is_mounted:
            self._flag.touch()
        # It cannot become smaller than what is in it, and that grows until it has become so.
        while self.is_mounted and not _mount(self.folder, f"remount,{self._used(inodes=inodes)}"):
            time.sleep(0.01)

    def grow(self) -> None:
        """Make room."""
        if self.is_mounted:
            _mount(self.folder, f"remount,{_ROOMY}")
        else:
            self._flag.unlink()

    def _used(self, *, inodes: bool) -> str:
        found = os.statvfs(self.folder)
        files, size_bytes = found.f_files - found.f_ffree, (found.f_blocks - found.f_bfree) * found.f_frsize
        return f"nr_inodes={files}" if inodes else f"size={size_bytes + 4096}"


@contextmanager
def small_disk(folder: Path) -> Iterator[Disk]:
    """Mount a disk that can be filled, where we may."""
    folder.mkdir()
    mounted = os.name == "posix" and os.geteuid() == 0 and _mount(folder, _ROOMY)
    try:
        yield Disk(folder, mounted=mounted)
    finally:
        if mounted:
            subprocess.run(["umount", "-l", str(folder)], check=True)


def _mount(folder: Path, options: str) -> bool:
    return _does_mount("-t", "tmpfs", "-o", options, "tmpfs", str(folder))


def _does_mount(*arguments: str) -> bool:
    return subprocess.run(["mount", *arguments], capture_output=True, check=False).returncode == 0


def _count(folder: Path) -> int:
    return sum(len(files) for _, _, files in os.walk(folder))


@dataclass
class Clock:
    """The clock of some processes, which differs from that of the system and of its files."""

    folder: Path

    @property
    def environment(self) -> dict[str, str]:
        """What the processes need."""
        return {"LD_PRELOAD": str(self.folder / "clock.so"), "CLOCK_SHIFT": str(self.folder / "shift")}

    def shift(self, seconds: float) -> None:
        """Set it to the time of the system and so much more."""
        (self.folder / "new").write_text(str(int(seconds)))
        (self.folder / "new").replace(self.folder / "shift")


def make_clock(folder: Path) -> Clock:
    """Return a clock, with its files in a new folder."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None or not sys.platform.startswith("linux"):
        raise ImpossibleHereError("needs Linux and a C compiler")
    folder.mkdir()
    (folder / "clock.c").write_text(_CLOCK)
    command = [compiler, "-shared", "-fPIC", "-o", str(folder / "clock.so"), str(folder / "clock.c"), "-ldl"]
    subprocess.run(command, check=True)
    clock = Clock(folder)
    clock.shift(10**6)
    told = subprocess.run(
        [sys.executable, "-c", "import time; print(time.time())"],
        env=os.environ | clock.environment,
        capture_output=True,
        check=True,
    ).stdout
    assert abs(float(told) - time.time() - 10**6) < 1000, "the clock of the process is not ours"
    clock.shift(0)
    return clock


@contextmanager
def unsteady(folder: Path, flag: Path) -> Iterator[Path]:
    """Yield another place of a folder, which stalls or fails as a file says; see `passthrough`."""
    if importlib.util.find_spec("mfusepy") is None or not Path("/dev/fuse").exists():
        raise ImpossibleHereError("needs /dev/fuse, libfuse and the package mfusepy")
    place = folder.with_name(f"{folder.name}-unsteady")
    place.mkdir()
    command = [sys.executable, str(Path(__file__).with_name("passthrough.py")), str(folder), str(place), str(flag)]
    server = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    try:
        while not os.path.ismount(place):
            if server.poll() is not None:
                raise ImpossibleHereError("no file system in user space can be mounted")
            time.sleep(0.02)
        yield place
    finally:
        flag.unlink(missing_ok=True)
        subprocess.run(["umount", "-l", str(place)], check=False, capture_output=True)
        server.wait(10)


@contextmanager
def read_only(folder: Path) -> Iterator[None]:
    """Let a folder be read-only while the context lasts."""
    if not _does_mount("--bind", str(folder), str(folder)):
        raise ImpossibleHereError("needs the right to mount")
    try:
        # Refused while a file is open for writing that was opened since the line above.
        for _ in range(200):
            if _does_mount("-o", "remount,ro,bind", str(folder)):
                break
            time.sleep(0.02)
        else:
            raise ImpossibleHereError("needs the right to mount read-only")
        yield
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


@contextmanager
def memory_limit(size_bytes: int) -> Iterator[Path]:
    """Yield the `cgroup.procs` of a new control group whose processes the system kills if they take more memory."""
    root = Path("/sys/fs/cgroup")
    group = (root / "memory" if (root / "memory").is_dir() else root) / f"stress-{uuid.uuid4().hex}"
    try:
        group.mkdir()
        name = "memory.limit_in_bytes" if (group / "memory.limit_in_bytes").exists() else "memory.max"
        (group / name).write_text(str(size_bytes))
    except OSError as error:
        raise ImpossibleHereError("needs the right to make a control group with a limit of memory") from error
    try:
        yield group / "cgroup.procs"
    finally:
        group.rmdir()
