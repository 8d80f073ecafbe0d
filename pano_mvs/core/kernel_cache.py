"""The folder for compiled kernels: one of the user's, named after a digest of the kernels' source.

numba notices an edit of the file that holds a kernel, but not of the files of the kernels that it calls, and installed
files may all have the same time stamp. A folder named after the digest of all kernel files is always right, and works
if the package itself cannot be written.
"""

from __future__ import annotations

import atexit
import errno
import os
import shutil
import stat
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from pano_mvs.core.digest import digest_from_value
from pano_mvs.core.paths import below, exists, home_folder, is_folder

VARIABLE = "NUMBA_CACHE_DIR"
PACKAGE = Path(__file__).parent.parent  # the folder of `pano_mvs`, whose kernels are cached
_PLACES = {"win32": ("LOCALAPPDATA", "AppData/Local"), "darwin": ("", "Library/Caches")}


@dataclass(slots=True)
class CompilationTime:
    """Time that this process has spent on compiling kernels, waiting for another that does, and loading them."""

    seconds: float = 0.0


compilation_time = CompilationTime()


def use_kernel_cache(package: Path = PACKAGE) -> None:
    """Set numba's cache folder for the kernels in a package, unless the user has set one.

    Packages with kernels call this when they are imported, before any of their kernels is; later calls do nothing.

    Args:
        package: folder that contains the kernel files, `kernels_*.py`, and of their decorators, `core/kernels.py`.
    """
    if VARIABLE in os.environ:
        return
    try:
        folder = str(kernel_cache_folder(package))
    except OSError:  # without any folder numba fails at the first kernel
        folder = tempfile.mkdtemp(prefix="pano-mvs-kernels-")
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
    os.environ[VARIABLE] = folder  # also for processes that we start
    numba = sys.modules.get("numba")
    if numba is not None:
        numba.config.CACHE_DIR = folder


def kernel_cache_folder(package: Path = PACKAGE) -> Path:
    """Return the cache folder for the present kernels of a package.

    Raises:
        OSError: if the user has no writable folder for caches.
    """
    return user_cache_folder() / "pano-mvs" / "kernels" / kernels_digest(package)


def kernels_digest(package: Path = PACKAGE) -> str:
    """Return a digest of all kernel files of a package."""
    sources = {str(path.relative_to(package)): path.read_bytes() for path in below(package, "kernels*.py")}
    return digest_from_value(sources)[:16]


def count_compiled() -> int:
    """Return how many kernels all processes together have compiled into the cache."""
    return sum(1 for _ in _compiled())


def must_compile() -> bool:
    """Return whether no kernel of this version has been compiled on this machine, which the first run does."""
    return os.environ.get("NUMBA_DISABLE_JIT", "0") in ("", "0") and next(_compiled(), None) is None


def _compiled() -> Iterator[str]:
    """Yield the names of the files of compiled kernels."""
    folder = os.environ.get(VARIABLE)
    # Observers of runs count them every second; `Path.rglob` takes three times as long.
    for _, _, names in os.walk(folder) if folder else ():
        yield from (name for name in names if name.endswith(".nbi"))


def user_cache_folder() -> Path:
    """Return the user's folder for caches, or else a folder of their own for temporary files.

    Raises:
        OSError: if neither can be written.
    """
    variable, below_home = _PLACES.get(sys.platform, ("XDG_CACHE_HOME", ".cache"))
    given, home = os.environ.get(variable), home_folder()
    places = [Path(given)] if given else []
    places += [] if home is None else [home / below_home]
    for place in places:
        there = next((path for path in (place, *place.absolute().parents) if exists(path)), None)
        if there is not None and is_folder(there) and os.access(there, os.W_OK | os.X_OK):
            return place
    return _own_temporary_folder()


def _own_temporary_folder() -> Path:
    """Return a folder that stays between runs and that nobody else can write to, as it holds code that we execute."""
    if sys.platform != "win32":
        folder = Path(tempfile.gettempdir()) / f"pano-mvs-{os.getuid()}"
        folder.mkdir(mode=0o700, exist_ok=True)
        info = folder.lstat()
        if stat.S_ISDIR(info.st_mode) and info.st_uid == os.getuid() and not info.st_mode & 0o077:
            return folder
    raise OSError(errno.EACCES, "there is no writable folder for caches")
