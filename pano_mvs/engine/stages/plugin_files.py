"""Find plugin files, and the names that they declare, without importing them."""

from __future__ import annotations

import importlib.util
import os
import re
import sys
from collections.abc import Iterable, Mapping
from importlib.metadata import EntryPoint
from pathlib import Path

from pano_mvs.core.paths import below, children, home_folder

PLUGINS_VARIABLE = "PANO_MVS_PLUGINS"

# Declarations are found in the text, because a broken file may have no syntax tree.
_DECLARATION = re.compile(r"""^[ \t]*@(?:\w+\.)*(stage|source|register_\w+)\(\s*["']([^"'\n]+)["']""", re.MULTILINE)


def user_plugin_folders(environment: Mapping[str, str] = os.environ) -> list[Path]:
    """Return the folders of the user's plugins: those in $PANO_MVS_PLUGINS, or else the one among the user's settings.

    The variable holds folders separated as in PATH; if it is empty, there are none. Without the variable the folder is
    `pano-mvs/plugins` in $XDG_CONFIG_HOME or ~/.config (Linux), ~/Library/Application Support (macOS), or %APPDATA%
    (Windows). Relative folders depend on where the command is run; the caller must refuse them.
    """
    variable = environment.get(PLUGINS_VARIABLE)
    if variable is not None:
        return [Path(folder) for folder in variable.split(os.pathsep) if folder]
    settings = _settings_folder(environment)
    return [] if settings is None else [settings / "pano-mvs" / "plugins"]


def plugin_files_in(folder: Path) -> list[Path]:
    """Return the plugin files in a folder, by name: all Python files except tests and names that begin with _."""
    files = children(folder, "*.py")
    return [file for file in files if not file.name.startswith(("_", ".", "test_")) and file.name != "conftest.py"]


def declared_names(text: str) -> list[tuple[str, str]]:
    """Return the names that a source text declares: ("stage", name), or the kind and name of a registration."""
    return [
        ("stage" if what in ("stage", "source") else what.removeprefix("register_").replace("_", " "), name)
        for what, name in _DECLARATION.findall(text)
    ]


def names_in_files(files: Iterable[Path]) -> tuple[tuple[str, str], ...]:
    """Return the names that files declare, as far as they can be read."""
    found: list[tuple[str, str]] = []
    for file in files:
        try:
            found.extend(declared_names(file.read_text(encoding="utf-8", errors="replace")))
        except OSError:
            continue  # it is listed as broken anyway; only its names stay unknown
    return tuple(found)


def names_in_package(entry: EntryPoint) -> tuple[tuple[str, str], ...]:
    """Return the names that the package behind an entry point declares, without importing it."""
    try:
        spec = importlib.util.find_spec(entry.module.partition(".")[0])
    except (ImportError, ValueError):
        return ()
    if spec is None:
        return ()
    folders = [Path(folder) for folder in spec.submodule_search_locations or ()]
    files = [file for folder in folders for file in below(folder, "*.py")]
    return names_in_files(files if folders else [Path(spec.origin)] if spec.origin else [])


def _settings_folder(environment: Mapping[str, str]) -> Path | None:
    """Return the folder for user settings, or None if there is none."""
    home = home_folder()
    if sys.platform == "win32":
        given = Path(environment.get("APPDATA") or "")
        return given if given.is_absolute() else home and home / "AppData" / "Roaming"
    if sys.platform == "darwin":
        return home and home / "Library" / "Application Support"
    given = Path(environment.get("XDG_CONFIG_HOME") or "")
    return given if given.is_absolute() else home and home / ".config"
