"""List plugins and stages, and describe a stage."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from pydantic_core import PydanticUndefined
from rich.markup import escape
from rich.table import Table

from pano_mvs.cli.console import Console
from pano_mvs.core.errors import UsageError, WorkflowError
from pano_mvs.engine.stages.registry import Plugin, Registry
from pano_mvs.engine.stages.stage import StageSpec
from pano_mvs.engine.workflows.policy import RESERVED_KEYS
from pano_mvs.engine.workflows.workflow import find_workflow, load_workflow
from pano_mvs.session.session import presets_folder


def show_plugins(console: Console, *, workflow: str | None = None, files: Sequence[Path] = ()) -> None:
    """List all plugins, broken ones included, then all stages, then the parts that plugins add.

    Args:
        workflow: a workflow whose plugin files are listed too.
        files: more plugin files.
    """
    registry, _ = _registry(workflow, files)
    found = Table("plugin", "", "gives")
    for plugin in registry.plugins:
        found.add_row(escape(plugin.origin), "[red]broken[/]" if plugin.error else "ok", _gives(plugin))
    console.print(found)
    table = Table("stage", "version", "from", "")
    for name, spec in sorted(registry.stages.items()):
        doc = spec.doc.splitlines()[0] if spec.doc else ""
        table.add_row(name, str(spec.version), escape(registry.origins[name]), escape(doc))
    console.print(table)
    for (kind, name), mark in sorted(registry.registrations.items()):
        console.print(f"{kind} [bold]{escape(name)}[/] from {escape(mark.origin)}", highlight=False)
    for clash in registry.clashes.values():
        console.say(f"[red]twice:[/] {escape(clash)}")
    for plugin in registry.broken:
        console.say(f"[red]broken:[/] {escape(plugin.why_broken())}")


def show_stage(name: str, console: Console, *, workflow: str | None = None, files: Sequence[Path] = ()) -> None:
    """Show a stage's documentation, typed ports and settings.

    Args:
        workflow: a workflow whose plugin files may define it.
        files: more plugin files that may define it.
    """
    registry, mistakes = _registry(workflow, files)
    spec = registry.stages.get(name)
    if spec is None:
        if mistakes is not None:
            raise mistakes
        raise UsageError(f"there is no stage {name!r}; {registry.suggest(name)}")
    console.print(f"[bold]{name}[/] version {spec.version} from {escape(registry.origins[name])}", highlight=False)
    console.print(escape(spec.doc), highlight=False)
    for port in spec.all_ports:
        console.print(escape(f"  in   {port}"), highlight=False)
    console.print(escape(f"  out  {spec.output.kind_name()}"), highlight=False)
    console.print(_settings(spec))
    console.print(f"and for every stage: {', '.join(RESERVED_KEYS)}", highlight=False)


def _settings(spec: StageSpec) -> Table:
    table = Table("setting", "type", "default", "")
    properties = spec.params_type.model_json_schema()["properties"] if spec.params_type.model_fields else {}
    for field_name, field in spec.params_type.model_fields.items():
        schema = properties.get(field_name, {})
        default = "required" if field.default is PydanticUndefined else json.dumps(field.default, default=str)
        table.add_row(field_name, escape(_type_name(schema)), escape(default), escape(field.description or ""))
    return table


def _registry(workflow: str | None, files: Sequence[Path]) -> tuple[Registry, WorkflowError | None]:
    """Return the registry with the plugins of a workflow and of files, and the mistakes in the workflow."""
    registry = Registry.installed()
    for path in files:
        registry.add_file(path)
    if workflow is None:
        return registry, None
    try:
        load_workflow(find_workflow(workflow, presets_folder())[0], registry, presets=presets_folder())
    except WorkflowError as error:  # the plugins can be shown nevertheless
        return registry, error
    return registry, None


def _gives(plugin: Plugin) -> str:
    stages = [name for kind, name in plugin.names if kind == "stage"]
    others = [f"{kind} {name}" for kind, name in plugin.names if kind != "stage"]
    counted = [f"{len(stages)} stages"] if len(stages) > 3 else stages
    return escape(", ".join([*counted, *others]))


def _type_name(schema: dict[str, object]) -> str:
    if "enum" in schema:
        options = schema["enum"]
        return " | ".join(map(str, options)) if isinstance(options, list) else str(options)
    if "anyOf" in schema and isinstance(schema["anyOf"], list):
        return " | ".join(_type_name(option) for option in schema["anyOf"])
    return str(schema.get("const", schema.get("type", "")))
