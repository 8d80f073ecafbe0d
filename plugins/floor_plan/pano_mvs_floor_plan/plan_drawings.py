"""Floor plans as SVG, as DXF, as a picture over an orthophoto of the floor, and as the world file beside it."""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.errors import UsageError

DXF_REMEDY = "DXF files need the package ezdxf: pip install 'pano-mvs[dxf]'"


COLORS = {"wall": (24, 32, 56), "door": (214, 140, 36), "window": (60, 130, 220), "camera": (214, 72, 36)}
"""RGB colours of what a plan shows."""


@dataclass(frozen=True, eq=False)
class DrawnRoom:
    """A room: its outline (N, 2), lines of text about it, and where they stand."""

    outline: FloatArray
    text: Sequence[str]
    label_xy: FloatArray


@dataclass(frozen=True, eq=False)
class PlanDrawing:
    """A plan of one storey, in its own coordinates: x right, y up."""

    title: str
    walls: FloatArray  # (N, 2, 2) ends of the wall lines
    solids: Sequence[FloatArray]  # (4, 2) each, outlines of walls of which both sides were seen
    openings: Sequence[tuple[str, FloatArray]]  # "door" or "window", and the ends (2, 2)
    rooms: Sequence[DrawnRoom]
    cameras: Mapping[str, tuple[float, float]]  # name to (x, y)
    box: tuple[tuple[float, float], tuple[float, float]]  # ((left, bottom), (right, top))
    bar: float  # length of the scale bar
    unit: str  # of lengths, for display
    is_metric: bool  # whether it is the metre


def world_file_text(pixel: float, left: float, top: float) -> str:
    """Return a world file (.pgw): pixel size, no rotation, and the centre of the upper left pixel."""
    return "".join(f"{value:.12g}\n" for value in (pixel, 0, 0, -pixel, left + pixel / 2, top - pixel / 2))


def svg_text(plan: PlanDrawing) -> str:
    """Return a plan as SVG; the lines of `walls`, `doors` and `windows` have the coordinates of the plan."""
    (left, bottom), (right, top) = plan.box
    width, height = right - left, top - bottom
    strip = 0.08 * max(width, height)
    size = strip / 3
    numbers = " ".join(f"{value:.6g}" for value in (left, -top, width, height + strip))
    base, start = -bottom + strip / 2, left + strip / 3
    solids = [f'<polygon points="{" ".join(f"{x:.5f},{y:.5f}" for x, y in one.tolist())}"/>' for one in plan.solids]
    openings = [
        f'<g id="{kind}s" stroke="#{bytes(COLORS[kind]).hex()}">\n{_lines(which)}\n</g>'
        for kind in ("door", "window")
        for which in ([ends for other, ends in plan.openings if other == kind],)
    ]
    step = 0.6 * size
    texts = [
        f'<text x="{x:.5f}" y="{-y - size / 2 + step * number:.5f}">{escape(line, quote=False)}</text>'
        for room in plan.rooms
        for (x, y) in (room.label_xy.tolist(),)
        for number, line in enumerate(room.text, 1 - len(room.text))
    ]
    dots = [
        f'<circle cx="{x:.5f}" cy="{y:.5f}" r="{size / 4:.4g}"><title>{escape(name, quote=False)}</title></circle>'
        for name, (x, y) in plan.cameras.items()
    ]
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="{numbers}" width="1000" '
            f'height="{1000 * (height + strip) / width:.0f}" data-unit="{escape(plan.unit)}">',
            f"<title>{escape(plan.title, quote=False)}</title>",
            '<g transform="scale(1,-1)" fill="none" stroke="#182038" stroke-linecap="round">',
            '<g id="solids" fill="#182038" stroke="none">',
            *solids,
            "</g>",
            f'<g stroke-width="{size / 6:.4g}">',
            f'<g id="walls">\n{_lines(plan.walls)}\n</g>',
            *openings,
            "</g>",
            '<g id="cameras" fill="#d64824" stroke="none">',
            *dots,
            "</g>",
            "</g>",
            f'<g id="rooms" font-size="{size / 2:.4g}" font-family="sans-serif" fill="#182038" text-anchor="middle">',
            *texts,
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


def _lines(segments: Sequence[FloatArray] | FloatArray) -> str:
    return "\n".join(
        f'<line x1="{x1:.5f}" y1="{y1:.5f}" x2="{x2:.5f}" y2="{y2:.5f}"/>'
        for (x1, y1), (x2, y2) in (segment.tolist() for segment in segments)
    )


def has_ezdxf() -> bool:
    """Return whether DXF files can be written."""
    return importlib.util.find_spec("ezdxf") is not None


def write_dxf(path: Path, plan: PlanDrawing) -> None:
    """Write a plan as DXF (AutoCAD 2010).

    Lines are in the layers WALLS, DOORS and WINDOWS, outlines of rooms with their sizes in ROOMS, circles and names in
    CAMERAS. The same plan gives the same bytes: no date is written.

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
        for layer, color in (("WALLS", 7), ("DOORS", 30), ("WINDOWS", 5), ("ROOMS", 8), ("CAMERAS", 1)):
            document.layers.add(layer, color=color)
        space = document.modelspace()
        for kind, ends in [*(("wall", ends) for ends in plan.walls), *plan.openings]:
            start, end = ends.tolist()
            space.add_line(start, end, dxfattribs={"layer": f"{kind}s".upper()})
        (left, bottom), (right, top) = plan.box
        for room in plan.rooms:
            space.add_lwpolyline(room.outline.tolist(), close=True, dxfattribs={"layer": "ROOMS"})
            height = 0.01 * max(right - left, top - bottom)
            x, y = room.label_xy.tolist()
            for number, line in enumerate(room.text):
                text = space.add_text(line, height=height, dxfattribs={"layer": "ROOMS"})
                text.set_placement((x, y - 1.5 * height * number))
        radius = 0.006 * max(right - left, top - bottom)
        for name, place in plan.cameras.items():
            space.add_circle(place, radius, dxfattribs={"layer": "CAMERAS"})
            text = space.add_text(name, height=1.5 * radius, dxfattribs={"layer": "CAMERAS"})
            text.set_placement((place[0] + 1.5 * radius, place[1]))
        document.saveas(path)
    finally:
        options.write_fixed_meta_data_for_testing = before


_PAPER = 255, 255, 255
_SUBPIXEL_BITS = 4
_ASCII = {ord("²"): "2", ord("×"): "x"}  # all that OpenCV's font has


def strip_px(size_hw: tuple[int, int]) -> int:
    """Return the rows of the strip for the scale bar below a plan of a size."""
    return max(36, round(0.06 * max(size_hw)))


def draw_plan(photo: NDArray[np.uint8], known: NDArray[np.bool_], plan: PlanDrawing) -> NDArray[np.uint8]:
    """Return the picture of a plan (H + strip, W, 3) RGB: the strip below the plan has the scale bar.

    `photo`: (H, W, 3) RGB orthophoto of the box of the plan. `known`: (H, W) pixels that show something; others are
    white.
    """
    height, width = known.shape
    (left, _), (right, top) = plan.box
    pixel = (right - left) / width
    image = np.full((height + strip_px((height, width)), width, 3), _PAPER, np.uint8)
    image[:height][known] = photo[known]

    def pixels(xy: FloatArray) -> NDArray[np.int32]:
        # OpenCV's fixed-point numbers; pixels have their centres at whole numbers.
        places = np.stack([xy[..., 0] - left, top - xy[..., 1]], axis=-1) / pixel
        return np.asarray(np.rint((places - 0.5) * (1 << _SUBPIXEL_BITS)), np.int32)

    for solid in plan.solids:
        cv2.fillPoly(image, [pixels(solid)], COLORS["wall"], cv2.LINE_AA, _SUBPIXEL_BITS)
    thickness = max(2, round(width / 350))
    for kind, ends in [*(("wall", ends) for ends in plan.walls), *plan.openings]:
        start, end = pixels(ends).tolist()
        cv2.line(image, start, end, COLORS[kind], thickness, cv2.LINE_AA, _SUBPIXEL_BITS)
    radius = max(3, width // 150) << _SUBPIXEL_BITS
    for x, y in pixels(np.array(list(plan.cameras.values())).reshape(-1, 2)).tolist():
        cv2.circle(image, (x, y), radius, _PAPER, -1, cv2.LINE_AA, _SUBPIXEL_BITS)
        cv2.circle(image, (x, y), int(0.7 * radius), COLORS["camera"], -1, cv2.LINE_AA, _SUBPIXEL_BITS)
    size, font = max(0.35, width / 1400), cv2.FONT_HERSHEY_SIMPLEX
    for room in plan.rooms:
        x, y = (pixels(np.array(room.label_xy)) >> _SUBPIXEL_BITS).tolist()
        lines = [line.translate(_ASCII) for line in room.text]
        extents = [cv2.getTextSize(line, font, size, 1) for line in lines]
        step = max((high + 2 * below for (_, high), below in extents), default=0)
        y -= 2 * (radius >> _SUBPIXEL_BITS) + step * (len(lines) - 1)
        for number, (line, ((wide, high), below)) in enumerate(zip(lines, extents, strict=True)):
            start, base = x - wide // 2, y + step * number
            cv2.rectangle(image, (start - below, base - high - below), (start + wide + below, base + below), _PAPER, -1)
            cv2.putText(image, line, (start, base), font, size, COLORS["wall"], 1, cv2.LINE_AA)
    image[height:] = _PAPER
    _draw_bar(image[height:], plan, pixel)
    return image


def _draw_bar(strip: NDArray[np.uint8], plan: PlanDrawing, pixel: float) -> None:
    rows = strip.shape[0]
    left, right, middle = rows // 3, rows // 3 + round(plan.bar / pixel), rows // 2
    tick = max(3, rows // 8)
    thickness = max(1, rows // 24)
    for start, end in (
        ((left, middle), (right, middle)),
        ((left, middle - tick), (left, middle + tick)),
        ((right, middle - tick), (right, middle + tick)),
    ):
        cv2.line(strip, start, end, COLORS["wall"], thickness)
    size = rows / 60
    place, font = (right + rows // 4, middle + round(8 * size)), cv2.FONT_HERSHEY_SIMPLEX
    cv2.putText(strip, f"{plan.bar:g} {plan.unit}", place, font, size, COLORS["wall"], thickness, cv2.LINE_AA)
