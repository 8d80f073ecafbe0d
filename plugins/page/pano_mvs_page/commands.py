"""`pano-mvs share` and `tour`: write the page of a run, or do all that leads to it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pano_mvs.cli.completion import complete_workflow
from pano_mvs.cli.console import Console
from pano_mvs.cli.endings import guarded
from pano_mvs.cli.options import CacheOption, SetOption


@guarded
def share(
    out: Annotated[Path, typer.Argument(metavar="OUT", help="The output folder of a run.")],
    to: Annotated[Path, typer.Option("--to", metavar="DIR", help="Folder to write the page to.")],
    title: Annotated[
        str, typer.Option("--title", help="Heading; default: the capture's folder.", show_default=False)
    ] = "",
    points: Annotated[
        int, typer.Option("--points", min=0, help="Maximum number of points of the cloud; 0: none.")
    ] = 1_500_000,
    triangles: Annotated[
        int,
        typer.Option("--triangles", min=0, help="Maximum number of triangles of a mesh without texture; 0: none."),
    ] = 300_000,
    width: Annotated[int, typer.Option("--width", min=1024, help="Maximum width of the panoramas in pixels.")] = 8192,
    quality: Annotated[int, typer.Option("--quality", min=1, max=100, help="JPEG quality of the panoramas.")] = 85,
    rooms: Annotated[
        Path | None,
        typer.Option(
            "--rooms", help="YAML file with the panoramas of each room; default: from folders, names, or what they see."
        ),
    ] = None,
    images: Annotated[
        Path | None, typer.Option("--images", help="Folder of the panoramas, if they were moved.")
    ] = None,
    cache: CacheOption = None,
) -> None:
    """Write a page to send: cloud, mesh, cameras and panoramas, for any browser, without a network."""
    from pano_mvs_page.scene_parts import ShareOptions
    from pano_mvs_page.sharing import share_output

    options = ShareOptions(title, points, triangles, width, quality, rooms)
    share_output(out, to, options, images=images, cache=cache, console=Console())


@guarded
def tour(
    images: Annotated[
        Path,
        typer.Argument(metavar="PATH", help="Folder of panoramas or of a virtual tour, or a video of a walk."),
    ],
    out: Annotated[
        Path | None,
        typer.Option("--out", help="Output folder; default: out/<name of PATH>. The page is in <output folder>_page."),
    ] = None,
    workflow: Annotated[
        str,
        typer.Option(
            "--workflow",
            metavar="WORKFLOW",
            help="A preset or a workflow file; default: mesh, or walk for a video.",
            autocompletion=complete_workflow,
            show_default=False,
        ),
    ] = "",
    overrides: SetOption = None,
    cache: CacheOption = None,
    no_open: Annotated[bool, typer.Option("--no-open", help="Do not open the page in a browser.")] = False,
) -> None:
    """Make a page to walk through from panoramas: run a workflow, write the page, and open it in a browser."""
    from pano_mvs_page.sharing import TourWanted, make_tour

    wanted = TourWanted(images, out, workflow, tuple(overrides or ()), cache)
    raise typer.Exit(make_tour(wanted, Console(), opens=not no_open))
