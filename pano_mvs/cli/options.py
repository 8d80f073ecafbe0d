"""Options that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Optional

import typer

WorkflowArgument = Annotated[str, typer.Argument(metavar="WORKFLOW", help="A workflow file, or the name of a preset.")]
ImagesOption = Annotated[Optional[Path], typer.Option("--images", help="Folder of panoramas to use instead.")]  # noqa: UP045
SetOption = Annotated[Optional[list[str]], typer.Option("--set", metavar="STAGE.PARAM=VALUE", help="Change a setting.")]  # noqa: UP045
CacheOption = Annotated[Optional[Path], typer.Option("--cache", help="Folder of the cache.")]  # noqa: UP045
OutOption = Annotated[Optional[Path], typer.Option("--out", help="Folder of the results; default out/<workflow>.")]  # noqa: UP045
UntilOption = Annotated[
    Optional[list[str]],  # noqa: UP045
    typer.Option("--until", metavar="STAGE", help="Only this stage and what it needs."),
]
OnlyOption = Annotated[
    Optional[list[str]],  # noqa: UP045
    typer.Option("--only", metavar="STAGE:ITEM", help="Only this unit and what it needs."),
]
RefreshOption = Annotated[
    Optional[list[str]],  # noqa: UP045
    typer.Option("--refresh", metavar="STAGE[:ITEM]", help="Compute it again though it is cached."),
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
    bool, typer.Option("--accept-code", help="Keep what was computed before a plugin's code changed.")
]
