"""A cost curve as a picture: what the neighbours say, and below it what semi-global matching made of that."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pano_mvs.io.images.preview import scale_ticks
from pano_mvs.scene.image_files.image_file import write_png
from pano_mvs.viewer.inspect.drawing_board import Color, DrawingBoard, Letters
from pano_mvs.viewer.inspect.inspection import Inspection

_WIDTH, _LEFT, _RIGHT = 1040, 78, 1016
_TOP, _PANEL, _GAP, _BOTTOM = 106, 300, 46, 88
_INK, _FAINT, _GRID = (45, 45, 50), (120, 120, 128), (232, 232, 236)
_DECISIVE, _RAW = (22, 96, 167), (90, 100, 115)
_SOURCES: tuple[Color, ...] = ((226, 160, 90), (120, 180, 120), (190, 140, 190), (120, 190, 200), (214, 140, 140))
_WINNER, _RIVAL, _TRUTH = (200, 50, 50), (210, 130, 30), (20, 130, 80)
# How wide the text at a mark may be.
_TAG = 170
_STEPS = (0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10)


def write_curve_picture(path: Path, inspection: Inspection) -> None:
    """Write a PNG of a pixel's cost curve, with the winner, the runner-up and, if it is known, the truth.

    Raises:
        OSError: if the file cannot be written.
    """
    curve = inspection.curve
    panels = 1 if curve.aggregated is None else 2
    height = _TOP + panels * _PANEL + (panels - 1) * _GAP + _BOTTOM
    board = DrawingBoard((height, _WIDTH))
    _write_title(board, inspection)
    drawn = np.concatenate([curve.raw, curve.by_source[np.isfinite(curve.by_source)]])
    raw = _Panel(board, inspection, _TOP, drawn)
    raw.axes("cost before the decision, as a share of the worst there is", ranges=panels == 1)
    raw.sources()
    raw.curve(curve.raw, _RAW if panels == 2 else _DECISIVE)
    raw.marks(curve.raw)
    if curve.aggregated is not None:
        paths = _Panel(board, inspection, _TOP + _PANEL + _GAP, curve.aggregated)
        paths.axes("after semi-global matching: mean cost of the eight paths", ranges=True)
        paths.curve(curve.aggregated, _DECISIVE)
        paths.marks(curve.aggregated)
    _write_legend(board, inspection, height - 16)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_png(path, board.picture())


class _Panel:
    """One plot of costs over the depth hypotheses, at equal distances."""

    def __init__(self, board: DrawingBoard, inspection: Inspection, upper: float, costs: NDArray[np.float64]) -> None:
        self.board, self.inspection = board, inspection
        self.ranges = inspection.curve.ranges
        self.upper, self.lower = upper, upper + _PANEL
        self.highest = 1.1 * max(float(costs.max()), 0.02)

    def at(self, plane: float, cost: float) -> tuple[float, float]:
        """Return where a cost at a place among the planes is drawn."""
        share = plane / (len(self.ranges) - 1)
        height = min(cost / self.highest, 1.0)
        return _LEFT + share * (_RIGHT - _LEFT), self.lower - height * (self.lower - self.upper)

    def plane_of(self, distance: float) -> float:
        """Return where among the planes a range lies; beyond either end, that end."""
        return float(np.interp(distance, self.ranges, np.arange(len(self.ranges))))

    def axes(self, title: str, *, ranges: bool) -> None:
        """Draw the grid, the costs and the ranges, which are named if `ranges`."""
        step = next((step for step in _STEPS if self.highest / step < 6), _STEPS[-1])
        for cost in np.arange(0, self.highest, step):
            y = self.at(0, cost)[1]
            self.board.line([(_LEFT, y), (_RIGHT, y)], _GRID)
            self.board.write(f"{cost:.2f}", (_LEFT - 8, y + 5), Letters(color=_FAINT, align=1))
        self.board.write(title, (_LEFT, self.upper - 8), Letters(color=_FAINT))
        taken = -np.inf
        for tick in scale_ticks(float(self.ranges[0]), float(self.ranges[-1])):
            x = self.at(self.plane_of(tick), 0)[0]
            self.board.line([(x, self.lower), (x, self.lower + 5)], _FAINT)
            if ranges and x - taken > 44:
                self.board.write(f"{tick:g}", (x, self.lower + 22), Letters(color=_FAINT, align=0.5))
                taken = x
        self.board.line([(_LEFT, self.lower), (_RIGHT, self.lower)], _FAINT)

    def sources(self) -> None:
        """Draw the costs in each neighbour by itself."""
        for idx, costs in enumerate(self.inspection.curve.by_source):
            self.curve(costs, _SOURCES[idx % len(_SOURCES)], 1)

    def curve(self, costs: NDArray[np.float64], color: Color, weight: int = 2) -> None:
        """Draw a curve, with gaps where it is not known."""
        known = np.concatenate([[False], np.isfinite(costs), [False]])
        for start, stop in np.flatnonzero(np.diff(known.astype(np.int8))).reshape(-1, 2):
            self.board.line([self.at(plane, float(costs[plane])) for plane in range(start, stop)], color, weight)

    def marks(self, costs: NDArray[np.float64]) -> None:
        """Draw the winner, the next valley and the true range."""
        curve, truth = self.inspection.curve, self.inspection.true_range
        x, y = self.at(curve.winner, float(costs[curve.winner]))
        if np.isfinite(truth):
            true_x = self.at(self.plane_of(truth), 0)[0]
            self.board.dashes((true_x, self.upper), (true_x, self.lower), _TRUTH)
            self.tag(f"truth {truth:.4g}", (true_x, self.upper - 6), _TRUTH, true_x)
        other_x = x
        if curve.runner_up is not None:
            other_x, other_y = self.at(curve.runner_up, float(costs[curve.runner_up]))
            self.board.dot((other_x, other_y), _RIVAL, filled=False)
            self.tag(f"next valley {curve.ranges[curve.runner_up]:.4g}", (other_x, other_y), _RIVAL, x)
        self.board.dot((x, y), _WINNER, filled=True)
        shown = curve.range if np.isfinite(curve.range) else curve.ranges[curve.winner]
        self.tag(f"winner {shown:.4g}", (x, y), _WINNER, other_x)

    def tag(self, text: str, spot: tuple[float, float], color: Color, other_x: float) -> None:
        """Write below a mark, where there is room, on the side away from another mark that is near."""
        x, y = spot
        leftwards = x > 0.75 * _WIDTH or (x < other_x < x + 2 * _TAG and x > _LEFT + _TAG)
        below = y + 22 if y < self.lower - 24 else y - 10
        place = x + (-12 if leftwards else 12), below
        self.board.write(text, place, Letters(color=color, align=float(leftwards)), on_paper=True)


def _write_title(board: DrawingBoard, found: Inspection) -> None:
    settings, curve = found.settings, found.curve
    board.write(f"{found.image}, pixel ({found.column}, {found.row})", (24, 34), Letters(0.68, _INK))
    sure = f"confidence {curve.confidence}" if curve.confidence else "no range"
    board.write(
        f"{found.sweep}: {settings.cost}, window {settings.window}, {settings.combination}, "
        f"{settings.aggregation}, {settings.planes} planes ({settings.spacing}); {sure}, "
        f"unique by {100 * curve.uniqueness:.0f} %",
        (24, 62),
        Letters(0.46, _FAINT),
    )


def _write_legend(board: DrawingBoard, found: Inspection, y: float) -> None:
    board.write("depth hypothesis, scene units", ((_LEFT + _RIGHT) / 2, y - 26), Letters(color=_FAINT, align=0.5))
    by_paths = found.curve.aggregated is not None
    entries = [
        (source.name.rsplit("/", 1)[-1], _SOURCES[idx % len(_SOURCES)], 1) for idx, source in enumerate(found.sources)
    ]
    entries.append((f"combined ({found.settings.combination})", _RAW if by_paths else _DECISIVE, 2))
    x = float(_LEFT)
    for text, color, weight in entries:
        board.line([(x, y - 4), (x + 22, y - 4)], color, weight)
        x += 46 + board.write(text, (x + 28, y), Letters(0.42, _INK))
