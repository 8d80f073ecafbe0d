"""`pano-mvs view`."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from pano_mvs.cli.console import Console
from pano_mvs.cli.endings import guarded
from pano_mvs.cli.options import takes_record

# Options by the panel of the help in which they are listed.
_shown_option = partial(typer.Option, rich_help_panel="What is shown")


@dataclass(frozen=True)
class ViewArguments:
    """The arguments and options of `pano-mvs view`."""

    out: Annotated[Path, typer.Argument(metavar="OUT", help="The output folder of a run, or a .ply file.")]
    screenshot: Annotated[
        Path | None,
        typer.Option(
            "--screenshot", metavar="FILE", help="Write an image instead of opening a window; works without a display."
        ),
    ] = None
    view: Annotated[str, typer.Option("--view", help="Initial view: overview, top, front or inside:IMAGE.")] = (
        "overview"
    )
    color: Annotated[str, _shown_option("--color", help="Colours: rgb, confidence, views, normals or height.")] = "rgb"
    surface: Annotated[
        str,
        _shown_option(
            "--show",
            metavar="cloud|mesh|both",
            help="What to show; default: the cloud if it exists.",
            show_default=False,
        ),
    ] = ""
    points: Annotated[int, _shown_option("--points", min=0, help="Maximum number of points to draw; 0: all.")] = (
        2_000_000
    )
    size: Annotated[str, typer.Option("--size", metavar="WIDTHxHEIGHT", help="Size of the window in pixels.")] = (
        "1280x860"
    )
    images: Annotated[Path | None, typer.Option("--images", help="Folder of the panoramas, if they were moved.")] = None
    labels: Annotated[bool, _shown_option("--labels", help="Show the names of the cameras.")] = False
    blended: Annotated[bool, _shown_option("--blend", help="Overlay the cloud on the panoramas.")] = False
    backs: Annotated[bool, _shown_option("--backs", help="Also show points that face away from the viewer.")] = False
    group: Annotated[
        int,
        _shown_option("--group", min=0, help="Group to show if the panoramas form several groups; 0 is the largest."),
    ] = 0
    ranges: Annotated[
        bool, _shown_option("--ranges", help="Inside a camera, show its ranges; unconfirmed ones are marked.")
    ] = False


@guarded
@takes_record
def view_results(given: ViewArguments) -> None:
    """View the cloud, the mesh and the cameras, and step inside the panoramas."""
    from pano_mvs_viewer.view import ViewOptions, view_run

    options = ViewOptions(**{field.name: getattr(given, field.name) for field in fields(ViewOptions)})
    console = Console()
    view_run(given.out, options, say=lambda note: console.say(f"note: {escape(note)}"))
    if given.screenshot is not None:
        console.say(f"picture in {escape(str(given.screenshot))}")
