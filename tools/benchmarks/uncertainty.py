"""Are standard deviations of ranges what they claim to be, and the fit of what they depend on.

`uncertainty.csv` holds confirmed pixels of synthetic scenes, rendered captures and rendered houses, drawn by solid
angle: the relative error of the range, and what `error_factors` returns. Poses are true, so that only matching is
measured. Prints the share of errors within two standard deviations (95 % for a normal distribution) with the exponents
in use and with those that are fitted to the other places, of all pixels and by what they show. `--data`, `--scene` and
`--house` measure places again with the dense stages of a workflow (`--workflow`, default quality); rows of other places
stay as they are.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from pano_mvs.algorithms.filters import consistency
from pano_mvs.algorithms.filters.uncertainty import (
    EXPONENTS,
    FACTOR,
    MOST_UNCERTAINTY,
    confirmed_uncertainty,
    error_factors,
)
from pano_mvs.algorithms.sweep.preparation import is_bare
from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import pixel_solid_angle
from tests.synthetic.scenes import SCENES
from tools.benchmarks.captures import SCRATCH, Capture, read_capture, scene_capture
from tools.benchmarks.dense_chain import DenseChain, Overrides, given_records, true_poses
from tools.benchmarks.depth.houses import KINDS, LEFT_OUT, read_house
from tools.benchmarks.table import print_table

TABLE = Path(__file__).with_name("uncertainty.csv")
PER_PLACE = 800
QUANTILE = 0.954
"""Share of errors below two standard deviations, as of a normal distribution."""

_EDGE = 1.1


@dataclass(frozen=True)
class Errors:
    """Confirmed pixels as arrays (N,): relative errors, the logarithms of what they depend on, places, surfaces."""

    error: FloatArray
    logs: Mapping[str, FloatArray]
    place: NDArray[Any]
    surface: NDArray[Any]

    def __getitem__(self, chosen: NDArray[np.bool_]) -> Errors:
        logs = {name: values[chosen] for name, values in self.logs.items()}
        return Errors(self.error[chosen], logs, self.place[chosen], self.surface[chosen])


def read_errors(path: Path = TABLE) -> Errors:
    """Return the pixels of a table."""
    rows = _rows_of(path)
    logs = {name: np.log([float(row[name]) for row in rows]) for name in EXPONENTS}
    error = np.array([float(row["range_error"]) for row in rows])
    return Errors(error, logs, *(np.array([row[name] for row in rows]) for name in ("place", "surface")))


def _rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def fit(errors: Errors) -> tuple[float, dict[str, float]]:
    """Return the factor and the exponents with which two standard deviations are the 95.4 % quantile of the errors.

    Linear quantile regression of the logarithms (R. Koenker, "Quantile regression", 2005), made smooth; each place
    counts the same.
    """
    names = list(EXPONENTS)
    terms = np.stack([np.ones(len(errors.error)), *(errors.logs[name] for name in names)], axis=1)
    logs = np.log(np.maximum(errors.error, 1e-5))
    _, place, counts = np.unique(errors.place, return_inverse=True, return_counts=True)
    weights = 1 / (len(counts) * counts[place])
    smooth, penalty = 0.05, 1e-3

    def cost(values: FloatArray) -> tuple[float, FloatArray]:
        rest = logs - terms @ values
        loss = QUANTILE * rest + smooth * np.logaddexp(0, -rest / smooth)
        slope = QUANTILE - 1 / (1 + np.exp(np.clip(rest / smooth, -500, 500)))
        shrink = np.concatenate([[0.0], values[1:]])
        gradient = 2 * penalty * shrink - terms.T @ (weights * slope)
        return float(weights @ loss + penalty * shrink @ shrink), gradient

    found = minimize(cost, np.zeros(terms.shape[1]), jac=True, method="L-BFGS-B").x
    return round(float(np.exp(found[0]) / 2), 3), dict(zip(names, np.round(found[1:], 2).tolist(), strict=True))


def deviations(errors: Errors, factor: float, exponents: Mapping[str, float]) -> FloatArray:
    """Return the standard deviations (N,)."""
    logs = np.log(factor) + sum(power * errors.logs[name] for name, power in exponents.items())
    return np.asarray(np.exp(np.minimum(logs, np.log(MOST_UNCERTAINTY))))


def covered(errors: Errors, factor: float, exponents: Mapping[str, float]) -> NDArray[np.bool_]:
    """Return which errors (N,) are within two standard deviations."""
    return np.asarray(errors.error < 2 * deviations(errors, factor, exponents))


def left_out(errors: Errors) -> NDArray[np.bool_]:
    """Return the same with what was fitted to all other places."""
    found = np.zeros(len(errors.error), np.bool_)
    for place in np.unique(errors.place):
        mine = errors.place == place
        found[mine] = covered(errors[mine], *fit(errors[~mine]))
    return found


def halved_truth(truth: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return true ranges (H, W) at half the size: the mean of 1 / range on surfaces, one of four pixels at edges.

    The nearest pixel is a quarter of a pixel off, which on slanted surfaces is more than the error of a range.
    """
    height, width = truth.shape
    blocks = truth.reshape(height // 2, 2, width // 2, 2).swapaxes(1, 2).reshape(height // 2, width // 2, 4)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = 1 / np.mean(1 / blocks.astype(np.float64), axis=-1)
        edge = ~(blocks.max(axis=-1) <= _EDGE * blocks.min(axis=-1))
    return np.where(edge, truth[1::2, 1::2], mean).astype(np.float32)


def places(
    data: Sequence[Path], scenes: Sequence[str], houses: Sequence[Path], views: int
) -> Iterator[tuple[Capture, Mapping[str, NDArray[np.int64]]]]:
    """Yield captures with truth at half their size, synthetic scenes and houses, with what their pixels show."""
    for folder in data:
        full = read_capture(folder).first(views)
        half = read_capture(folder, width=next(iter(full.ranges.values())).shape[1] // 2).first(views)
        yield replace(half, ranges={name: halved_truth(truth) for name, truth in full.ranges.items()}), {}
    for name in scenes:
        yield scene_capture(SCENES[name](seed=0, exposure=0.0), SCRATCH / f"{name}-512", width=512), {}
    for folder in houses:
        house = read_house(folder, width=512)
        yield house.capture, house.kinds


def measured(
    chain: DenseChain, capture: Capture, kinds: Mapping[str, NDArray[np.int64]], *, count: int = PER_PLACE
) -> list[list[str]]:
    """Return rows of the table: confirmed pixels of a place, drawn by solid angle."""
    poses = true_poses(capture)
    done, index, given = chain.run(capture), chain.index("checked", poses), given_records(capture, poses)
    rows: list[list[str]] = []
    solid: list[float] = []
    for image in index.neighbours:
        with patch.object(consistency, "confirmed_uncertainty", wraps=confirmed_uncertainty) as called:
            chain.run_one("checked", image, index, given, done)
        (consistent, ranges, comparison), further = called.call_args
        factors = dict(error_factors(consistent, ranges, comparison, **further))
        true, shown = capture.ranges[image], kinds.get(image, np.full(ranges.shape, -1))
        bare = is_bare(capture.panoramas[image].load())
        for at in zip(*np.nonzero(consistent & np.isfinite(true) & (shown != LEFT_OUT)), strict=True):
            kind = next((name for name, number in KINDS.items() if number == shown[at]), "other")
            values = [abs(ranges[at] / true[at] - 1), *(factors[name][at] for name in EXPONENTS)]
            surface = f"{kind}, {'plain' if bare[at] else 'textured'}"
            rows.append([capture.name, surface, *(f"{value:.3g}" for value in values)])
            solid.append(float(pixel_solid_angle(ranges.shape)[at[0]]))
    weights = np.array(solid) / sum(solid)
    chosen = np.random.default_rng(0).choice(len(rows), min(count, len(rows)), replace=False, p=weights)
    return [rows[idx] for idx in np.sort(chosen)]


def table_rows(errors: Errors) -> Iterator[list[str]]:
    """Yield the rows of the printed table, of each place and of each surface."""
    now, then = covered(errors, FACTOR, EXPONENTS), left_out(errors)
    for names in (errors.place, errors.surface):
        for name in np.unique(names):
            here = names == name
            yield [str(name), str(here.sum()), *(f"{100 * shares[here].mean():.1f}" for shares in (now, then))]


def main(
    workflow: str = "quality",
    data: list[Path] | None = None,
    scene: list[str] | None = None,
    house: list[Path] | None = None,
    views: int = 5,
    overrides: Overrides = None,
) -> None:
    """Print the table, and what is fitted to all places.

    Args:
        workflow: preset or file.
        data: captures with truth to measure again.
        scene: synthetic scenes to measure again.
        house: houses of `poses.tours.houses` to measure again, named as there.
        views: number of views of a capture.
        overrides: as `--set` of `run`.
    """
    cv2.setNumThreads(1)
    if data or scene or house:
        chain = DenseChain(workflow, overrides=overrides or ())
        chain.dense = chain.dense[: chain.dense.index("checked") + 1]
        again = [
            row
            for capture, kinds in places(data or (), scene or (), house or (), views)
            for row in measured(chain, capture, kinds)
        ]
        names = ["place", "surface", "range_error", *EXPONENTS]
        found = {row[0] for row in again}
        kept = [[row[name] for name in names] for row in _rows_of(TABLE) if row["place"] not in found]
        with TABLE.open("w", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows([names, *sorted(kept + again)])
    errors = read_errors()
    print_table(["place or surface", "pixels", "within 2 σ, %", "left out, %"], table_rows(errors))
    print("\nfactor and exponents:", *fit(errors))
