"""Where compiled kernels are kept: a folder of the user's, named by what the kernels' source says.

numba notices an edit of the file that holds a kernel, but not of the files that it calls, and installed files may all
carry the same time stamp. A folder named by the digest of all kernel files is right whatever happened to them, and
works where the package itself cannot be written.
"""

from __future__ import annotations

import atexit
import errno
import os
import shutil
import stat
import sys
import tempfile
from pathlib import Path

from pano_mvs.core.digest import digest_from_value
from pano_mvs.core.paths import below, exists, home_folder, is_folder

VARIABLE = "NUMBA_CACHE_DIR"

_PLACES = {"win32": ("LOCALAPPDATA", "AppData/Local"), "darwin": ("", "Library/Caches")}


def use_kernel_cache(package: Path) -> None:
    """Point numba to the folder for the kernels below a package, unless the user has chosen one.

    Args:
        package: folder in which the kernel files, `kernels_*.py`, lie; to be called before any of them is imported.
    """
    if VARIABLE in os.environ:
        return
    try:
        folder = str(kernel_cache_folder(package))
    except OSError:  # numba fails at the first kernel if it finds no folder at all
        folder = tempfile.mkdtemp(prefix="pano-mvs-kernels-")
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
    os.environ[VARIABLE] = folder  # also for processes that we start
    numba = sys.modules.get("numba")
    if numba is not None:
        numba.config.CACHE_DIR = folder


def kernel_cache_folder(package: Path) -> Path:
    """Return the folder for the kernels below a package as they are now.

    Raises:
        OSError: if the user has no folder for caches that can be written.
    """
    sources = {str(path.relative_to(package)): path.read_bytes() for path in below(package, "kernels_*.py")}
    return user_cache_folder() / "pano-mvs" / "kernels" / digest_from_value(sources)[:16]


def user_cache_folder() -> Path:
    """Return the folder for caches that this system gives to each user, if it can be written.

    Raises:
        OSError: if there is none.
    """
    variable, below_home = _PLACES.get(sys.platform, ("XDG_CACHE_HOME", ".cache"))
    given, home = os.environ.get(variable), home_folder()
    places = [Path(given)] if given else []
    places += [] if home is None else [home / below_home]
    for place in places:
        if _can_be_made(place):
            return place
    return _own_temporary_folder()


def _own_temporary_folder() -> Path:
    """Return a folder that stays between runs, and in which nobody else can leave code for us to execute.

    Raises:
        OSError: if there is none.
    """
    if sys.platform != "win32":
        folder = Path(tempfile.gettempdir()) / f"pano-mvs-{os.getuid()}"
        folder.mkdir(mode=0o700, exist_ok=True)
        info = folder.lstat()
        if stat.S_ISDIR(info.st_mode) and info.st_uid == os.getuid() and not info.st_mode & 0o077:
            return folder
    raise OSError(errno.EACCES, "you have no folder for caches that can be written")


def _can_be_made(folder: Path) -> bool:
    """Return whether a folder can be written, or made in the nearest one above it that exists."""
    there = next((path for path in (folder, *folder.absolute().parents) if exists(path)), None)
    return there is not None and is_folder(there) and os.access(there, os.W_OK | os.X_OK)
