"""Build environments: an interpreter, the same pano_mvs as here, the plugin and its requirements.

Both kinds of environment import pano_mvs from the place where this process found it, so that it is always the same. An
overlay also sees the libraries of this installation, behind its own.
"""

from __future__ import annotations

import importlib.util
import os
import shutil
import sys
import sysconfig
from collections.abc import Iterator, Sequence
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

import pano_mvs
from pano_mvs.core.doors import DISTRIBUTION, own_packages
from pano_mvs.core.errors import InputError, PluginError, UsageError
from pano_mvs.core.files import make_folder
from pano_mvs.core.paths import is_folder, resolved
from pano_mvs_environments.index import MARK, Mode
from pano_mvs_environments.interpreter import run_command
from pano_mvs_environments.sources import PluginSource

_LINK = "_pano_mvs_installation"
_LINK_CODE = '''\
"""Written by `pano-mvs plugin install`: imports pano_mvs from the installation that this environment belongs to."""

import importlib.util
import os
import site
import sys

PACKAGES = {packages!r}
BEHIND = {behind!r}


class Finder:
    """Finds the packages of pano_mvs."""

    @staticmethod
    def find_spec(name, path=None, target=None):
        """Return where a package is; None for all others."""
        folder = PACKAGES.get(name)
        if folder is None:
            return None
        file = os.path.join(folder, "__init__.py")
        return importlib.util.spec_from_file_location(name, file, submodule_search_locations=[folder])


sys.meta_path.insert(0, Finder)
for place in BEHIND:
    site.addsitedir(place)
'''


def python_in(folder: Path) -> Path:
    """Return the interpreter of the environment in a folder."""
    return Path(_place(folder, "scripts")) / ("python.exe" if os.name == "nt" else "python")


def _place(folder: Path, kind: str) -> str:
    return sysconfig.get_path(kind, "venv", vars={"base": str(folder), "platbase": str(folder)})


def build(folder: Path, source: PluginSource, mode: Mode) -> None:
    """Build an environment in a folder that does not exist; the caller removes it if this fails.

    Raises:
        InputError: if it cannot be made, with the reason of the program that installs packages.
        OSError: if the folder cannot be written.
    """
    uv = shutil.which("uv") if mode == "isolated" else None
    python = python_in(folder)
    # It has the mark as soon as it is there, so that an interrupted installation is known as such.
    marked = folder.with_name(f".{MARK}")
    make_folder(marked)
    (marked / MARK).touch()
    marked.rename(folder)
    try:
        if uv is not None:
            run_command([uv, "venv", "--quiet", "--allow-existing", "--python", sys.executable, str(folder)])
        else:
            run_command([sys.executable, "-P", "-m", "venv", "--without-pip", str(folder)])
        _link(folder, mode)
        same = f"{DISTRIBUTION}=={pano_mvs.__version__}"
        run_command([*installer(python, uv), same, source.requirement])
    except PluginError as error:
        raise InputError(
            f"the environment of {source.name} cannot be made; nothing was changed:\n{error}\nCorrect the requirements "
            f"in {source.shown}, or what the message names, and run the same command again"
        ) from error


def _link(folder: Path, mode: Mode) -> None:
    """Let an environment import pano_mvs, and, if it is an overlay, what else is installed here."""
    packages, place = Path(_place(folder, "purelib")), _place_of
    make_folder(packages)
    linked = {name: found for name in sorted(own_packages()) if (found := place(name))}
    behind = list(_behind()) if mode == "overlay" else []
    (packages / f"{_LINK}.py").write_text(_LINK_CODE.format(packages=linked, behind=behind), encoding="utf-8")
    (packages / f"{_LINK}.pth").write_text(f"import {_LINK}\n", encoding="utf-8")
    if mode == "isolated":
        _copy_metadata(packages)


def _place_of(package: str) -> str:
    """Return the folder of a package of this process; "" if it is not found."""
    spec = importlib.util.find_spec(package)
    return str(resolved(Path(spec.origin)).parent) if spec is not None and spec.origin else ""


def _behind() -> Iterator[str]:
    """Yield the folders on the path of this process, without those of the standard library."""
    standard = {Path(sysconfig.get_path(name)) for name in ("stdlib", "platstdlib")}
    standard |= {place / "lib-dynload" for place in standard} | {Path(sys.base_prefix, "DLLs")}
    for place in map(Path, filter(None, sys.path)):
        if is_folder(place) and place not in standard:
            yield str(place.absolute())


def _copy_metadata(packages: Path) -> None:
    """Copy what is known of the distribution of pano_mvs, from which its entry points and requirements are read.

    Raises:
        UsageError: if it is not installed.
    """
    try:
        found = distribution(DISTRIBUTION)
    except PackageNotFoundError as error:
        raise UsageError(
            f"{DISTRIBUTION} runs from a folder, without being installed, so that its requirements are not known: pip "
            "install it"
        ) from error
    folder = packages / f"{DISTRIBUTION.replace('-', '_')}-{found.version}.dist-info"
    make_folder(folder)
    for name in ("METADATA", "entry_points.txt"):
        (folder / name).write_text(found.read_text(name) or "", encoding="utf-8")
    (folder / "INSTALLER").write_text(f"{DISTRIBUTION}\n", encoding="ascii")
    (folder / "RECORD").write_text("", encoding="ascii")


def installer(python: Path, uv: str | None) -> Sequence[str]:
    """Return the command that installs packages for an interpreter.

    Raises:
        PluginError: if there is none.
    """
    if uv is not None:
        return uv, "pip", "install", "--quiet", "--python", str(python)
    options = ("install", "--no-input", "--disable-pip-version-check", "--no-warn-script-location", "--quiet")
    if importlib.util.find_spec("pip") is not None:
        return sys.executable, "-P", "-m", "pip", "--python", str(python), *options
    run_command([str(python), "-I", "-m", "ensurepip"])
    return str(python), "-I", "-m", "pip", *options
