"""The costs of one pixel at all depth hypotheses, exactly as in the sweep; for tuning its settings.

Nothing is approximated by a crop. Before the decision a pixel's cost depends on its window alone. Semi-global matching
adds, for eight directions, the path that ends in the pixel; each path reads the costs along one line from pole to
pole, or once around. So the costs along these lines, with their warm-up, give the very sums of the whole panorama.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.sweep.backends.numpy_backend import combined_cost, path_step, winners_of
from pano_mvs.algorithms.sweep.edge_support import averaged_at
from pano_mvs.algorithms.sweep.penalties import DIRECTIONS, step_penalties, warm_up
from pano_mvs.algorithms.sweep.preparation import SweepInput, has_match, valid_where_seen
from pano_mvs.algorithms.sweep.winner import Winners, range_map_from_winners
from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import pixel_from_ray, ray_from_pixel, sample_panorama


def costs_at(work: SweepInput, rows: NDArray[np.intp], columns: NDArray[np.intp]) -> NDArray[np.float32]:
    """Return the mean costs of pixels before the decision, (D, N), combined from the sources, not scaled.

    `work`: what is swept. `rows`: (N,) of the pixels. `columns`: (N,) likewise.
    """
    if work.settings.matching_cost.kernel is None:
        planes = [combined_cost(work, virtual_range)[rows, columns] for virtual_range in work.ranges]
        return np.asarray(planes, dtype=np.float32)
    return _compiled_costs(work, rows, columns)


def _compiled_costs(work: SweepInput, rows: NDArray[np.intp], columns: NDArray[np.intp]) -> NDArray[np.float32]:
    """Sweep the tiles in which the pixels lie, range by range: the winner's cost is then that of the range."""
    # On use: numba is slow to import.
    from pano_mvs.algorithms.sweep.numba.arguments import (
        NO_VOLUME,
        fresh_state,
        run_arguments,
        runs_of,
        sweep_arguments,
        tile_means,
    )
    from pano_mvs.algorithms.sweep.numba.kernels_band import sweep_band
    from pano_mvs.algorithms.sweep.numba.kernels_winner import BEST

    height, width = work.reference.shape[:2]
    wanted = np.zeros((height, width), np.bool_)
    wanted[rows, columns] = True
    sweep = sweep_arguments(work)
    costs = np.empty((len(work.ranges), len(rows)), np.float32)
    for run in runs_of(tile_means(wanted) > 0, (height, width), sweep.windows):
        down, across = rows - run.first, columns - run.start
        own = np.flatnonzero((down >= 0) & (down < run.rows) & (across >= 0) & (across < run.columns))
        place = down[own], across[own] + run.margin
        arguments = run_arguments(sweep, run)
        for idx in range(len(work.ranges)):
            state, planes = fresh_state(run.rows, run.columns + 2 * run.margin)
            sweep_band(run.first, arguments, arguments.others, work.ranges[idx : idx + 1], NO_VOLUME, state, planes)
            costs[idx, own] = state[BEST][place]
    return costs


def votes_at(work: SweepInput, source_idx: int, *, row: int, column: int) -> NDArray[np.bool_]:
    """Return at which depth hypotheses a source is valid for a pixel, (D,): all pixels sampled there are."""
    if work.source_valid is None:
        return np.ones(len(work.ranges), np.bool_)
    valid = work.source_valid[source_idx]
    points = work.source_from_reference[source_idx].apply(_points_at(work, row, column))
    pixels = pixel_from_ray(points, (valid.shape[0], valid.shape[1]))
    return np.asarray(sample_panorama(valid, pixels) > 1 - 1e-9)


def is_seen(work: SweepInput, *, row: int, column: int, plane: int) -> bool:
    """Return whether a sweep keeps a pixel's winner: a source sees it in a valid pixel; see `sees_winner`."""
    point = _points_at(work, row, column)[plane]
    return work.source_valid is None or any(
        bool(valid_where_seen(valid, pose.apply(point)))
        for pose, valid in zip(work.source_from_reference, work.source_valid, strict=True)
    )


def _points_at(work: SweepInput, row: int, column: int) -> NDArray[np.float64]:
    ray = ray_from_pixel([column + 0.5, row + 0.5], (work.reference.shape[0], work.reference.shape[1]))
    return work.ranges[:, None] * ray


_WORST = 255


@dataclass(frozen=True, eq=False)
class CostCurve:
    """The costs of one pixel at every depth hypothesis, as shares of the worst cost; a chance match has ½.

    `ranges`: (D,) depth hypotheses in scene units, ascending. `by_source`: (S, D) cost in each source; NaN where the
    source is not valid. `raw`: (D,) cost combined from the sources, before the decision. `aggregated`: (D,) mean cost
    of the eight paths of semi-global matching, what steps between the planes cost included, so it may exceed 1; None if
    it is not asked for. `winner`: index of the range that wins. `runner_up`: index of the bottom of the deepest other
    valley; None if there is none. `uniqueness`: how much cheaper the winner is than the best range that is not next to
    it, as a share of that one's cost: 0 says that both are as good. The confidence "peak_ratio" is made of it. `range`:
    of the pixel, between the hypotheses, as `selection` says; NaN if the sweep leaves it without. `confidence`: 64–127,
    or 0 where there is no range. `reason`: why it has no range; empty if it has.
    """

    ranges: FloatArray
    by_source: FloatArray
    raw: FloatArray
    aggregated: FloatArray | None
    winner: int
    runner_up: int | None
    uniqueness: float
    range: float
    confidence: int
    reason: str = ""

    @property
    def decisive(self) -> FloatArray:
        """The costs by which the winner was chosen, (D,)."""
        return self.raw if self.aggregated is None else self.aggregated


def cost_curve(work: SweepInput, *, column: int, row: int, masked: bool = False) -> CostCurve:
    """Return the costs of one pixel of the reference at all depth hypotheses.

    They are those of a sweep from which every range is tried everywhere (`levels` 1), by the compiled backend for
    built-in costs and by the readable one for a plugin's, which takes as long as a sweep by it.

    `work`: what would be swept, see `sweep_input`. `column`: of the pixel, from 0. `row`: likewise. `masked`: whether
    the reference is masked there.

    Raises:
        UsageError: if the image has no such pixel.
    """
    height, width = work.reference.shape[:2]
    if not (0 <= column < width and 0 <= row < height):
        raise UsageError(
            f"pixel ({column}, {row}) is not in a picture of {width}×{height}: columns are 0 to "
            f"{width - 1}, rows 0 to {height - 1}"
        )
    here = np.array([row]), np.array([column])
    worst = work.settings.worst_cost
    raw = costs_at(work, *here)[:, 0].astype(np.float64)
    sums = _path_sums(work, row, column) if work.settings.aggregation == "sgm" else None
    decisive = raw if sums is None else sums
    winners = winners_of(decisive[None, :, None])
    reason = _why_not(work, winners, row=row, column=column, masked=masked)
    found = range_map_from_winners(
        winners, range_at=work.range_at, settings=work.settings, seen=np.full((1, 1), not reason)
    )
    winner = int(winners.plane[0, 0])
    padded = np.pad(decisive, 1, constant_values=np.inf)
    bottom = (decisive <= padded[:-2]) & (decisive <= padded[2:]) & (np.abs(np.arange(len(decisive)) - winner) > 1)
    valleys = np.flatnonzero(bottom)
    return CostCurve(
        ranges=work.ranges,
        by_source=np.stack([_of_source(work, idx, row=row, column=column) for idx in range(len(work.sources))]) / worst,
        raw=raw / worst,
        aggregated=None if sums is None else sums / (8 * _WORST),
        winner=winner,
        runner_up=int(valleys[np.argmin(decisive[valleys])]) if len(valleys) else None,
        uniqueness=_uniqueness(float(winners.cost[0, 0]), float(winners.rival[0, 0])),
        range=float(found.range[0, 0]),
        confidence=int(found.confidence[0, 0]),
        reason=reason,
    )


def _uniqueness(cost: float, rival: float) -> float:
    if np.isinf(rival):
        return 1.0
    return (rival - cost) / rival if rival > 0 else 0.0


def _of_source(work: SweepInput, idx: int, *, row: int, column: int) -> FloatArray:
    """Return the costs, (D,), of a source by itself, NaN where it is not valid."""
    alone = replace(
        work,
        sources=work.sources[idx : idx + 1],
        source_from_reference=work.source_from_reference[idx : idx + 1],
        source_valid=None if work.source_valid is None else work.source_valid[idx : idx + 1],
        settings=work.settings.replace(combination="sum"),
    )
    costs = costs_at(alone, np.array([row]), np.array([column]))[:, 0]
    return np.where(votes_at(work, idx, row=row, column=column), costs, np.nan)


def _why_not(work: SweepInput, winners: Winners, *, row: int, column: int, masked: bool) -> str:
    """Return why the pixel is left without a range; empty if it is not."""
    plane = int(winners.plane[0, 0])
    if masked:
        return "the picture is masked here"
    if not is_seen(work, row=row, column=column, plane=plane):
        return "every source is masked where the winner would be"
    if work.settings.no_match == "keep":
        return ""
    everywhere = np.full(work.reference.shape[:2], plane, np.int32)
    nowhere = np.zeros((0, 0), np.float32)
    if has_match(Winners(everywhere, nowhere, nowhere, nowhere, nowhere), work)[row, column]:
        return ""
    return "it runs to a limit where all ranges match alike (no_match: invalid)"


def _path_sums(work: SweepInput, row: int, column: int) -> FloatArray:
    """Return the sums of the eight paths' costs in a pixel, (D,)."""
    lines = _lines(work, row, column)
    rows, columns = (np.concatenate([line[part] for line in lines]) for part in (0, 1))
    pixels, back = np.unique(rows * work.reference.shape[1] + columns, return_inverse=True)
    pixel_rows, pixel_columns = np.divmod(pixels, work.reference.shape[1])
    stored = averaged_at(partial(_stored_costs, work), work, rows=pixel_rows, columns=pixel_columns)
    of_lines = stored[:, back]
    p1, _ = work.settings.penalties(work.reference.shape[0])
    total = np.zeros(len(work.ranges), np.int64)
    start = 0
    for line_rows, _, penalties in lines:
        line = of_lines[:, start : start + len(line_rows)]
        start += len(line_rows)
        path = np.zeros((len(total), 1), np.int64)
        for i, penalty in enumerate(penalties):
            path = path_step(line[:, i : i + 1], path, penalty, p1=p1)
        total += path[:, 0]
    return total.astype(np.float64)


def _stored_costs(work: SweepInput, rows: NDArray[np.intp], columns: NDArray[np.intp]) -> NDArray[np.int64]:
    """Return the costs of pixels as they are in the volume, (D, N)."""
    costs = costs_at(work, rows, columns)
    stored = np.floor(np.minimum(costs * np.float32(work.settings.cost_scale) + np.float32(0.5), _WORST))
    return np.asarray(stored, np.int64)


Line = tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.int64]]


def _lines(work: SweepInput, row: int, column: int) -> list[Line]:
    """Return the rows, the columns and the penalties of the steps of each path that ends in a pixel."""
    height, width = work.reference.shape[:2]
    before_pole, before_seam = warm_up((height, width))
    lines = []
    for direction in DIRECTIONS:
        down, drift = direction
        last = row if down > 0 else height - 1 - row
        steps = np.arange(-before_pole, last + 1)
        # Before the pole a path runs on the other side of the sphere, towards it.
        walked = np.where(steps >= 0, steps, -1 - steps)
        rows = walked if down > 0 else height - 1 - walked
        columns = column - drift * (last - steps) - np.where(steps >= 0, 0, width // 2)
        lines.append(_line(work, direction, rows, columns=columns % width))
    for step in (1, -1):
        last = column if step > 0 else width - 1 - column
        steps = np.arange(-before_seam, last + 1) % width
        columns = steps if step > 0 else width - 1 - steps
        lines.append(_line(work, (0, step), np.full(len(columns), row), columns=columns))
    return lines


def _line(work: SweepInput, direction: tuple[int, int], rows: NDArray[np.intp], *, columns: NDArray[np.intp]) -> Line:
    penalties = step_penalties(work.contrast_picture, direction, work.settings)[rows, columns]
    return rows, columns, penalties.astype(np.int64)[:, None]
