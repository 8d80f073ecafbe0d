"""`pano-mvs plugins`, `plugin new` and `stage show`: list plugins and stages, describe a stage, write a plugin."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape
from rich.table import Table

from pano_mvs.cli.commands import PluginGroup
from pano_mvs.cli.completion import complete_plugin_kind, complete_stage_kind
from pano_mvs.cli.console import Console, print_json
from pano_mvs.cli.endings import guarded
from pano_mvs.core.errors import UsageError, WorkflowError

if TYPE_CHECKING:  # a command loads what it needs itself
    from pano_mvs.cli.plugins.listing import PluginRow
    from pano_mvs.engine.stages.registry import Registry
    from pano_mvs.engine.stages.stage import StageSpec

plugin_app = typer.Typer(cls=PluginGroup, help="Create and manage plugins.", no_args_is_help=True)
stage_app = typer.Typer(help="Describe a stage.", no_args_is_help=True)

WorkflowOption = Annotated[
    str | None,
    typer.Option("--workflow", help="Include the plugins of this workflow.", show_default=False),
]
FileOption = Annotated[
    list[Path] | None,
    typer.Option("--plugin", metavar="FILE", help="Include this plugin file; can be repeated."),
]


@guarded
def plugins(
    workflow: WorkflowOption = None,
    files: FileOption = None,
    *,
    check: Annotated[
        bool,
        typer.Option("--check", help="Also load what plugins offer beside stages; exit code 2 if anything is broken."),
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """List all plugins with their origin, whether they can be loaded, and what they bring."""
    from pano_mvs.cli.plugins.listing import broken_reasons, entry_problems, plugin_rows

    registry, _ = _registry(workflow, files or [])
    problems = entry_problems(check=check)
    rows, broken = plugin_rows(registry, problems), broken_reasons(registry, problems)
    if as_json:
        _print_plugins(rows, registry, broken)
    else:
        _show_plugins(rows, registry, broken)
    if check and (broken or registry.clashes):
        raise typer.Exit(UsageError.exit_code)


def _print_plugins(rows: Mapping[str, PluginRow], registry: Registry, broken: Sequence[str]) -> None:
    """Print all plugins as JSON."""
    stages = [
        {"stage": name, "version": spec.version, "from": registry.origins[name], "summary": _summary(spec)}
        for name, spec in sorted(registry.stages.items())
    ]
    plugins = [row.to_json(origin) for origin, row in rows.items()]
    problems = [*registry.clashes.values(), *dict.fromkeys(broken)]
    print_json({"plugins": plugins, "stages": stages, "problems": problems})


def _show_plugins(rows: Mapping[str, PluginRow], registry: Registry, broken: Sequence[str]) -> None:
    """Print all plugins as tables, and what is wrong with them."""
    from pano_mvs.cli.plugins.listing import plugin_table

    console = Console()
    console.show(plugin_table(rows))
    table = Table("stage", "version", "from", "")
    for name, spec in sorted(registry.stages.items()):
        table.add_row(name, str(spec.version), escape(registry.origins[name]), escape(_summary(spec)))
    console.show(table)
    for (kind, name), mark in sorted(registry.registrations.items()):
        console.print(f"{kind} [bold]{escape(name)}[/] from {escape(mark.origin)}", highlight=False)
    for clash in registry.clashes.values():
        console.say(f"[red]twice:[/] {escape(clash)}")
    for reason in dict.fromkeys(broken):
        console.say(f"[red]broken:[/] {escape(reason)}")


def _summary(spec: StageSpec) -> str:
    return spec.doc.splitlines()[0] if spec.doc else ""


@stage_app.command("show")
@guarded
def stage_show(
    name: Annotated[
        str, typer.Argument(help="Name of the stage, such as depth.sweep.", autocompletion=complete_stage_kind)
    ],
    workflow: WorkflowOption = None,
    files: FileOption = None,
) -> None:
    """Show the ports, settings and documentation of a stage, or why it cannot be loaded."""
    from pano_mvs.engine.workflows.policy import RESERVED_KEYS

    console, (registry, mistakes) = Console(), _registry(workflow, files or [])
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
    from pydantic_core import PydanticUndefined

    table = Table("setting", "type", "default", "")
    properties = spec.params_type.model_json_schema()["properties"] if spec.params_type.model_fields else {}
    for field_name, field in spec.params_type.model_fields.items():
        schema = properties.get(field_name, {})
        default = "required" if field.default is PydanticUndefined else json.dumps(field.default, default=str)
        table.add_row(field_name, escape(_type_name(schema)), escape(default), escape(field.description or ""))
    return table


def _registry(workflow: str | None, files: Sequence[Path]) -> tuple[Registry, WorkflowError | None]:
    """Return the registry with the plugins of a workflow and of files, and the mistakes in the workflow."""
    from pano_mvs.engine.stages.registry import Registry
    from pano_mvs.engine.workflows.workflow import find_workflow, load_workflow
    from pano_mvs.session.session import presets_folder

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


def _type_name(schema: dict[str, object]) -> str:
    if "enum" in schema:
        options = schema["enum"]
        return " | ".join(map(str, options)) if isinstance(options, list) else str(options)
    if "anyOf" in schema and isinstance(schema["anyOf"], list):
        return " | ".join(_type_name(option) for option in schema["anyOf"])
    return str(schema.get("const", schema.get("type", "")))


@plugin_app.command("new")
@guarded
def plugin_new(
    context: typer.Context,
    kind: Annotated[
        str,
        typer.Argument(help="Kind of plugin; `pano-mvs plugin kinds` lists them.", autocompletion=complete_plugin_kind),
    ],
    name: Annotated[str, typer.Argument(help="Name of the plugin: lower-case letters, digits and '_'.")],
    folder: Annotated[Path, typer.Option("--dir", help="Folder for the file and its test.")] = Path(),
    environment: Annotated[
        str,
        typer.Option(
            "--environment",
            metavar="KIND",
            help="Write a package, NAME, that asks for a Python environment of its own: overlay or isolated.",
            show_default=False,
        ),
    ] = "",
) -> None:
    """Write a working plugin, NAME.py, and its test, test_NAME.py."""
    from pano_mvs.cli.plugins.new import write_plugin

    commands = context.find_root().command
    write_plugin(kind, name, folder, commands=commands, console=Console(), environment=environment)


@plugin_app.command("kinds")
@guarded
def plugin_kinds() -> None:
    """List the kinds of plugins that `plugin new` writes."""
    from pano_mvs.cli.plugins.new import show_kinds

    show_kinds(Console())
