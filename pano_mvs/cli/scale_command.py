"""Put a finished run into metres."""

from __future__ import annotations

from pathlib import Path

from rich.markup import escape

from pano_mvs.cli.console import Console
from pano_mvs.cli.run.command import run_workflow
from pano_mvs.core.errors import UsageError
from pano_mvs.results.run_output import RunOutput, load
from pano_mvs.session.running import Execution
from pano_mvs.session.scaling import (
    WORKFLOW_FILE,
    Measurement,
    how_to_scale_blocks,
    measured_between,
    measured_camera_height,
    metres_from_text,
    scaled_session,
)
from pano_mvs.session.summarise import height_note


def scale_output(
    out: Path, known: tuple[str, ...], *, camera_height: str, group: int, cache: Path | None, console: Console
) -> int:
    """Scale a run by a measurement, run its exports again, and return the exit code.

    Without a measurement, only the scale that a usual camera height would give is printed.
    """
    run = load(out, cache=cache)
    if run.summary.merged is not None:
        raise UsageError(how_to_scale_blocks(run))
    if not known and not camera_height:
        return _print_guess(run, group, console)
    measurement = _measurement(run, known, camera_height=camera_height, group=group)
    session = scaled_session(run, measurement, cache=cache)
    groups = run.summary.poses.groups
    chosen = groups[measurement.group] if measurement.group < len(groups) else None
    if chosen is not None and chosen.metric:
        text = f"{measurement.length:.5g} m until now, so all lengths are multiplied by {measurement.factor:.5g}"
    else:
        text = f"{measurement.length:.5g} units, so one unit is {measurement.factor:.5g} m"
    lines = [f"{measurement.origin}: {text}", f"workflow: {out / WORKFLOW_FILE}"]
    if chosen is not None and chosen.camera_height is not None:
        height_m = chosen.camera_height * measurement.factor
        doubt = "" if 0.3 <= height_m <= 4.0 else "; is the distance right?"
        lines.insert(1, f"the cameras are then {height_m:.3g} m above the floor{doubt}")
    console.say("\n".join(map(escape, lines)))
    return run_workflow(session, Execution())


def _measurement(run: RunOutput, known: tuple[str, ...], *, camera_height: str, group: int) -> Measurement:
    if known and camera_height:
        raise UsageError("give either two ends with their distance, or --camera-height")
    if camera_height:
        return measured_camera_height(run, metres=metres_from_text(camera_height), group=group)
    if len(known) == 4:  # "3.42 m" without quotes
        known = (*known[:2], known[2] + known[3])
    if len(known) != 3:
        raise UsageError("give two images, or two points x,y,z, and the distance between them: A B 3.42m")
    first, second, distance = known
    return measured_between(run, first, second, metres=metres_from_text(distance), group=group)


def _print_guess(run: RunOutput, group: int, console: Console) -> int:
    groups = run.summary.poses.groups
    chosen = groups[group] if group < len(groups) else None
    if chosen is not None and chosen.metric:
        text = f"unit of length: {chosen.scale}"
    elif chosen is not None and chosen.camera_height is not None:
        text = height_note(chosen.camera_height)
    else:
        text = "lengths are in scene units, and no floor was found below the cameras. Measure a distance: A B 3.42m"
    console.say(text)
    return 0
