"""The sweep at full resolution among candidates around two guides."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.sweep.edge_support import average_volume
from pano_mvs.algorithms.sweep.exposure import shrink
from pano_mvs.algorithms.sweep.hypotheses import virtual_ranges
from pano_mvs.algorithms.sweep.numba.arguments import (
    BAND_ROWS,
    NO_VOLUME,
    TileRun,
    fresh_state,
    run_arguments,
    runs_of,
    spread_tiles,
    sweep_arguments,
    tile_means,
)
from pano_mvs.algorithms.sweep.numba.kernels_band import sweep_band
from pano_mvs.algorithms.sweep.numba.kernels_guided import (
    PER_PLANE,
    adopt_candidates,
    cheapest_candidates,
    follow_guided_rows,
    follow_guided_strip,
    split_layers,
    sweep_guided_band,
)
from pano_mvs.algorithms.sweep.numba.kernels_records import Guide
from pano_mvs.algorithms.sweep.numba.kernels_winner import BEST
from pano_mvs.algorithms.sweep.numba.slanted import STEPS, TABLE_PER_PLANE, inverse_table
from pano_mvs.algorithms.sweep.numba.threads import Pool, run_jobs, workers
from pano_mvs.algorithms.sweep.penalties import DIRECTIONS, step_penalties, warm_up
from pano_mvs.algorithms.sweep.preparation import SweepInput, is_bare, pixels_with_valid_window
from pano_mvs.algorithms.sweep.winner import Winners, subplane_offset
from pano_mvs.geometry import pad_panorama

_COUNT = 2 * STEPS + 1
_STRIP_LINES = 64
_ROW_LINES = 32
# Guides closer than this are one surface.
_MIN_GAP = 0.5
_SEARCH_STEP = 2
_ADOPT_RADIUS = 2


class GuidedSweep:
    """One sweep around guides; see `coarse_to_fine`.

    `work`: what is swept. `guides`: (2, H, W) float32 positions among its planes. `volume`: (H, 2 · 7, W) costs of the
    candidates: uint8 for semi-global matching, else float32 means.
    """

    def __init__(self, work: SweepInput, guides: NDArray[np.float32], pool: Pool) -> None:
        height, width = work.reference.shape[:2]
        self.work, self.guides, self._pool = work, guides, pool
        self._by_paths = work.settings.aggregation == "sgm"
        self.volume = np.empty((height, 2 * _COUNT, width), np.uint8 if self._by_paths else np.float32)
        self._shared = sweep_arguments(work)
        self._table = inverse_table(work)

    def find_winners(self) -> Winners:
        """Return the winning candidates and the costs around them."""
        everywhere = np.ones(self.guides.shape[1:], np.bool_)
        self._sweep(0, everywhere)
        self.volume[:, _COUNT:] = self.volume[:, :_COUNT]
        self._sweep(1, np.abs(self.guides[1] - self.guides[0]) > _MIN_GAP)
        self._search()
        if self._by_paths:
            average_volume(self.volume, self.work)
        return self._decide(self._aggregated() if self._by_paths else self.volume)

    def _sweep(self, layer: int, active: NDArray[np.bool_]) -> None:
        """Compute the costs around one guide in all tiles in which any pixel is active."""
        halo = self.work.settings.compare_radius + self.work.settings.box_radius
        guide = pad_panorama(self.guides[layer], halo)[:, halo:-halo] if halo else self.guides[layer]
        run_jobs(
            self._pool,
            partial(self._sweep_run, layer=layer, guide=guide, halo=halo),
            runs_of(tile_means(active) > 0, active.shape, self._shared.windows),
        )

    def _sweep_run(self, run: TileRun, *, layer: int, guide: NDArray[np.float32], halo: int) -> None:
        columns = run.with_margin % guide.shape[1]
        around = np.ascontiguousarray(guide[run.first : run.first + run.rows + 2 * halo][:, columns])
        sweep = run_arguments(self._shared, run)
        if not self._by_paths:
            sweep = sweep._replace(scale=np.float32(0))
        costs = np.empty((run.rows, _COUNT, len(columns)), self.volume.dtype)
        sweep_guided_band(run.first, sweep, sweep.others, Guide(around, self._table, TABLE_PER_PLANE), costs)
        rows, own = run.place
        self.volume[rows, layer * _COUNT : (layer + 1) * _COUNT, own] = costs[:, :, run.inner]

    def _search(self) -> None:
        """Sweep tiles over all ranges where the guides do not match, and let better matches replace a guide."""
        settings, unit = self.work.settings, 255.0 if self._by_paths else self.work.settings.worst_cost
        least = self.volume.min(axis=1).astype(np.float32)
        usual = spread_tiles(tile_means(least), least.shape)
        # Shares of the worst cost: a match this dear is a poor one; it is odd if it is dearer than its tile by this;
        # and another is better if it is cheaper by this.
        odd = (least > 0.2 * unit) & (least > usual + 0.15 * unit) & ~is_bare(self.work.reference)
        tiles = tile_means(odd) > 0.03
        runs = runs_of(tiles, least.shape, self._shared.windows)
        if not runs:
            return
        plane = np.zeros(least.shape, np.float32)
        costs = np.full(least.shape, np.inf, np.float32)
        run_jobs(self._pool, partial(self._search_run, plane, costs), runs)
        costs *= unit / settings.worst_cost
        costs[~(costs + 0.03 * unit < least)] = np.inf
        adopted = np.full(least.shape, np.nan, np.float32)
        padded = [pad_panorama(picture, _ADOPT_RADIUS) for picture in (plane, costs)]
        adopt_candidates(*padded, _ADOPT_RADIUS, np.float32(3), adopted)
        self._adopt(np.where(spread_tiles(tiles, least.shape), adopted, np.nan))

    def _search_run(self, plane: NDArray[np.float32], costs: NDArray[np.float32], run: TileRun) -> None:
        state, planes = fresh_state(run.rows, len(run.with_margin))
        farthest = int(self.guides[(slice(None), *run.place)].max()) + STEPS
        ranges = np.ascontiguousarray(self.work.ranges[: farthest + 1 : _SEARCH_STEP])
        sweep = run_arguments(self._shared, run)
        sweep_band(run.first, sweep, sweep.others, ranges, NO_VOLUME, state, planes)
        plane[run.place] = _SEARCH_STEP * planes[:, run.inner]
        costs[run.place] = state[BEST][:, run.inner]

    def _adopt(self, adopted: NDArray[np.float32]) -> None:
        """Put a third surface in the place of the dearer guide, or beside the only one, and sweep there again."""
        taken = np.isfinite(adopted)
        first, second = self.volume[:, :_COUNT].min(axis=1), self.volume[:, _COUNT:].min(axis=1)
        single = np.abs(self.guides[1] - self.guides[0]) <= _MIN_GAP
        replaces_first = np.where(single, adopted < self.guides[0], first > second)
        for layer, replaced in enumerate((taken & replaces_first, taken & ~replaces_first)):
            self.guides[layer][replaced] = adopted[replaced]
            self._sweep(layer, replaced)

    def _aggregated(self) -> NDArray[np.uint16]:
        """Return the sums of eight paths, (H, 2 · 7, W)."""
        height, _, width = self.volume.shape
        settings, total = self.work.settings, np.zeros(self.volume.shape, np.uint16)
        guides = np.ascontiguousarray(np.moveaxis(np.rint(self.guides * PER_PLANE).astype(np.int16), 0, 1))
        # Along the guides paths need less to hold them together.
        p1 = np.uint16(0.7 * settings.penalties(height)[0])
        beyond_pole, before_seam = warm_up((height, width))
        for rows, columns in DIRECTIONS:
            penalties = step_penalties(self.work.contrast_picture, (rows, columns), settings)

            def strip(
                first: int, *, penalties: NDArray[np.uint16] = penalties, rows: int = rows, columns: int = columns
            ) -> None:
                lines = min(_STRIP_LINES, width - first)
                follow_guided_strip(
                    self.volume, total, guides, penalties, p1, first, lines, columns, rows < 0, beyond_pole, True
                )

            run_jobs(self._pool, strip, range(0, width, _STRIP_LINES))
        sideways = np.stack([step_penalties(self.work.contrast_picture, (0, step), settings) for step in (1, -1)])

        def both_ways(first: int) -> None:
            lines = min(_ROW_LINES, height - first)
            follow_guided_rows(self.volume, total, guides, sideways, p1, first, lines, before_seam // 4)

        run_jobs(self._pool, both_ways, range(0, height, _ROW_LINES))
        return total

    def _decide(self, total: NDArray[np.uint16] | NDArray[np.uint8] | NDArray[np.float32]) -> Winners:
        height, _, width = total.shape
        position = np.empty((height, width), np.float32)
        costs = np.empty((4, height, width), np.float32)

        def decide(first: int) -> None:
            rows = slice(first, first + BAND_ROWS)
            cheapest_candidates(total, self.guides, first, self.work.settings.planes, position[rows], costs[:, rows])

        run_jobs(self._pool, decide, range(0, height, BAND_ROWS))
        plane = np.rint(position).astype(np.int32)
        return Winners(plane, costs[0], costs[1], costs[2], costs[3], position - plane)


_SPLIT_RADIUS = 2


def find_winners_coarse_to_fine(work: SweepInput, *, find_coarsest: Callable[[SweepInput], Winners]) -> Winners:
    """Return the winning candidate of every pixel and the costs around it, close to those of the full sweep.

    `work`: what to sweep. `find_coarsest`: sweeps all planes at the coarsest level, and images that cannot be halved
    (odd sides, fewer than 128 rows).
    """
    coarse = _coarse_input(work)
    if coarse is None:
        return find_coarsest(work)
    found = find_winners_coarse_to_fine(coarse, find_coarsest=find_coarsest)
    position = found.position + subplane_offset(found, planes=coarse.settings.planes, shape="parabola")
    position *= (work.settings.planes - 1) / (coarse.settings.planes - 1)
    layers = np.empty((2, *position.shape), np.float32)
    padded = pad_panorama(position.astype(np.float32), _SPLIT_RADIUS)
    # Two surfaces meet where positions within this many coarse pixels differ by more planes.
    split_layers(padded, _SPLIT_RADIUS, np.float32(6), layers)
    guides = np.stack([_doubled(layer) for layer in layers])
    with workers() as pool:
        winners = GuidedSweep(work, guides, pool).find_winners()
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.nan_to_num(found.rival / found.cost, nan=np.inf, posinf=np.inf)
        farther = winners.cost * ratio.repeat(2, axis=0).repeat(2, axis=1)
    return replace(winners, rival=np.asarray(np.fmin(winners.rival, farther), dtype=np.float32))


def _coarse_input(work: SweepInput) -> SweepInput | None:
    """Return the same sweep at half the size and half the planes, or None if this is the last level."""
    settings, (height, width) = work.settings, work.reference.shape[:2]
    if settings.levels < 2 or height % 2 or width % 4 or height // 2 < 64:
        return None
    planes = max(min(16, settings.planes), -(-settings.planes // 2))
    # A step by one plane is as much longer as there are fewer of them.
    p1 = min(round(settings.p1 * (settings.planes - 1) / (planes - 1)), max(settings.p2, settings.p1), 4000)
    ranges = virtual_ranges(
        work.ranges[0], work.ranges[-1], planes=planes, spacing=settings.spacing, baseline=work.baseline
    )
    return replace(
        work,
        reference=_halved(work.reference),
        sources=tuple(_halved(source) for source in work.sources),
        source_valid=_halved_masks(work),
        colors=None if work.colors is None else _halved(work.colors),
        ranges=ranges,
        settings=settings.replace(levels=settings.levels - 1, planes=planes, p1=p1),
    )


def _halved(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return shrink(picture, -(-picture.shape[0] // 2))


def _halved_masks(work: SweepInput) -> tuple[NDArray[np.bool_], ...] | None:
    """Return where sources are valid at half size: a window's radius away from masked pixels."""
    if work.source_valid is None:
        return None
    radius = work.settings.compare_radius + work.settings.box_radius
    halves = [_halved(255 * mask.astype(np.uint8)[..., None])[..., 0] == 255 for mask in work.source_valid]
    return tuple(pixels_with_valid_window(half, -(-radius // 2)) for half in halves)


def _doubled(picture: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return a panorama of twice the size, bilinear, over the seam and the poles."""
    height, width = picture.shape
    doubled = cv2.resize(pad_panorama(picture, 1), (2 * width + 4, 2 * height + 4), interpolation=cv2.INTER_LINEAR)
    return np.asarray(doubled[2:-2, 2:-2], dtype=np.float32)
