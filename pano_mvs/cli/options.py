"""Options that several commands share."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Annotated, Literal, get_type_hints

import typer

from pano_mvs.cli.completion import complete_setting, complete_stage, complete_workflow


def takes_record(command: Callable[..., None]) -> Callable[..., None]:
    """Let a command with many options take them as one record, whose fields typer reads as those of a function.

    The record is the command's first argument; others are passed on.
    """
    record = next(iter(get_type_hints(command).values()))
    own = inspect.signature(record).parameters.keys()

    def take(**values: object) -> None:
        command(record(**{name: values.pop(name) for name in own}), **values)

    take.__name__, take.__doc__ = command.__name__, command.__doc__
    take.__annotations__ = hints = get_type_hints(record, include_extras=True)
    fields = [field.replace(annotation=hints[name]) for name, field in inspect.signature(record).parameters.items()]
    take.__signature__ = inspect.Signature(fields)  # type: ignore[attr-defined]
    return take


WorkflowArgument = Annotated[
    str,
    typer.Argument(
        metavar="WORKFLOW", help="A workflow file or the name of a preset.", autocompletion=complete_workflow
    ),
]
TargetArgument = Annotated[
    str,
    typer.Argument(
        metavar="WORKFLOW|OUT",
        help="A workflow file, the name of a preset, or the output folder of a run.",
        autocompletion=complete_workflow,
    ),
]
ImagesOption = Annotated[
    Path | None,
    typer.Option(
        "--images",
        help="Folder of panoramas or of a virtual tour, or a video; default: that of the workflow.",
    ),
]
SetOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set", metavar="STAGE.PARAM=VALUE", help="Change a setting; can be repeated.", autocompletion=complete_setting
    ),
]
CacheOption = Annotated[
    Path | None,
    typer.Option(
        "--cache", help="Folder of the cache; default: $PANO_MVS_CACHE, or .pano-mvs beside the workflow file."
    ),
]
OutOption = Annotated[Path | None, typer.Option("--out", help="Output folder; default: out/<workflow>.")]
UntilOption = Annotated[
    list[str] | None,
    typer.Option(
        "--until",
        metavar="STAGE|GROUP",
        help="Run only this stage, or this group of stages, and the stages that it needs.",
        autocompletion=complete_stage,
    ),
]
# Options by the panel of the help in which they are listed.
_unit_option = partial(typer.Option, rich_help_panel="Selection of units")
OnlyOption = Annotated[
    list[str] | None,
    _unit_option("--only", metavar="STAGE:ITEM", help="Run only this unit and the units that it needs."),
]
RefreshOption = Annotated[
    list[str] | None,
    _unit_option(
        "--refresh",
        metavar="STAGE[:ITEM]",
        help="Recompute this stage, group of stages or unit even if it is cached.",
        autocompletion=complete_stage,
    ),
]
KeepOption = Annotated[
    Literal["all"] | None,
    typer.Option(
        "--keep",
        rich_help_panel="Disk and messages",
        help="Keep the results of temporary stages, too: all; default: drop them when nothing reads them any more.",
        show_default=False,
    ),
]
AcceptOption = Annotated[
    bool, _unit_option("--accept-code", help="Reuse results that were computed before code or libraries changed.")
]
