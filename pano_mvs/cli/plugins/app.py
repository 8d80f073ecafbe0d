"""`pano-mvs plugins`, `plugin new` and `stage show`: the typer side of show and plugin_new."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pano_mvs.cli.completion import complete_plugin_kind, complete_stage_kind
from pano_mvs.cli.console import Console
from pano_mvs.cli.error_messages import guarded

plugin_app = typer.Typer(help="Write plugins.", no_args_is_help=True)
stage_app = typer.Typer(help="Look at one stage.", no_args_is_help=True)

WorkflowOption = Annotated[
    str | None,
    typer.Option("--workflow", help="Also what the plugin files of this workflow define.", show_default=False),
]
FileOption = Annotated[
    list[Path] | None,
    typer.Option("--plugin", metavar="FILE", help="Also what a plugin file defines; may be given repeatedly."),
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
        str, typer.Argument(help="A stage's name, such as depth.sweep.", autocompletion=complete_stage_kind)
    ],
    workflow: WorkflowOption = None,
    files: FileOption = None,
) -> None:
    """Show a stage's ports, settings and documentation; of a broken one, why it cannot be loaded."""
    from pano_mvs.cli.plugins.show import show_stage

    show_stage(name, Console(), workflow=workflow, files=files or [])


@plugin_app.command("new")
@guarded
def plugin_new(
    kind: Annotated[
        str,
        typer.Argument(
            help="What it is to be; `pano-mvs plugin kinds` lists the kinds.", autocompletion=complete_plugin_kind
        ),
    ],
    name: Annotated[str, typer.Argument(help="A word of small letters, digits and '_'.")],
    folder: Annotated[Path, typer.Option("--dir", help="Where to write the file and its test.")] = Path(),
) -> None:
    """Write a working plugin of a kind, NAME.py, and its test, test_NAME.py."""
    from pano_mvs.cli.plugins.new import write_plugin

    write_plugin(kind, name, folder, Console())


@plugin_app.command("kinds")
@guarded
def plugin_kinds() -> None:
    """List the kinds of plugins that `plugin new` writes."""
    from pano_mvs.cli.plugins.new import show_kinds

    show_kinds(Console())
