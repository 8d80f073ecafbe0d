"""Whether the built-in stages, the presets, and everybody's plugins are there."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from pathlib import Path

from pano_mvs.cli.doctor.finding import Finding
from pano_mvs.core.paths import children, is_folder
from pano_mvs.core.text import plural
from pano_mvs.engine.stages.plugin_files import PLUGINS_VARIABLE, plugin_files_in, user_plugin_folders
from pano_mvs.engine.stages.registry import Registry

_BUILTIN = "source.folder"


def plugin_findings(
    registry: Registry, presets: Path, environment: Mapping[str, str] = os.environ
) -> Iterator[Finding]:
    """Yield how the plugins are that were found, and what the folders of plugins hold.

    Args:
        registry: what was found.
        presets: folder of the shipped workflows.
        environment: the variables.
    """
    if _BUILTIN in registry.stages:
        count = len(registry.plugins)
        yield Finding("plugins", "stages", "ok", f"{len(registry.stages)}, from {count} "
                      f"{plural(count, 'package or file', 'packages and files')}")  # fmt: skip
    else:
        yield Finding("plugins", "stages", "failed", "the built-in stages are not registered",
                      "pip install --force-reinstall pano-mvs, or pip install -e . in a checkout")  # fmt: skip
    found = [path.stem for path in children(presets, "*.yaml")]
    if "quickstart" in found:
        yield Finding("plugins", "presets", "ok", ", ".join(found))
    else:
        yield Finding("plugins", "presets", "failed", f"no workflows in {presets}",
                      "pip install --force-reinstall pano-mvs")  # fmt: skip
    for plugin in registry.broken:
        stages = [name for kind, name in plugin.names if kind == "stage"]
        command = f"pano-mvs stage show {stages[0]}" if stages else "pano-mvs plugins"
        yield Finding("plugins", plugin.origin, "warning", f"failed to load: {plugin.error}",
                      f"mend or remove it; `{command}` shows more")  # fmt: skip
    for (kind, name), why in registry.clashes.items():
        yield Finding("plugins", f"{kind} {name}", "warning", why, "until then nobody can use it")
    yield from _folders(environment)


def _folders(environment: Mapping[str, str]) -> Iterator[Finding]:
    for folder in user_plugin_folders(environment):
        if PLUGINS_VARIABLE not in environment and not is_folder(folder):
            continue  # few people have the folder of their settings
        files = len(plugin_files_in(folder))
        if not is_folder(folder):
            yield Finding("plugins", PLUGINS_VARIABLE, "warning", f"{folder} is no folder", f"mend {PLUGINS_VARIABLE}")
        else:
            yield Finding("plugins", str(folder), "ok" if files else "note", f"{files} plugin {plural(files, 'file')}")
