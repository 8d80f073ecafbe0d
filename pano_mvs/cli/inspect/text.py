"""The analysis of a pixel as text and as JSON."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from pano_mvs.scene.range_map import confidence_name
from pano_mvs.viewer.curves import curve_text
from pano_mvs.viewer.inspection import Inspection

_BLOCKS = "▁█△"


def as_json_value(found: Inspection) -> dict[str, Any]:
    """Return an inspection as plain JSON values; unknown values are null."""
    curve = found.curve
    return {
        "image": found.image,
        "pixel": [found.column, found.row],
        "size_hw": list(found.size_hw),
        "color_rgb": list(found.color_rgb),
        "azimuth_deg": found.azimuth_deg,
        "elevation_deg": found.elevation_deg,
        "ray_in_cam": found.ray_in_cam.tolist(),
        "ray_in_world": found.ray_in_world.tolist(),
        "center_in_world": found.center_in_world.tolist(),
        "stages": [
            {"stage": one.stage, "use": one.use, "range": _number(one.range), "confidence": one.confidence}
            for one in found.stages
        ],
        "true_range": _number(found.true_range),
        "sources": [
            {
                "name": one.name,
                "baseline": one.baseline,
                "parallax_deg": one.parallax_deg,
                "pixel_px": list(one.pixel_px),
                "color_rgb": list(one.color_rgb),
                "masked": one.masked,
                "cost": _number(one.cost),
            }
            for one in found.sources
        ],
        "sweep": found.sweep,
        "curve": {
            "ranges": curve.ranges.tolist(),
            "raw": curve.raw.tolist(),
            "aggregated": None if curve.aggregated is None else curve.aggregated.tolist(),
            "by_source": {
                one.name: [_number(cost) for cost in costs]
                for one, costs in zip(found.sources, curve.by_source.tolist(), strict=True)
            },
            "winner": curve.winner,
            "runner_up": curve.runner_up,
            "range": _number(curve.range),
            "confidence": curve.confidence,
            "uniqueness": curve.uniqueness,
        },
        "notes": list(found.notes),
    }


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def print_inspection(found: Inspection, console: Console) -> None:
    """Print an inspection, with its curve drawn as text."""

    def say(text: str) -> None:
        console.print(escape(text), highlight=False, soft_wrap=True)

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
    console.print(_source_table(found))
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


def _source_table(found: Inspection) -> Table:
    table = Table("neighbour", "baseline", "parallax", "pixel it is seen at", "colour", "cost")
    for one in found.sources:
        cost = "masked" if one.masked or not math.isfinite(one.cost) else f"{one.cost:.3f}"
        pixel = f"{one.pixel_px[0]:.1f}, {one.pixel_px[1]:.1f}"
        color = f"[on {_hex(one.color_rgb)}]  [/] {_hex(one.color_rgb)}"
        table.add_row(escape(one.name), f"{one.baseline:.3g}", f"{one.parallax_deg:.2f}°", pixel, color, cost)
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
