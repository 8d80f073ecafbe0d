"""Floor plans as SVG, as DXF, and as the world file beside a PNG."""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from xml.sax.saxutils import escape, quoteattr

from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.errors import UsageError

DXF_REMEDY = "DXF files need the package ezdxf: pip install 'pano-mvs[dxf]'"


@dataclass(frozen=True, eq=False)
class PlanDrawing:
    """A plan of one storey, in its own coordinates: x right, y up."""

    title: str
    walls: FloatArray  # (N, 2, 2) ends of the wall lines
    cameras: Mapping[str, tuple[float, float]]  # name to (x, y)
    box: tuple[tuple[float, float], tuple[float, float]]  # ((left, bottom), (right, top))
    bar: float  # length of the scale bar
    unit: str  # of lengths, for display
    is_metric: bool  # whether it is the metre


def world_file_text(pixel: float, left: float, top: float) -> str:
    """Return a world file (.pgw): pixel size, no rotation, and the centre of the upper left pixel."""
    return "".join(f"{value:.12g}\n" for value in (pixel, 0, 0, -pixel, left + pixel / 2, top - pixel / 2))


def svg_text(plan: PlanDrawing) -> str:
    """Return a plan as SVG; the lines of the group `walls` have the coordinates of the plan."""
    (left, bottom), (right, top) = plan.box
    width, height = right - left, top - bottom
    strip = 0.08 * max(width, height)
    size = strip / 3
    numbers = " ".join(f"{value:.6g}" for value in (left, -top, width, height + strip))
    base, start = -bottom + strip / 2, left + strip / 3
    lines = [
        f'<line x1="{x1:.5f}" y1="{y1:.5f}" x2="{x2:.5f}" y2="{y2:.5f}"/>' for (x1, y1), (x2, y2) in plan.walls.tolist()
    ]
    dots = [
        f'<circle cx="{x:.5f}" cy="{y:.5f}" r="{size / 4:.4g}"><title>{escape(name)}</title></circle>'
        for name, (x, y) in plan.cameras.items()
    ]
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="{numbers}" width="1000" '
            f'height="{1000 * (height + strip) / width:.0f}" data-unit={quoteattr(plan.unit)}>',
            f"<title>{escape(plan.title)}</title>",
            '<g transform="scale(1,-1)" fill="none" stroke="#182038" stroke-linecap="round">',
            f'<g id="walls" stroke-width="{size / 6:.4g}">',
            *lines,
            "</g>",
            '<g id="cameras" fill="#d64824" stroke="none">',
            *dots,
            "</g>",
            "</g>",
            f'<g id="scale" stroke="#182038" stroke-width="{size / 8:.4g}">',
            f'<path fill="none" d="M{start:.6g} {base - size / 3:.6g}v{2 * size / 3:.6g}m0 {-size / 3:.6g}'
            f'h{plan.bar:.6g}m0 {-size / 3:.6g}v{2 * size / 3:.6g}"/>',
            f'<text x="{start + plan.bar + size / 2:.6g}" y="{base + size / 3:.6g}" font-size="{size:.4g}" '
            f'font-family="sans-serif" fill="#182038" stroke="none">{plan.bar:g} {escape(plan.unit)}</text>',
            "</g>",
            "</svg>",
            "",
        ]
    )


def has_ezdxf() -> bool:
    """Return whether DXF files can be written."""
    return importlib.util.find_spec("ezdxf") is not None


def write_dxf(path: Path, plan: PlanDrawing) -> None:
    """Write a plan as DXF (AutoCAD 2010): lines in the layer WALLS, circles and names in CAMERAS.

    The same plan gives the same bytes: no date is written.

    Raises:
        UsageError: if ezdxf is not installed.
    """
    if not has_ezdxf():
        raise UsageError(DXF_REMEDY)
    from ezdxf._options import options
    from ezdxf.filemanagement import new

    before = options.write_fixed_meta_data_for_testing
    options.write_fixed_meta_data_for_testing = True  # no dates and no random identifiers
    try:
        document = new("R2010", units=6 if plan.is_metric else 0)  # metres, or none
        document.layers.add("WALLS", color=7)
        document.layers.add("CAMERAS", color=1)
        space = document.modelspace()
        for start, end in plan.walls.tolist():
            space.add_line(start, end, dxfattribs={"layer": "WALLS"})
        (left, bottom), (right, top) = plan.box
        radius = 0.006 * max(right - left, top - bottom)
        for name, place in plan.cameras.items():
            space.add_circle(place, radius, dxfattribs={"layer": "CAMERAS"})
            text = space.add_text(name, height=1.5 * radius, dxfattribs={"layer": "CAMERAS"})
            text.set_placement((place[0] + 1.5 * radius, place[1]))
        document.saveas(path)
    finally:
        options.write_fixed_meta_data_for_testing = before
