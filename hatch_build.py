"""Put the bundled plugins, plugins/*, into the distribution pano-mvs, with their packages and their entry points.

A bundled plugin has a pyproject.toml like that of any other plugin, with `bundled = true` under `[tool.pano_mvs]`.
Whoever deletes its folder builds a distribution without it; nothing else names it.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface
from hatchling.metadata.plugin.interface import MetadataHookInterface

# The core's stages come in through the same door as anybody's plugin.
_CORE = {"pano_mvs.plugins": {"builtin": "pano_mvs.stages"}}


def bundled(root: Path) -> Iterator[tuple[Path, dict[str, Any]]]:
    """Yield the folder of each bundled plugin, and what its pyproject.toml says."""
    for file in sorted((root / "plugins").glob("*/pyproject.toml")):
        project = tomllib.loads(file.read_text(encoding="utf-8"))
        if project.get("tool", {}).get("pano_mvs", {}).get("bundled"):
            yield file.parent, project


def packages_of(root: Path) -> dict[str, Path]:
    """Return the packages of the bundled plugins, by name."""
    return {
        name: folder / name
        for folder, project in bundled(root)
        for name in project["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]
    }


def entry_points_of(root: Path) -> dict[str, dict[str, str]]:
    """Return the entry points of the core and the bundled plugins, by group and name."""
    groups = {group: dict(entries) for group, entries in _CORE.items()}
    for folder, project in bundled(root):
        for group, entries in project["project"].get("entry-points", {}).items():
            known = groups.setdefault(group, {})
            if twice := known.keys() & entries.keys():
                raise ValueError(f"{folder}: {group} {', '.join(twice)} is an entry point of another bundled plugin")
            known.update(entries)
    return groups


class EntryPoints(MetadataHookInterface):
    """Adds the entry points."""

    PLUGIN_NAME = "custom"

    def update(self, metadata: dict[str, Any]) -> None:
        """Set the entry points of the project."""
        metadata["entry-points"] = entry_points_of(Path(self.root))


class Packages(BuildHookInterface):  # type: ignore[type-arg]
    """Adds the packages."""

    PLUGIN_NAME = "custom"

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Include the packages; an editable installation gets the folders that hold them instead."""
        packages = packages_of(Path(self.root))
        if self.target_name != "wheel" or not packages:
            return
        if version == "editable":
            file = Path(self.directory) / "_pano_mvs_plugins.pth"
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text("\n".join(str(path.parent) for path in packages.values()) + "\n", encoding="utf-8")
            build_data["force_include_editable"][str(file)] = file.name
        else:
            build_data["force_include"].update({str(path): name for name, path in packages.items()})
