"""Sheets of paper with the plans of storeys and of their ceilings at a stated scale, as PDF, SVG and PNG."""

from __future__ import annotations

import textwrap
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.points.plan_grid import Extent, bar_length
from pano_mvs.core.arrays import FloatArray
from pano_mvs_floor_plan.rooms import Room
from pano_mvs_floor_plan.sizes import Measure, RoomSize, volume_of
from pano_mvs_floor_plan.walls_and_openings import Opening, StoreyPlan

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PAPERS_MM: Mapping[str, tuple[float, float]] = {
    "a4": (297, 210),
    "a3": (420, 297),
    "a2": (594, 420),
    "a1": (841, 594),
    "a0": (1189, 841),
    "letter": (279.4, 215.9),
    "tabloid": (431.8, 279.4),
}
"""Long and short side of papers."""

SCALES = tuple(step * 10**power for power in range(1, 5) for step in (1, 2, 5))
"""Denominators of scales."""

_MARGIN, _BLOCK = 8.0, 30.0  # of the paper, and height of the title block, in mm
_PAD = 7.0  # between the drawing and its frame
_DPI = 200
_INCH = 25.4
_POINT = 72 / _INCH  # points per mm
_PHOTO_STRENGTH = 0.6  # so that lines and text stay legible
_INK, _FAINT, _PANE, _WALL = "#182038", "#7b8294", "#3c82dc", "#182038"
_STYLE: Any = {  # matplotlib's type of the keys depends on its version
    "font.family": "DejaVu Sans",
    "text.color": _INK,
    "text.parse_math": False,  # names may have dollar signs
    "pdf.fonttype": 42,  # text that one can search and copy
    "svg.fonttype": "none",
    "svg.hashsalt": "pano_mvs",  # the same plan gives the same bytes
}
_LEAST_SEEN = 0.6  # share of a ceiling of which the photo is shown
_SIZES_PT = 7.0, 6.0, 5.0  # of the text in a room


@dataclass(frozen=True, eq=False)
class StoreySheet:
    """What the sheets of a storey show.

    Attributes:
        name: of its files.
        title: of the storey.
        floor: its height.
        height: of the ceiling above it.
        plan: in its coordinates, x right and y up.
        room_names: of its rooms.
        cameras: (N, 2) where panoramas were taken.
        ceiling: (H, W, 3) RGB orthophoto of the ceiling, as in a mirror on the floor.
        ceiling_known: (H, W) its pixels that show something.
        extent: of the orthophoto.
    """

    name: str
    title: str
    floor: float
    height: float
    plan: StoreyPlan
    room_names: Sequence[str]
    cameras: FloatArray
    ceiling: NDArray[np.uint8]
    ceiling_known: NDArray[np.bool_]
    extent: Extent


@dataclass(frozen=True)
class SheetSettings:
    """What all sheets of a plan state.

    Attributes:
        title: in the title block.
        is_metric: whether lengths are metres; otherwise no scale is stated.
        source: where the unit of length comes from.
        has_north: whether +y of the plan is north.
        paper: a key of `PAPERS_MM`.
        scale: the denominator; 0: the largest scale at which all storeys fit.
    """

    title: str
    is_metric: bool
    source: str
    has_north: bool
    paper: str
    scale: int


@dataclass(frozen=True, eq=False)
class _Layout:
    """Where the plan lies on the paper, in mm from the lower left: turn @ (xy − middle) · mm_per_unit + center."""

    page_mm: tuple[float, float]
    turn: FloatArray
    middle: FloatArray
    mm_per_unit: float
    scale: int  # 0: none

    @property
    def center(self) -> FloatArray:
        width, height = self.page_mm
        return np.array([width / 2, (height + _BLOCK) / 2])

    def on_page(self, xy: FloatArray) -> FloatArray:
        """Return positions (..., 2) of the plan on the page."""
        return np.asarray((xy - self.middle) @ self.turn.T * self.mm_per_unit + self.center)


def page_bytes(paper: str) -> int:
    """Return the memory for pictures of a page."""
    long, short = PAPERS_MM[paper]
    return round(20 * long * short * (_DPI / _INCH) ** 2)


def write_sheets(
    folder: Path, storeys: Sequence[StoreySheet], settings: SheetSettings, formats: Sequence[str]
) -> tuple[dict[str, dict[str, str]], list[str]]:
    """Write the sheets of all storeys that have rooms.

    All formats show a sheet with the plan and one with the ceiling of each storey; the PDF has all of them, and a table
    of the rooms.

    Returns:
        For each storey, its files by format, such as {"sheet_svg": …, "ceiling_sheet_svg": …}, and notes.
    """
    from matplotlib.backends.backend_pdf import PdfPages

    drawn = [storey for storey in storeys if storey.plan.rooms]
    if not drawn:
        return {}, ["no sheets: no room was found"]
    layout = _layout(drawn, settings)
    notes: list[str] = []
    if settings.scale and layout.scale != settings.scale:
        notes.append(
            f"the plan does not fit on {settings.paper.upper()} at 1:{settings.scale}: 1:{layout.scale} is used"
            if settings.is_metric
            else f"sheets are not at 1:{settings.scale}: no length is known"
        )
    if len(drawn) < len(storeys):
        empty = ", ".join(storey.title for storey in storeys if not storey.plan.rooms)
        notes.append(f"no sheet of {empty}: no room was found")
    files: dict[str, dict[str, str]] = {storey.name: {} for storey in drawn}
    pictures = [suffix for suffix in ("svg", "png") if suffix in formats]
    for storey in drawn:
        for kind in ("sheet", "ceiling_sheet") if pictures else ():
            with _page(layout.page_mm) as (figure, axes):
                _draw_sheet(axes, storey, settings, layout, is_ceiling=kind == "ceiling_sheet")
                for suffix in pictures:
                    name = f"{storey.name}_{kind}.{suffix}"
                    files[storey.name][f"{kind}_{suffix}"] = name
                    metadata = {"Date": None, "Creator": None} if suffix == "svg" else {"Software": None}
                    figure.savefig(folder / name, dpi=_DPI, metadata=metadata)
    if "pdf" in formats:
        # Without dates and versions, which would change the bytes.
        about = {"Title": settings.title, "CreationDate": None, "Creator": None, "Producer": None}
        with PdfPages(folder / "sheets.pdf", metadata=about) as document:
            for storey in drawn:
                for is_ceiling in (False, True):
                    with _page(layout.page_mm) as (figure, axes):
                        _draw_sheet(axes, storey, settings, layout, is_ceiling=is_ceiling)
                        document.savefig(figure, dpi=_DPI)
            for table in _tables(drawn, settings, layout.page_mm):
                with _page(layout.page_mm) as (figure, axes):
                    _draw_table(axes, table, settings, layout.page_mm)
                    document.savefig(figure)
    return files, notes


def _layout(storeys: Sequence[StoreySheet], settings: SheetSettings) -> _Layout:
    """Return a layout that holds all storeys, their walls along the edges of the paper."""
    angles = [(np.arctan2(*size.direction[::-1]), size.area.value) for storey in storeys for size in storey.plan.sizes]
    # The mean direction, of which a quarter of a turn is none.
    mean = sum(weight * np.exp(4j * angle) for angle, weight in angles)
    angle = -float(np.angle(mean)) / 4
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    parts = [
        part
        for storey in storeys
        for part in (
            *(room.outline for room in storey.plan.rooms),
            *storey.plan.solids,
            *(one.ends for one in storey.plan.openings),
            *(one.leaf.reach for one in storey.plan.openings if one.leaf),
        )
    ]
    turned = np.concatenate(parts) @ turn.T
    low, high = turned.min(axis=0), turned.max(axis=0)
    size, middle = high - low, (low + high) / 2 @ turn
    long, short = PAPERS_MM[settings.paper]
    pages = [(long, short), (short, long)]
    room = [np.array(page) - 2 * (_MARGIN + _PAD) - (0, _BLOCK) for page in pages]
    fits = [float((space / np.maximum(size, 1e-9)).min()) for space in room]  # mm per unit
    best = int(np.argmax(fits))
    if not settings.is_metric:
        return _Layout(pages[best], turn, middle, fits[best], 0)
    held = [scale for scale in SCALES if 1000 / scale <= max(fits) * (1 + 1e-9)] or [SCALES[-1]]
    scale = settings.scale if settings.scale and 1000 / settings.scale <= max(fits) * (1 + 1e-9) else held[0]
    # Landscape if both hold it.
    page = pages[0] if 1000 / scale <= fits[0] * (1 + 1e-9) else pages[best]
    return _Layout(page, turn, middle, 1000 / scale, scale)


@contextmanager
def _page(page_mm: tuple[float, float]) -> Iterator[tuple[Figure, Axes]]:
    """Give an empty page whose coordinates are mm from its lower left corner."""
    from matplotlib import rc_context, rcParamsDefault
    from matplotlib.figure import Figure

    with rc_context(rcParamsDefault), rc_context(_STYLE), warnings.catch_warnings():  # without the user's own style
        warnings.filterwarnings("ignore", "Glyph .* missing from font")  # boxes in their place say enough
        figure = Figure((page_mm[0] / _INCH, page_mm[1] / _INCH))
        axes = figure.add_axes((0, 0, 1, 1))
        axes.set(xlim=(0, page_mm[0]), ylim=(0, page_mm[1]))
        axes.set_axis_off()
        yield figure, axes


def _draw_sheet(axes: Axes, storey: StoreySheet, settings: SheetSettings, layout: _Layout, *, is_ceiling: bool) -> None:
    if is_ceiling:
        _draw_photo(axes, storey, layout)
    for room in storey.plan.rooms:
        for outline in (room.outline, *room.holes):
            axes.add_patch(_polygon(layout.on_page(outline), fill=False, edgecolor=_FAINT, linewidth=0.15 * _POINT))
    for solid in storey.plan.solids:
        axes.add_patch(_polygon(layout.on_page(solid), facecolor=_WALL, edgecolor=_WALL, linewidth=0.1 * _POINT))
    for wall in storey.plan.walls:
        _line(axes, layout.on_page(wall.ends), mm=0.4)
    taken = []
    for opening in storey.plan.openings:
        taken += _draw_opening(axes, opening, layout, has_text=not is_ceiling)
    if not is_ceiling:
        for x, y in layout.on_page(storey.cameras).tolist():
            taken.append(np.array([[x - 1, y - 1], [x + 1, y - 1], [x + 1, y + 1], [x - 1, y + 1]]))
            axes.plot(x, y, "+", color=_FAINT, ms=1.6 * _POINT, mew=0.15 * _POINT)
    for room, size, name in zip(storey.plan.rooms, storey.plan.sizes, storey.room_names, strict=True):
        if not size.is_rectangle and not is_ceiling:
            _draw_side_lengths(axes, room, size, layout)
        _draw_room_text(axes, room, _room_text(name, size, settings, is_ceiling=is_ceiling), taken, layout)
    _draw_block(axes, storey, settings, layout, is_ceiling=is_ceiling)


def _polygon(corners: FloatArray, **style: Any) -> Any:
    from matplotlib.patches import Polygon

    return Polygon(corners, closed=True, joinstyle="miter", **style)


def _line(
    axes: Axes, ends: FloatArray, *, mm: float, color: str = _WALL, dashes: tuple[float, float] | None = None
) -> None:
    style: dict[str, Any] = {"dashes": dashes} if dashes else {"solid_capstyle": "projecting"}
    axes.plot(*ends.T, color=color, linewidth=mm * _POINT, **style)


def _draw_photo(axes: Axes, storey: StoreySheet, layout: _Layout) -> None:
    """Draw the orthophoto of the ceilings of which most was seen, pale; spots of the others would look like dirt."""
    outlines = [layout.on_page(room.outline) for room in storey.plan.rooms]
    corners = np.concatenate(outlines)
    low, high = np.floor(corners.min(axis=0)), np.ceil(corners.max(axis=0))
    pixel = _INCH / _DPI
    width, height = np.ceil((high - low) / pixel).astype(int).tolist()

    def pixels(page: FloatArray) -> FloatArray:
        return np.asarray(np.stack([page[..., 0] - low[0], high[1] - page[..., 1]], axis=-1) / pixel - 0.5)

    # Where three places of the plan are in the orthophoto and on the page.
    extent = storey.extent
    places = np.array([[0, 0], [1, 0], [0, 1]]) * extent.pixel * 100 + (extent.left, extent.top)
    source = np.stack([places[:, 0] - extent.left, extent.top - places[:, 1]], axis=-1) / extent.pixel - 0.5
    warp = cv2.getAffineTransform(source.astype(np.float32), pixels(layout.on_page(places)).astype(np.float32))
    photo = cv2.warpAffine(storey.ceiling, warp, (width, height), flags=cv2.INTER_AREA)
    known = cv2.warpAffine(storey.ceiling_known.astype(np.uint8), warp, (width, height), flags=cv2.INTER_NEAREST)
    shown = np.zeros((height, width), np.bool_)
    for outline in outlines:
        inside = np.zeros((height, width), np.uint8)
        cv2.fillPoly(inside, [np.rint(pixels(outline)).astype(np.int32)], 1)
        seen = (inside > 0) & (known > 0)
        if seen.sum() > _LEAST_SEEN * inside.sum():
            shown |= seen
    picture = cv2.addWeighted(photo, _PHOTO_STRENGTH, np.full_like(photo, 255), 1 - _PHOTO_STRENGTH, 0)
    picture[~shown] = 255
    box = (low[0], low[0] + width * pixel, high[1] - height * pixel, high[1])
    axes.imshow(picture, extent=box, interpolation="none", aspect="auto")
    axes.set(xlim=(0, layout.page_mm[0]), ylim=(0, layout.page_mm[1]))  # which the picture has changed


def _draw_opening(axes: Axes, opening: Opening, layout: _Layout, *, has_text: bool) -> list[FloatArray]:
    """Draw a door or a window with its width, and return what it needs of the rooms, as outlines on the page."""
    from matplotlib.patches import Arc

    ends = layout.on_page(opening.ends)
    along = (ends[1] - ends[0]) / max(float(np.linalg.norm(ends[1] - ends[0])), 1e-9)
    across = np.array([-along[1], along[0]])
    half = (opening.thickness or 0.0) * layout.mm_per_unit / 2
    wedges: list[FloatArray] = []
    if opening.thickness:
        for end in ends:
            _line(axes, np.array([end - half * across, end + half * across]), mm=0.18)
    if opening.kind == "window":
        for offset in (-max(half, 0.6), 0.0, max(half, 0.6)):
            _line(axes, ends + offset * across, mm=0.18, color=_PANE)
    elif opening.leaf is None:
        _line(axes, ends, mm=0.18, color=_FAINT, dashes=(4, 3))
    else:
        hinge, free, closed = (
            layout.on_page(one) for one in (opening.leaf.hinge, opening.leaf.open_end, opening.leaf.closed_end)
        )
        _line(axes, np.array([hinge, free]), mm=0.35)
        turns = [float(np.degrees(np.arctan2(*(end - hinge)[::-1]))) for end in (free, closed)]
        start, end = turns if (turns[1] - turns[0]) % 360 < 180 else turns[::-1]
        size = 2 * float(np.linalg.norm(free - hinge))
        axes.add_patch(
            Arc(
                (float(hinge[0]), float(hinge[1])),
                size,
                size,
                theta1=start,
                theta2=end,
                edgecolor=_INK,
                linewidth=0.13 * _POINT,
            )
        )
        wedges.append(np.array([hinge, free, hinge + (free - hinge) + (closed - hinge), closed]))
    if has_text:
        turn = _reading_angle(along)
        x, y = ends.mean(axis=0).tolist()
        box = {"facecolor": "white", "edgecolor": "none", "pad": 0.4}
        axes.text(x, y, f"{opening.width:.1f}", size=4.5, rotation=turn, ha="center", va="center", bbox=box)
    return wedges


def _reading_angle(along: FloatArray) -> float:
    """Return the angle (deg) of text along a direction that is read from below or from the right."""
    return (round(float(np.degrees(np.arctan2(along[1], along[0]))), 3) + 89.9) % 180 - 89.9


def _draw_side_lengths(axes: Axes, room: Room, size: RoomSize, layout: _Layout) -> None:
    """Write the lengths of the sides of a room along them, inside."""
    starts = layout.on_page(room.outline)
    for start, end, length in zip(starts, np.roll(starts, -1, axis=0), size.sides, strict=True):
        long = float(np.linalg.norm(end - start))
        if long < 9:
            continue
        along = (end - start) / long
        x, y = ((start + end) / 2 + 1.8 * np.array([-along[1], along[0]])).tolist()
        turn = _reading_angle(along)
        axes.text(x, y, f"{length.value:.2f}", size=5, rotation=turn, color=_FAINT, ha="center", va="center")


def measure_text(measure: Measure, unit: str, *, digits: int = 2) -> str:
    """Return a measure with twice its standard deviation; "unknown" if it is NaN.

    >>> measure_text(Measure(2.5, 0.006), "m"), measure_text(Measure(2.5, float("nan")), "m")
    ('2.50 ± 0.01 m', '2.50 m')
    """
    if np.isnan(measure.value):
        return "unknown"
    error = "" if np.isnan(measure.std) else f" ± {max(2 * measure.std, 0.5 * 10**-digits):.{digits}f}"
    return f"{measure.value:.{digits}f}{error} {unit}".rstrip()


def _units(settings: SheetSettings) -> tuple[str, str]:
    return ("m", "m²") if settings.is_metric else ("units", "units²")


def _room_text(name: str, size: RoomSize, settings: SheetSettings, *, is_ceiling: bool) -> list[str]:
    """Return the lines of the text in a room."""
    length, area = _units(settings)
    height = "height unknown" if np.isnan(size.height.value) else f"h {measure_text(size.height, length)}"
    if is_ceiling:
        return [name, height]
    error = "" if np.isnan(size.extent_std) else f" ± {max(2 * size.extent_std, 0.005):.2f}"
    least = "" if size.is_closed else "over "
    return [
        name,
        f"{size.extent_text}{error} {length}",
        least + measure_text(size.area, area, digits=1),
        height,
    ]


def _draw_room_text(axes: Axes, room: Room, lines: Sequence[str], taken: Sequence[FloatArray], layout: _Layout) -> None:
    """Write the text of a room where it has space, or if it has none, its first line."""
    per_mm = 4.0  # pixels of the grid in which space is looked for
    corners = layout.on_page(room.outline)
    low = corners.min(axis=0) - 1
    size = np.ceil((corners.max(axis=0) + 1 - low) * per_mm).astype(int)
    free = np.zeros((size[1], size[0]), np.uint8)
    cv2.fillPoly(free, [np.rint((corners - low) * per_mm).astype(np.int32)], 1)
    for part in (*(layout.on_page(hole) for hole in room.holes), *taken):
        cv2.fillPoly(free, [np.rint((part - low) * per_mm).astype(np.int32)], 0)
    name = textwrap.wrap(lines[0], 24)
    lines, titles = [*name, *lines[1:]], len(name)
    for count in (len(lines), 1):
        for points in _SIZES_PT:
            wide, high = _text_size_mm(lines[:count], points)
            kernel = np.ones((max(1, round((high + 1) * per_mm)), max(1, round((wide + 1) * per_mm))), np.uint8)
            space = cv2.erode(free, kernel, borderType=cv2.BORDER_CONSTANT, borderValue=0)
            if not space.any() and (count > 1 or points > _SIZES_PT[-1]):
                continue
            depth = cv2.distanceTransform(np.pad(space if space.any() else free, 1), cv2.DIST_L2, 5)[1:-1, 1:-1]
            row, column = np.unravel_index(int(np.argmax(depth)), depth.shape)
            x, y = (np.array([column, row]) / per_mm + low).tolist()
            step = 1.25 * points / _POINT
            for number, line in enumerate(lines[:count]):
                place = y + ((count - 1) / 2 - number) * step
                weight = "bold" if number < titles else "normal"
                axes.text(x, place, line, size=points, weight=weight, ha="center", va="center")
            return


def _text_size_mm(lines: Sequence[str], points: float) -> tuple[float, float]:
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import TextPath

    widths = [
        TextPath(
            (0, 0),
            line,
            size=points,
            prop=FontProperties(family="DejaVu Sans", weight="bold" if idx == 0 else "normal"),
        )
        .get_extents()
        .width
        for idx, line in enumerate(lines)
    ]
    return max(widths) / _POINT, 1.25 * points * len(lines) / _POINT


def _draw_block(axes: Axes, storey: StoreySheet, settings: SheetSettings, layout: _Layout, *, is_ceiling: bool) -> None:
    """Draw the frame and the title block: what it is, its scale, unit and north, and what lines mean."""
    width, _ = layout.page_mm
    kind = "Reflected ceiling plan" if is_ceiling else "Floor plan"
    scale = f"Scale 1:{layout.scale} on {settings.paper.upper()}" if layout.scale else "No scale: no length is known"
    _draw_frame(axes, layout.page_mm, settings.title, f"{kind}, {storey.title}", scale)
    unit = "metres" if settings.is_metric else "scene units"
    notes = (
        f"Clear lengths in {unit}; ± two standard deviations. Widths of doors and windows are approximate.",
        f"Unit of length: {settings.source or 'not stated'}",
        "As in a mirror on the floor: left and right are those of the floor plan."
        if is_ceiling
        else "Filled: walls of which both sides were seen. Dashed: openings without a leaf that was seen.",
    )
    left = _left_of_notes(width)
    _draw_notes(axes, notes, left=left, right=width - _MARGIN - 22)
    right = width - _MARGIN - 22
    axes.plot([right, right], [_MARGIN, _MARGIN + _BLOCK], color=_INK, linewidth=0.2 * _POINT)
    _draw_north(axes, (right + 11, _MARGIN + _BLOCK / 2), layout if settings.has_north else None)
    _draw_bar(axes, (left + 3, _MARGIN + 3.5), settings, layout, most=right - left - 22)


def _draw_frame(axes: Axes, page_mm: tuple[float, float], *titles: str) -> None:
    width, height = page_mm
    frame = np.array([[_MARGIN, _MARGIN], [width - _MARGIN, height - _MARGIN]])
    (x0, y0), (x1, y1) = frame.tolist()
    axes.add_patch(
        _polygon(
            np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]]), fill=False, edgecolor=_INK, linewidth=0.35 * _POINT
        )
    )
    axes.plot([x0, x1], [y0 + _BLOCK, y0 + _BLOCK], color=_INK, linewidth=0.35 * _POINT)
    left = _left_of_notes(width)
    axes.plot([left, left], [y0, y0 + _BLOCK], color=_INK, linewidth=0.2 * _POINT)
    wide = left - x0 - 6
    title = textwrap.wrap(titles[0], max(8, int(wide / 2.5))) or [""]
    points = min(10.0, 30 / len(title))
    y = y0 + _BLOCK - 3 - 0.2 * points
    for line in title:
        axes.text(x0 + 3, y, line, size=points, weight="bold", va="center")
        y -= 0.55 * points
    for line in titles[1:]:
        axes.text(x0 + 3, y, line, size=7.5, va="center")
        y -= 4.5


def _left_of_notes(width: float) -> float:
    return _MARGIN + 0.34 * (width - 2 * _MARGIN)


def _draw_notes(axes: Axes, notes: Sequence[str], *, left: float, right: float) -> None:
    """Write notes into the title block, as many lines as it holds."""
    characters = int((right - left - 6) / 1.1)  # of 5.5 points
    lines = [line for note in notes for line in textwrap.wrap(note, characters)]
    for number, line in enumerate(lines[:5]):
        axes.text(left + 3, _MARGIN + _BLOCK - 4 - 3.4 * number, line, size=5.5, va="center")


def _draw_north(axes: Axes, place: tuple[float, float], layout: _Layout | None) -> None:
    x, y = place
    if layout is None:
        axes.text(x, y, "north\nunknown", size=6, color=_FAINT, ha="center", va="center")
        return
    north = layout.turn @ np.array([0.0, 1.0])
    side = np.array([-north[1], north[0]])
    middle = np.array([x, y - 1.5])
    axes.add_patch(
        _polygon(
            middle + np.array([8 * north, -6 * north + 3 * side, -4 * north]),
            facecolor=_INK,
            edgecolor=_INK,
            linewidth=0.2,
        )
    )
    axes.add_patch(
        _polygon(
            middle + np.array([8 * north, -4 * north, -6 * north - 3 * side]), fill=False, edgecolor=_INK, linewidth=0.6
        )
    )
    x, y = (middle + 10.5 * north).tolist()
    axes.text(x, y, "N", size=7, weight="bold", ha="center", va="center")


def _draw_bar(axes: Axes, place: tuple[float, float], settings: SheetSettings, layout: _Layout, *, most: float) -> None:
    """Draw a scale bar of a round length of at most `most` mm, in four parts, filled by turns."""
    length = bar_length(4 * most / layout.mm_per_unit)
    part = length * layout.mm_per_unit / 4
    x, y = place
    for number in range(4):
        left, right = x + number * part, x + (number + 1) * part
        corners = np.array([[left, y], [right, y], [right, y + 1.6], [left, y + 1.6]])
        axes.add_patch(
            _polygon(corners, facecolor="white" if number % 2 else _INK, edgecolor=_INK, linewidth=0.15 * _POINT)
        )
    for number in (0, 2, 4):
        axes.text(x + number * part, y + 3, f"{length * number / 4:g}", size=5, ha="center", va="center")
    axes.text(x + 4 * part + 2.5, y + 0.8, "m" if settings.is_metric else "scene units", size=5.5, va="center")


_COLUMNS = ("room", "length", "width", "height", "area", "volume", "doors", "windows")
_SHARES = (0.0, 0.235, 0.38, 0.525, 0.645, 0.77, 0.9, 0.95)
_ROW_MM = 5.0


def _tables(
    storeys: Sequence[StoreySheet], settings: SheetSettings, page_mm: tuple[float, float]
) -> list[list[Sequence[str]]]:
    """Return the rows of the tables of rooms, a list for each page."""
    length, area = _units(settings)
    rows: list[Sequence[str]] = []
    for storey in storeys:
        rows.append((storey.title,))
        for room, (name, size) in enumerate(zip(storey.room_names, storey.plan.sizes, strict=True)):
            counts = storey.plan.opening_counts(room)
            volume = volume_of(size)
            most = "" if size.is_rectangle or not size.is_closed else "max. "
            rows.append((
                name,
                most + measure_text(size.length, length),
                most + measure_text(size.width, length),
                measure_text(size.height, length),
                ("" if size.is_closed else "over ") + measure_text(size.area, area, digits=1),
                measure_text(volume, length + "³", digits=1),
                str(counts["door"]),
                str(counts["window"]),
            ))  # fmt: skip
    held = int((page_mm[1] - 2 * _MARGIN - _BLOCK - 2 * _PAD) / _ROW_MM) - 2
    return [rows[start : start + held] for start in range(0, len(rows), held)]


def _draw_table(
    axes: Axes, rows: Sequence[Sequence[str]], settings: SheetSettings, page_mm: tuple[float, float]
) -> None:
    _draw_frame(axes, page_mm, settings.title, "Rooms")
    left, width = _MARGIN + _PAD, page_mm[0] - 2 * (_MARGIN + _PAD)
    y = page_mm[1] - _MARGIN - _PAD
    for row in (_COLUMNS, *rows):
        weight = "bold" if row is _COLUMNS or len(row) == 1 else "normal"
        for text, share in zip(row, _SHARES, strict=False):
            axes.text(left + share * width, y, text, size=5.5, weight=weight, va="center")
        y -= _ROW_MM
        if row is _COLUMNS:
            axes.plot([left, left + width], [y + 0.55 * _ROW_MM] * 2, color=_INK, linewidth=0.2 * _POINT)
    notes = ("± two standard deviations.", f"Unit of length: {settings.source or 'not stated'}")
    _draw_notes(axes, notes, left=_left_of_notes(page_mm[0]), right=page_mm[0] - _MARGIN)
