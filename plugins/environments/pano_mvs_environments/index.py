"""The index of environments: one small file, from which a process knows the stages without importing a plugin."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from shlex import quote
from typing import Any, Literal, TypeAlias

import pano_mvs
from pano_mvs.core.digest import digest_from_value
from pano_mvs.core.errors import PluginError, StoreError, UsageError
from pano_mvs.core.files import make_folder, write_text
from pano_mvs.core.kernel_cache import user_cache_folder
from pano_mvs.core.locks import locked
from pano_mvs.core.paths import exists, is_file, reason_of
from pano_mvs.core.plugin_folders import user_settings_folder
from pano_mvs.engine.stages.registry import PluginProblem

Mode: TypeAlias = Literal["overlay", "isolated"]
MODES: tuple[Mode, ...] = ("overlay", "isolated")
VARIABLE = "PANO_MVS_ENVIRONMENTS"
INDEX_NAME = "environments.json"
MARK = "pano-mvs-environment"
"""An empty file in the folder of each environment, by which its own processes know that they run in it."""

FORMAT = 1
"""Raise this if entries of the index, or what `inside` answers, change their form."""


@dataclass(frozen=True, slots=True)
class Environment:
    """A plugin that is installed in an environment of its own."""

    name: str  # of the plugin's distribution
    version: str
    mode: Mode
    source: str  # what it was installed from: a path, or a requirement
    folder: str  # of the environment
    python: str  # its interpreter
    python_version: str
    pano_mvs: str  # version that it was made with
    installation: str  # prefix of the installation of pano_mvs that it belongs to
    digest: str  # of what it was made from
    stages: tuple[Mapping[str, Any], ...]  # what `inside` says of each stage
    libraries: Mapping[str, str]  # module to version, of the libraries in the environment itself

    @property
    def origin(self) -> str:
        """The plugin as messages show it."""
        return f"{self.name} {self.version}"

    @property
    def remedy(self) -> str:
        """What makes the environment again."""
        return f"run `pano-mvs plugin install {quote(self.source)}`, which makes it again"

    def problem(self) -> PluginProblem | None:
        """Return why it cannot be used, as far as this is known at a glance; None if it can."""
        if not is_file(Path(self.python)):
            gone = f"has no interpreter {self.python}" if exists(Path(self.folder)) else f"{self.folder} was removed"
            return PluginProblem(f"its environment {gone}", self.remedy)
        made, here = (self.pano_mvs, self.python_version), (pano_mvs.__version__, sys.version.split()[0])
        for what, old, new in zip(("pano_mvs", "Python"), made, here, strict=True):
            if old.split(".")[:2] != new.split(".")[:2] or (what == "pano_mvs" and old != new):
                return PluginProblem(f"its environment was made for {what} {old}, and this is {new}", self.remedy)
        return None

    def to_json(self) -> dict[str, Any]:
        """Return the entry of the index."""
        return {one.name: getattr(self, one.name) for one in fields(self)}

    @staticmethod
    def from_json(value: Mapping[str, Any]) -> Environment:
        """Return the environment of an entry of the index."""
        return Environment(**{**value, "stages": tuple(value["stages"])})


def environments_folder() -> Path:
    """Return the folder of the environments of an index, in the user's cache.

    Raises:
        UsageError: if `PANO_MVS_ENVIRONMENTS` is set to nothing, or to a relative path.
        StoreError: if there is no folder that can be written.
    """
    given = os.environ.get(VARIABLE)
    if given is not None:
        return _given(given)
    try:
        return user_cache_folder() / "pano-mvs" / "environments" / digest_from_value(str(index_file()))[:8]
    except OSError as error:
        raise StoreError(
            f"there is no folder for environments ({reason_of(error)}). Set {VARIABLE} to one that is writable"
        ) from error


def index_file() -> Path | None:
    """Return the index: among the user's settings, as a cache may be cleaned; None if there can be none."""
    given = os.environ.get(VARIABLE)
    if given is not None:
        return _given(given) / INDEX_NAME if given else None
    settings = user_settings_folder()
    return None if settings is None else settings / INDEX_NAME


def _given(text: str) -> Path:
    if not text:
        raise UsageError(f"{VARIABLE} is empty, so that no plugin can have an environment; unset it, or name a folder")
    folder = Path(text)
    if not folder.is_absolute():
        raise UsageError(f"{VARIABLE} holds {text!r}, which is not an absolute path")
    return folder


def environments() -> list[Environment]:
    """Return the environments of this installation of pano_mvs.

    Raises:
        PluginError: if the index cannot be read.
    """
    return [one for one in _all() if one.installation == sys.prefix]


def _all() -> list[Environment]:
    path = index_file()
    if path is None:
        return []
    try:
        text = path.read_bytes()
    except (FileNotFoundError, NotADirectoryError):
        return []
    except OSError as error:
        raise PluginError(f"{path} cannot be read ({reason_of(error)}): correct its permissions") from error
    remedy = f"Remove {path}, and install the plugins with environments of their own again"
    try:
        found = json.loads(text)
        if found["format"] != FORMAT:
            raise PluginError(f"{path} was written by another version of pano_mvs. {remedy}")
        return [Environment.from_json(entry) for entry in found["environments"]]
    except (ValueError, KeyError, TypeError) as error:
        raise PluginError(f"{path} is damaged ({type(error).__name__}: {error}). {remedy}") from error


def enter(environment: Environment) -> None:
    """Enter an environment in the index, in the place of that of the same plugin; the caller holds the lock."""
    _write([*_others(environment.name), environment])


def leave(name: str) -> None:
    """Remove the environment of a plugin from the index; the caller holds the lock."""
    _write(_others(name))


def _others(name: str) -> list[Environment]:
    """Return all environments but that of a plugin, and those of installations that are gone."""
    mine = name, sys.prefix
    return [one for one in _all() if exists(Path(one.installation)) and (one.name, one.installation) != mine]


def _write(found: Sequence[Environment]) -> None:
    path = index_file()
    if path is None:
        raise UsageError(f"there is no folder for the settings of this user; set {VARIABLE} to a folder")
    text = json.dumps({"format": FORMAT, "environments": [one.to_json() for one in found]}, indent=1)
    write_text(path, text, durable=True)


def folders_in_use() -> set[Path]:
    """Return the folders of all environments in the index, of any installation."""
    return {Path(one.folder) for one in _all()}


@contextmanager
def sole_installation(on_wait: Any = None) -> Iterator[Path]:
    """Yield the folder of the environments, in which no other process installs or removes one meanwhile.

    Args:
        on_wait: called without arguments if another process does so at present.

    Raises:
        StoreError: if the folder cannot be written.
    """
    folder = environments_folder()
    try:
        make_folder(folder)
        with locked(folder / ".lock", on_wait=on_wait):
            yield folder
    except OSError as error:
        if isinstance(error, StoreError | PluginError):
            raise
        where = error.filename or folder
        raise StoreError(
            f"{where} cannot be written: {reason_of(error)}. Free some space or correct the permissions, or set "
            f"{VARIABLE} to another folder"
        ) from error


def installed_environment(name: str) -> Environment | None:
    """Return the environment of a plugin, by any spelling of its name."""
    wanted = canonical(name)
    return next((one for one in environments() if canonical(one.name) == wanted), None)


def canonical(name: str) -> str:
    """Return the name of a distribution in the form in which names are compared."""
    return name.lower().replace("_", "-").replace(".", "-")
