"""The folders of a user's own plugin files, and the files in them."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from pathlib import Path

from pano_mvs.core.paths import children, home_folder

PLUGINS_VARIABLE = "PANO_MVS_PLUGINS"


def user_plugin_folders(environment: Mapping[str, str] = os.environ) -> list[Path]:
    """Return the folders of the user's plugins: those in $PANO_MVS_PLUGINS, or else the one among the user's settings.

    The variable holds folders separated as in PATH; if it is empty, there are none. Without the variable the folder is
    `pano-mvs/plugins` in $XDG_CONFIG_HOME or ~/.config (Linux), ~/Library/Application Support (macOS), or %APPDATA%
    (Windows). Relative folders depend on where the command is run; the caller must refuse them.
    """
    variable = environment.get(PLUGINS_VARIABLE)
    if variable is not None:
        return [Path(folder) for folder in variable.split(os.pathsep) if folder]
    settings = user_settings_folder(environment)
    return [] if settings is None else [settings / "plugins"]


def user_settings_folder(environment: Mapping[str, str] = os.environ) -> Path | None:
    """Return the folder of the user's settings of pano_mvs, which need not exist; None for a user without a home."""
    home = home_folder()
    if sys.platform == "win32":
        given = Path(environment.get("APPDATA") or "")
        settings = given if given.is_absolute() else home and home / "AppData" / "Roaming"
    elif sys.platform == "darwin":
        settings = home and home / "Library" / "Application Support"
    else:
        given = Path(environment.get("XDG_CONFIG_HOME") or "")
        settings = given if given.is_absolute() else home and home / ".config"
    return None if settings is None else settings / "pano-mvs"


def plugin_files_in(folder: Path) -> list[Path]:
    """Return the plugin files in a folder, by name: all Python files except tests and names that begin with _."""
    files = children(folder, "*.py")
    return [file for file in files if not file.name.startswith(("_", ".", "test_")) and file.name != "conftest.py"]
