"""Check the built-in stages, the presets and the installed plugins."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path

from pano_mvs.cli.doctor.finding import Finding
from pano_mvs.core.paths import children, is_folder
from pano_mvs.core.text import plural
from pano_mvs.engine.stages.plugin_files import PLUGINS_VARIABLE, plugin_files_in, user_plugin_folders
from pano_mvs.engine.stages.registry import Registry

_BUILTIN = "source.folder"
_REINSTALL = "pip install --force-reinstall pano-mvs"
_finding = partial(Finding, "plugins")


def plugin_findings(
    registry: Registry, presets: Path, environment: Mapping[str, str] = os.environ
) -> Iterator[Finding]:
    """Yield the state of the stages, the presets, the plugins and the folders of plugins.

    Args:
        registry: the stages and plugins that were found.
        presets: the folder of the shipped workflows.
        environment: the environment variables.
    """
    if _BUILTIN in registry.stages:
        count = len(registry.plugins)
        origins = f"{count} {plural(count, 'package or file', 'packages and files')}"
        yield _finding("stages", "ok", f"{len(registry.stages)}, from {origins}")
    else:
        remedy = f"{_REINSTALL}, or pip install -e . in a checkout"
        yield _finding("stages", "failed", "the built-in stages are not registered", remedy)
    workflows = [path.stem for path in children(presets, "*.yaml")]
    if "quickstart" in workflows:
        yield _finding("presets", "ok", ", ".join(workflows))
    else:
        yield _finding("presets", "failed", f"no workflows in {presets}", _REINSTALL)
    for plugin in registry.broken:
        stages = [name for kind, name in plugin.names if kind == "stage"]
        command = f"pano-mvs stage show {stages[0]}" if stages else "pano-mvs plugins"
        remedy = f"correct or remove it; `{command}` shows more"
        yield _finding(plugin.origin, "warning", f"failed to load: {plugin.error}", remedy)
    for (kind, name), why in registry.clashes.items():
        yield _finding(f"{kind} {name}", "warning", why, "it cannot be used until this is resolved")
    for folder in user_plugin_folders(environment):
        files = len(plugin_files_in(folder))
        if is_folder(folder):
            yield _finding(str(folder), "ok" if files else "note", f"{files} plugin {plural(files, 'file')}")
        elif PLUGINS_VARIABLE in environment:  # the default folder is optional
            yield _finding(PLUGINS_VARIABLE, "warning", f"{folder} is not a folder", f"correct {PLUGINS_VARIABLE}")
