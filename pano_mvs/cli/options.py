"""Options that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pano_mvs.cli.completion import complete_setting, complete_stage, complete_workflow

WorkflowArgument = Annotated[
    str,
    typer.Argument(
        metavar="WORKFLOW", help="A workflow file, or the name of a preset.", autocompletion=complete_workflow
    ),
]
ImagesOption = Annotated[Path | None, typer.Option("--images", help="Folder of panoramas to use instead.")]
SetOption = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="STAGE.PARAM=VALUE", help="Change a setting.", autocompletion=complete_setting),
]
CacheOption = Annotated[Path | None, typer.Option("--cache", help="Folder of the cache.")]
OutOption = Annotated[Path | None, typer.Option("--out", help="Folder of the results; default out/<workflow>.")]
UntilOption = Annotated[
    list[str] | None,
    typer.Option("--until", metavar="STAGE", help="Only this stage and what it needs.", autocompletion=complete_stage),
]
OnlyOption = Annotated[
    list[str] | None,
    typer.Option("--only", metavar="STAGE:ITEM", help="Only this unit and what it needs."),
]
RefreshOption = Annotated[
    list[str] | None,
    typer.Option(
        "--refresh",
        metavar="STAGE[:ITEM]",
        help="Compute it again though it is cached.",
        autocompletion=complete_stage,
    ),
]
MinFreeOption = Annotated[
    str,
    typer.Option(
        "--min-free",
        metavar="SIZE",
        help="Room on the cache's disk below which nothing is begun, such as 5GB; 200MB.",
        show_default=False,
    ),
]
DurableOption = Annotated[
    bool, typer.Option("--durable", help="Flush all results to the disk at once, for machines that lose power.")
]
AcceptOption = Annotated[
    bool, typer.Option("--accept-code", help="Keep what was computed before code or libraries changed.")
]
