"""Options of `pano-mvs plugins`, `plugin new` and `stage show`; `show` and `new` do the work."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pano_mvs.cli.completion import complete_plugin_kind, complete_stage_kind
from pano_mvs.cli.console import Console
from pano_mvs.cli.error_messages import guarded

plugin_app = typer.Typer(help="Create plugins.", no_args_is_help=True)
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
def plugins(workflow: WorkflowOption = None, files: FileOption = None) -> None:
    """List all plugins with their origin, whether they can be loaded, and their stages."""
    from pano_mvs.cli.plugins.show import show_plugins

    show_plugins(Console(), workflow=workflow, files=files or [])


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
    from pano_mvs.cli.plugins.show import show_stage

    show_stage(name, Console(), workflow=workflow, files=files or [])


@plugin_app.command("new")
@guarded
def plugin_new(
    kind: Annotated[
        str,
        typer.Argument(help="Kind of plugin; `pano-mvs plugin kinds` lists them.", autocompletion=complete_plugin_kind),
    ],
    name: Annotated[str, typer.Argument(help="Name of the plugin: lower-case letters, digits and '_'.")],
    folder: Annotated[Path, typer.Option("--dir", help="Folder for the file and its test.")] = Path(),
) -> None:
    """Write a working plugin, NAME.py, and its test, test_NAME.py."""
    from pano_mvs.cli.plugins.new import write_plugin

    write_plugin(kind, name, folder, console=Console())


@plugin_app.command("kinds")
@guarded
def plugin_kinds() -> None:
    """List the kinds of plugins that `plugin new` writes."""
    from pano_mvs.cli.plugins.new import show_kinds

    show_kinds(Console())
