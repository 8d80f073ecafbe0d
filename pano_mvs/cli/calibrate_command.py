"""`pano-mvs calibrate`: estimate the lenses of a two-lens camera and write the calibration file."""

from __future__ import annotations

from pathlib import Path
from typing import cast

from rich.markup import escape

from pano_mvs import __version__
from pano_mvs.cli.console import Console
from pano_mvs.core.errors import UsageError
from pano_mvs.core.files import write_given
from pano_mvs.io.images.captures import Layout
from pano_mvs.io.rig_calibration import calibration_text
from pano_mvs.session.calibrating import QUARTER_TURNS, calibrate_camera
from pano_mvs.session.scaling import metres_from_text

_LAYOUTS = ("auto", "side_by_side", "folders", "suffixes")


def calibrate(
    photos: Path,
    out: Path,
    *,
    names: str,
    layout: str,
    distance: str,
    field_of_view_deg: float,
    up: str,
    captures: int,
    console: Console,
) -> None:
    """Write the calibration of the camera that took some raw pictures."""
    lenses = tuple(part.strip() for part in names.split(","))
    if len(lenses) != 2 or not all(lenses) or lenses[0] == lenses[1]:
        raise UsageError(f"--lenses {names[:80]!r}: give two different names, separated by a comma: front,back")
    if layout not in _LAYOUTS:
        raise UsageError(f"--layout {layout[:80]!r}: choose one of {', '.join(_LAYOUTS)}")
    if up not in QUARTER_TURNS:
        raise UsageError(f"--up {up[:80]!r}: choose one of {', '.join(QUARTER_TURNS)}")
    distance_m = metres_from_text(distance) if distance else None
    if distance_m is not None and distance_m > 1.0:
        raise UsageError(
            f"--distance {distance}: {distance_m:g} m is too far for the lenses of one camera. Add a unit: 28mm"
        )
    rig, lines = calibrate_camera(
        photos,
        names=(lenses[0], lenses[1]),
        layout=cast(Layout, layout),
        distance_m=distance_m,
        field_of_view_deg=field_of_view_deg or None,
        up=up,
        max_captures=captures,
        progress=lambda step: console.print(step, highlight=False, style="dim"),
    )
    comments = [f"estimated by pano-mvs {__version__} calibrate from {photos.name}", *lines]
    write_given(out, calibration_text(rig, comments=comments), f"--out {out}")
    console.say("\n".join(map(escape, lines)))
    console.say(
        f"calibration: {escape(str(out))}\nto use it: pano-mvs run quickstart --images {escape(str(photos))} "
        f"--set images.use=source.dual_fisheye --set images.calibration={escape(str(out))}"
    )
