"""`pano-mvs inspect`: the analysis of one pixel of a run, with its cost curve, as text and as JSON."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from rich.markup import escape
from rich.table import Table

from pano_mvs.cli.console import Console, print_json
from pano_mvs.core.errors import InputError, StoreError, UsageError
from pano_mvs.core.paths import is_file, resolved
from pano_mvs.core.text import finite_or_none, shortened_list
from pano_mvs.engine.cache.blobs import BlobRef
from pano_mvs.engine.cache.store import Store, UnitRecord
from pano_mvs.engine.planning.plan import RunOptions, StagePlan, make_plan
from pano_mvs.engine.planning.temporary import items_read
from pano_mvs.engine.planning.units import WHOLE, Unit
from pano_mvs.io.images.names import match_image_names
from pano_mvs.io.truth import read_truth
from pano_mvs.results.summary import RunSummary
from pano_mvs.scene import RangeMap
from pano_mvs.scene.range_map import confidence_name
from pano_mvs.session.cost_curves import curve_text
from pano_mvs.session.inspection import Inspection, UnitFound, inspect_pixel
from pano_mvs.session.running import Execution, run_session
from pano_mvs.session.session import Session, run_command
from pano_mvs.stages.depth import SweepParams


@dataclass(frozen=True)
class PixelWanted:
    """The pixel to inspect."""

    image: str
    x: float
    y: float
    stage: str = ""
    truth: Path | None = None


def inspect(session: Session, wanted: PixelWanted, console: Console, *, plot: Path | None, as_json: bool) -> None:
    """Print the analysis of a pixel."""
    found = _inspection(session, wanted)
    if plot is not None:
        from pano_mvs.session.cost_curves import write_curve_picture

        if plot.suffix.lower() != ".png":
            raise UsageError(f"--plot {plot}: the plot is a PNG image, so the file name must end in .png")
        try:
            write_curve_picture(plot, found)
        except OSError as error:
            raise StoreError(f"--plot {plot}: cannot be written ({error.strerror}). Choose another place") from error
    if as_json:
        print_json(as_json_value(found))
        return
    print_inspection(found, console)
    if plot is not None:
        console.say(f"plot in {escape(str(plot))}")


@dataclass
class _Found:
    """The units of an image in a plan."""

    images: list[str] = field(default_factory=list)
    units: dict[str, dict[str, UnitFound]] = field(default_factory=dict)

    def look(self, unit: Unit, record: UnitRecord | None, _reason: str) -> None:
        if unit.source is not None:
            self.images.append(unit.item)
        if issubclass(unit.entry.spec.output, RangeMap):
            self.units.setdefault(unit.entry.name, {})[unit.item] = unit, record


def _inspection(session: Session, wanted: PixelWanted) -> Inspection:
    if not (math.isfinite(wanted.x) and math.isfinite(wanted.y)):
        raise UsageError(f"({wanted.x}, {wanted.y}) is not a pixel: give its column and row as numbers")
    sweeps = [stage for stage in session.graph.order if isinstance(session.workflow.stages[stage].params, SweepParams)]
    if not sweeps:
        raise UsageError("this workflow has no depth.sweep: only sweeps have cost curves")
    if wanted.stage and wanted.stage not in sweeps:
        raise UsageError(
            f"{wanted.stage!r} is not a depth.sweep stage of this workflow, which has: {', '.join(sweeps)}"
        )
    sweep = wanted.stage or sweeps[0]
    store = Store(session.store_root, for_reading=True)
    found = _Found()
    failed: set[tuple[str, str]] = set()
    with suppress(InputError):  # there may be no run
        failed = {(unit.stage, unit.item) for unit in RunSummary.read(session.out).failures}
    plans = make_plan(session.workflow, session.graph, store, visit=found.look, failed=failed)
    image = _image(wanted.image, found.images)
    unit = found.units.get(sweep, {}).get(image)
    if unit is None:
        raise InputError(_why_not(plans, sweep, image, session=session))
    stages = [units[image] for units in found.units.values() if image in units]
    stages = _with_dropped(stages, session, store, sweep=unit[0])
    truth = wanted.truth or _truth_of(session, image)
    return inspect_pixel(unit, stages, store, column=math.floor(wanted.x), row=math.floor(wanted.y), truth=truth)


def _with_dropped(stages: list[UnitFound], session: Session, store: Store, *, sweep: Unit) -> list[UnitFound]:
    """Compute again what a run has dropped of the results that are shown; return the units without the rest of these.

    The next run drops the results again.
    """

    def is_missing(refs: Iterable[BlobRef]) -> bool:
        return not all(map(store.blobs.exists, refs))

    inputs = [
        f"{edge.producer}:{WHOLE if edge.exploded else name}"
        for edge, name, ref in items_read(sweep, session.graph.edges[sweep.entry.name])
        if is_missing(ref.blobs())
    ]
    dropped = [unit.label for unit, record in stages if record is not None and is_missing(record.blobs())]
    if not (inputs or dropped):
        return stages
    only = tuple(dict.fromkeys(label.removesuffix(":") for label in (*inputs, *dropped)))
    Console(stderr=True).say(escape(f"computing again what was dropped: {shortened_list(only, 6)}"))
    with TemporaryDirectory(prefix="pano-mvs-inspect-") as folder:
        out = Path(folder) / "out"
        try:
            run_session(replace(session, out=out, run_options=RunOptions(only=only)), Execution(executor="serial"))
        except (StoreError, UsageError) as error:  # such as of a cache that cannot be written
            Console(stderr=True).say(escape(f"ranges of {shortened_list(dropped, 6)} are missing: {error}"))
        finally:
            with suppress(StoreError):
                for entry in store.runs.entries():
                    if entry.out == str(resolved(out)):
                        store.runs.forget(entry)
    return [(unit, record) for unit, record in stages if record is None or not is_missing(record.blobs())]


def _image(wanted: str, names: Sequence[str]) -> str:
    matched = match_image_names([wanted], names)
    if wanted in matched:
        return matched[wanted]
    fitting = [name for name in names if wanted in name]
    if len(fitting) == 1:
        return fitting[0]
    shown = fitting or list(names)
    raise UsageError(
        f"{len(fitting) or 'no'} images match {wanted!r}; there are: {shortened_list(shown, 6, rest=' …')}"
    )


def _why_not(plans: Sequence[StagePlan], sweep: str, image: str, *, session: Session) -> str:
    plan = next(plan for plan in plans if plan.name == sweep)
    if image in plan.blocked:
        return f"{sweep}:{image} cannot be swept: {plan.blocked[image]}"
    if plan.open or plan.may_run:
        return (
            f"{sweep}:{image} reads what the cache {session.store_root} does not hold, with these settings, "
            f"pictures and version. Inspect the output folder of a run in place of the workflow, or run the "
            f"workflow with these settings first, or just that: {run_command(session, '--only', f'{sweep}:{image}')}"
        )
    return f"{sweep} has no view of {image}: it was not registered, or has no neighbours; see report.html"


def _truth_of(session: Session, image: str) -> Path | None:
    """Return the ground truth of the workflow, if it has one for the image.

    The ground truth of a preset only applies to its sample images.
    """
    for entry in session.workflow.stages.values():
        folder = getattr(entry.params, "truth", None)
        if isinstance(folder, Path) and is_file(folder / "poses.json"):
            return folder if read_truth(folder).match([image]) else None
    return None


_BLOCKS = "▁█△"


def as_json_value(found: Inspection) -> dict[str, Any]:
    """Return an inspection as plain JSON values; unknown values are null."""
    value: dict[str, Any] = _plain(found) | {
        "pixel": [found.column, found.row],
        "azimuth_deg": found.azimuth_deg,
        "elevation_deg": found.elevation_deg,
    }
    costs = zip(found.sources, value["curve"]["by_source"], strict=True)
    value["curve"]["by_source"] = {source.name: by_range for source, by_range in costs}
    for name in ("column", "row", "settings"):
        del value[name]
    del value["curve"]["reason"]
    return value


def _plain(value: Any) -> Any:
    """Return a record as JSON values; null in place of NaN."""
    if is_dataclass(value):
        return {one.name: _plain(getattr(value, one.name)) for one in fields(value)}
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, list | tuple):
        return [_plain(inner) for inner in value]
    return finite_or_none(value) if isinstance(value, float) else value


def print_inspection(found: Inspection, console: Console) -> None:
    """Print an inspection, with its curve drawn as text."""

    def say(text: str) -> None:
        console.say(escape(text))

    say(
        f"{found.image}, pixel ({found.column}, {found.row}) of {found.size_hw[1]}×{found.size_hw[0]}: "
        f"azimuth {found.azimuth_deg:z.2f}°, elevation {found.elevation_deg:z.2f}°, "
        f"colour {_hex(found.color_rgb)}"
    )
    say(
        f"ray in the camera {_vector(found.ray_in_cam)}, in the world {_vector(found.ray_in_world)} from "
        f"{_vector(found.center_in_world)}"
    )
    console.print(_stage_table(found))
    table = Table("neighbour", "baseline", "parallax", "pixel it is seen at", "colour", "cost")
    for one in found.sources:
        cost = "masked" if one.masked or not math.isfinite(one.cost) else f"{one.cost:.3f}"
        pixel = f"{one.pixel_px[0]:.1f}, {one.pixel_px[1]:.1f}"
        color = f"[on {_hex(one.color_rgb)}]  [/] {_hex(one.color_rgb)}"
        table.add_row(escape(one.name), f"{one.baseline:.3g}", f"{one.parallax_deg:.2f}°", pixel, color, cost)
    console.print(table)
    settings, curve = found.settings, found.curve
    said = [settings.cost, f"window {settings.window}", settings.combination, settings.aggregation]
    say(
        f"cost curve of {found.sweep}: {settings.planes} ranges from {curve.ranges[0]:.4g} to {curve.ranges[-1]:.4g} "
        f"({settings.spacing}), {', '.join(said)}"
    )
    for line in curve_text(
        curve, true_range=found.true_range, width=min(console.width, 140), plain=not _has_blocks(console)
    ):
        console.print(escape(line), highlight=False, no_wrap=True, crop=False)
    say(_verdict(found))
    for note in found.notes:
        say(f"note: {note}")


def _verdict(found: Inspection) -> str:
    curve = found.curve
    text = f"winner {curve.ranges[curve.winner]:.4g} at cost {curve.decisive[curve.winner]:.3f}"
    if np.isfinite(curve.range):
        text += f", between the planes {curve.range:.5g}"
    if curve.runner_up is not None:
        text += f"; next valley {curve.ranges[curve.runner_up]:.4g} at {curve.decisive[curve.runner_up]:.3f}"
    text += f"; unique by {100 * curve.uniqueness:.0f} %"
    if np.isfinite(found.true_range) and np.isfinite(curve.range):
        text += f"; off the truth by {100 * (curve.range / found.true_range - 1):+z.2f} %"
    return text


def _stage_table(found: Inspection) -> Table:
    table = Table("stage", "use", "range", "confidence")
    for one in found.stages:
        kind = confidence_name(one.confidence)
        shown = f"{one.range:.5g}" if math.isfinite(one.range) else "–"
        table.add_row(escape(one.stage), escape(one.use), shown, f"{one.confidence} {kind}")
    if math.isfinite(found.true_range):
        table.add_row("truth", "", f"{found.true_range:.5g}", "")
    return table


def _has_blocks(console: Console) -> bool:
    try:
        _BLOCKS.encode(console.encoding)
    except (UnicodeEncodeError, LookupError):
        return False
    return True


def _hex(color_rgb: tuple[int, int, int]) -> str:
    return "#{:02x}{:02x}{:02x}".format(*color_rgb)


def _vector(values: Any) -> str:
    return "(" + ", ".join(f"{value:z.4f}" for value in values) + ")"
