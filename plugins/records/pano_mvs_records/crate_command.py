"""`pano-mvs crate`: describe a run for an archive."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from pano_mvs.cli.console import Console
from pano_mvs.cli.endings import guarded


@guarded
def describe_run(out: Annotated[Path, typer.Argument(metavar="OUT", help="The output folder of a run.")]) -> None:
    """Describe a run as an RO-Crate: software, settings, and digests of inputs and outputs, for an archive."""
    from pano_mvs_records.crate import write_crate

    Console().say(escape(f"{write_crate(out)} is written"))
