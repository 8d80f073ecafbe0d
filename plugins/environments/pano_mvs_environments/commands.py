"""`pano-mvs plugin install` and `pano-mvs plugin remove`."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.markup import escape

from pano_mvs.cli.console import Console, print_json
from pano_mvs.cli.endings import guarded

JsonOption = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]


@guarded
def install(
    source: Annotated[
        str,
        typer.Argument(
            metavar="PATH|NAME", help="Folder with a pyproject.toml, wheel or archive, or the name of a package."
        ),
    ],
    environment: Annotated[
        str,
        typer.Option(
            "--environment",
            metavar="KIND",
            help="Environment for it: overlay, isolated, or none. Default: what its pyproject.toml asks for.",
            show_default=False,
        ),
    ] = "",
    force: Annotated[
        bool, typer.Option("--force", help="Build its environment again, even if nothing has changed.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Install a plugin: in an environment of its own if it asks for one, otherwise beside pano_mvs."""
    from pano_mvs_environments.install import install_plugin

    console = Console(stderr=True)

    def waits() -> None:
        console.say("another process is installing a plugin; waiting until it has ended …")

    with console.status(f"installing {escape(source)} …"):
        found = install_plugin(source, environment=environment, force=force, on_wait=waits)
    if as_json:
        print_json(found.to_json())
        return
    console, shown = Console(), f"{escape(found.name)} {escape(found.version)}"
    if found.environment == "none":
        console.say(f"installed {shown} beside pano_mvs")
        return
    what = "installed" if found.is_new else "nothing has changed:"
    console.say(f"{what} {shown} in an environment of its own ({found.environment}): {escape(found.folder)}")
    console.say(f"stages: {escape(', '.join(found.stages))}")


@guarded
def remove(
    name: Annotated[str, typer.Argument(help="Name of the plugin's package; `pano-mvs plugins` lists them.")],
    as_json: JsonOption = False,
) -> None:
    """Remove a plugin that is installed as a package, with its environment if it has one."""
    from pano_mvs_environments.install import remove_plugin

    found = remove_plugin(name)
    if as_json:
        print_json(found.to_json())
        return
    where = "with its environment" if found.environment != "none" else "from beside pano_mvs"
    Console().say(f"removed {escape(found.name)} {escape(found.version)} {where}")
