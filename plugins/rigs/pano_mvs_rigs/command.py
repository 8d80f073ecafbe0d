"""`pano-mvs calibrate`: estimate the lenses of a two-lens camera and write the calibration file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer
from rich.markup import escape

from pano_mvs import __version__
from pano_mvs.cli.console import Console
from pano_mvs.cli.endings import guarded
from pano_mvs.core.errors import UsageError
from pano_mvs.core.files import write_given


@guarded
def calibrate(
    photos: Annotated[
        Path, typer.Argument(metavar="PHOTOS", help="Folder of the raw pictures of a two-lens camera, unstitched.")
    ],
    *,
    to: Annotated[Path, typer.Option("--out", metavar="FILE.yaml", help="Calibration file to write.")],
    names: Annotated[
        str, typer.Option("--lenses", help="Names of the lenses; in file or folder names, if they are stored apart.")
    ] = "front,back",
    layout: Annotated[
        Literal["auto", "side_by_side", "folders", "suffixes"],
        typer.Option("--layout", help="Where the pictures of the two lenses are."),
    ] = "auto",
    distance: Annotated[
        str,
        typer.Option(
            "--distance",
            metavar="LENGTH",
            help="Measured distance between the centres of the lenses, such as 28mm; without it, poses are not in "
            "metres.",
            show_default=False,
        ),
    ] = "",
    field_of_view: Annotated[
        float,
        typer.Option(
            "--field-of-view",
            min=0,
            max=280,
            help="Rough angle of the image circles in degrees, a start value; 0: by camera, otherwise 195.",
        ),
    ] = 0.0,
    up: Annotated[
        Literal["top", "right", "bottom", "left"],
        typer.Option(
            "--up", help="Side of the first lens's picture where the top of the scene is, for upright panoramas."
        ),
    ] = "top",
    captures: Annotated[
        int, typer.Option("--captures", min=2, help="Maximum number of captures to use, the first ones.")
    ] = 12,
) -> None:
    """Estimate the lenses of a two-lens camera from its raw pictures, for source.dual_fisheye."""
    from pano_mvs.io.rig_calibration import calibration_text
    from pano_mvs.session.scaling import metres_from_text
    from pano_mvs_rigs.camera import calibrate_camera

    console, lenses = Console(), tuple(part.strip() for part in names.split(","))
    if len(lenses) != 2 or not all(lenses) or lenses[0] == lenses[1]:
        raise UsageError(f"--lenses {names[:80]!r}: give two different names, separated by a comma: front,back")
    distance_m = metres_from_text(distance) if distance else None
    if distance_m is not None and distance_m > 1.0:
        raise UsageError(
            f"--distance {distance}: {distance_m:g} m is too far for the lenses of one camera. Add a unit: 28mm"
        )
    rig, lines = calibrate_camera(
        photos,
        names=(lenses[0], lenses[1]),
        layout=layout,
        distance_m=distance_m,
        field_of_view_deg=field_of_view or None,
        up=up,
        max_captures=captures,
        progress=lambda step: console.print(step, highlight=False, style="dim"),
    )
    comments = [f"estimated by pano-mvs {__version__} calibrate from {photos.name}", *lines]
    write_given(to, calibration_text(rig, comments=comments), f"--out {to}")
    console.say("\n".join(map(escape, lines)))
    console.say(
        f"calibration: {escape(str(to))}\nto use it: pano-mvs run quickstart --images {escape(str(photos))} "
        f"--set images.use=source.dual_fisheye --set images.calibration={escape(str(to))}"
    )
