"""Where compiled kernels are kept: a folder of the user's, named by what the kernels' source says.

numba notices an edit of the file that holds a kernel, but not of the files that it calls, and installed files may all
carry the same time stamp. A folder named by the digest of all kernel files is right whatever happened to them, and
works where the package itself cannot be written.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

from pano_mvs.core.digest import digest_from_value

VARIABLE = "NUMBA_CACHE_DIR"


def use_kernel_cache(package: Path) -> None:
    """Point numba to the folder for the kernels below a package, unless the user has chosen one.

    Args:
        package: folder in which the kernel files, `kernels_*.py`, lie; to be called before any of them is imported.
    """
    if VARIABLE in os.environ:
        return
    folder = str(kernel_cache_folder(package))
    os.environ[VARIABLE] = folder  # also for processes that we start
    numba = sys.modules.get("numba")
    if numba is not None:
        numba.config.CACHE_DIR = folder


def kernel_cache_folder(package: Path) -> Path:
    """Return the folder for the kernels below a package as they are now."""
    sources = {str(path.relative_to(package)): path.read_bytes() for path in sorted(package.rglob("kernels_*.py"))}
    return user_cache_folder() / "pano-mvs" / "kernels" / digest_from_value(sources)[:16]


def user_cache_folder() -> Path:
    """Return the folder for caches that this system gives to each user."""
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local")
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
