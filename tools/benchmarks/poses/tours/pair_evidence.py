"""How far the relative pose of a learned pair can be believed, by what speaks for it.

Each DIR is a capture with truth.json, which `tools.benchmarks.poses.tours.measure DIR … --out OUT` has run. The best
relative pose of each pair that a network has matched is right if it agrees with the truth to 3° and 10°, or to 5° and
15° where the truth was drawn by hand. `--table FILE` gets a row for each pair; without DIR, the rows are read from it.

A logistic regression gives the odds that a pair is right by its false alarms and its `Marks`, which are
the coefficients of `pano_mvs.algorithms.two_view.learned_pairs`. The marks of walls count if all rows have them. Which
pose of a pair counts depends on the coefficients, so the table is written anew with new ones, until they stay. The
table shows the pairs that they accept, fitted to all captures but the one of the row, beside those with at most 10⁻⁵⁰
false alarms.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from pano_mvs.algorithms.two_view.learned_pairs import (
    ACCEPTED_ODDS,
    ACCEPTED_ODDS_WITH_WALLS,
    CERTAIN,
    PARALLEL,
    WEAKEST,
    WEIGHTS,
    Marks,
    terms_of,
)
from pano_mvs.algorithms.two_view.verification import pair_marks
from pano_mvs.engine.cache.store import Store
from pano_mvs.geometry import Rigid3, angle_between, geodesic_angle
from pano_mvs.scene import Features, TwoView
from pano_mvs.scene.record import Record
from tools.benchmarks.poses.tours.measure import read_truth

_EXACT_DEG, _DRAWN_DEG = (3.0, 10.0), (5.0, 15.0)
_RIDGE = 0.025
_Kind = TypeVar("_Kind", bound=Record)


class PairRow(NamedTuple):
    """A pair of images: log₁₀ of its false alarms, what else speaks for its pose, and whether this is right."""

    capture: str
    first: str
    second: str
    log10_false_alarms: float
    marks: Marks
    right: bool


def pair_rows(capture: Path, out: Path) -> Iterator[PairRow]:
    """Yield the learned pairs of a finished run."""
    truth = read_truth(capture)
    assert truth is not None, f"{capture} has no truth.json with headings"
    yield from rows_of(capture.name, *learned_views(out), truth=truth)


def learned_views(out: Path, *, merged: bool = False) -> tuple[dict[str, Features], dict[tuple[str, str], TwoView]]:
    """Return the key points of a finished run and the pairs that a network has matched, or all pairs as `merged`."""
    store = Store(out / "cache")
    keys = next(run.keys for run in store.runs.entries() if run.out == str((out / "run").resolve()))

    def load(stage: str, item: str, kind: type[_Kind]) -> _Kind:
        record = store.read_record(keys[stage][item])
        assert record is not None, f"{out}: {stage} of {item} is not in the cache"
        value = store.load(record.output, kind)
        assert isinstance(value, kind)
        return value

    features = {image: load("learned", image, Features) for image in keys.get("learned", {})}
    views = {}
    for stage in ("matches", "rematched") if merged else ("rematched",):
        for pair in keys.get(stage, {}):
            first, second = (name.strip() for name in pair.split("|"))
            views[first, second] = load(stage, pair, TwoView)
    return features, views


def rows_of(
    capture: str,
    features: Mapping[str, Features],
    views: Mapping[tuple[str, str], TwoView],
    *,
    truth: tuple[Mapping[str, Rigid3], tuple[float, float]],
) -> Iterator[PairRow]:
    """Yield the learned pairs of a capture by their most probable pose.

    Args:
        capture: its name.
        features: key points of the images.
        views: geometry of the pairs.
        truth: true poses, and how exact they are (see `read_truth`).
    """
    poses, limits = truth
    most = _EXACT_DEG if limits[0] < 2 else _DRAWN_DEG
    for (first, second), view in views.items():
        ends = features[first], features[second]
        best = view if view else next(iter(view.alternatives), None)
        if best is None or view.geometry == "rotation" or not (ends[0].learned and ends[1].learned):
            continue
        true = poses[second] @ poses[first].inverse()
        off = geodesic_angle(best.rotation, true.rotation), angle_between(best.direction, true.translation)
        right = bool(np.all(np.rad2deg(off) < most))
        yield PairRow(capture, first, second, view.log10_false_alarms, pair_marks(*ends, best), right)


def read_table(file: Path) -> list[PairRow]:
    """Return the rows of a table."""
    with file.open(encoding="utf-8", newline="") as stream:
        return [
            PairRow(
                row["capture"],
                row["first"],
                row["second"],
                float(row["log10_false_alarms"]),
                Marks(*(float(row.get(name, "nan")) for name in Marks._fields)),
                row["right"] == "1",
            )
            for row in csv.DictReader(stream)
        ]


def write_table(file: Path, rows: Sequence[PairRow]) -> None:
    """Write rows, without what does not count."""
    with file.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow([*PairRow._fields[:4], *Marks._fields, "right"])
        for row in rows:
            if row.log10_false_alarms <= WEAKEST:
                marks = [f"{mark:.3g}" for mark in row.marks]
                writer.writerow([*row[:3], f"{row.log10_false_alarms:.1f}", *marks, int(row.right)])


def fitted(rows: Sequence[PairRow]) -> NDArray[np.float64]:
    """Return the coefficients: of one, of the exponent, and of the marks, each with its known sign."""
    terms = _terms(rows, walls=_have_walls(rows))
    sign = np.where([row.right for row in rows], 1.0, -1.0)

    def loss(weights: NDArray[np.float64]) -> float:
        # The weak prior keeps the weights finite if they separate all pairs.
        return float(np.logaddexp(0, -sign * (terms @ weights)).sum() + _RIDGE * np.sum(weights[1:] ** 2))

    better = {"floor", "parallax"}
    bounds = [(None, None), (0, None), *((0, None) if name in better else (None, 0) for name in Marks._fields)]
    return np.asarray(minimize(loss, np.zeros(terms.shape[1]), bounds=bounds[: terms.shape[1]]).x)


def _have_walls(rows: Sequence[PairRow]) -> bool:
    return not any(np.isnan(row.marks.walls) for row in rows)


def _terms(rows: Sequence[PairRow], *, walls: bool) -> NDArray[np.float64]:
    """Return the terms of each pair, (N, 9), or without the marks of walls, (N, 7)."""
    nothing = {} if walls else {"walls": np.nan, "level": np.nan}
    return np.array([terms_of(row.log10_false_alarms, row.marks._replace(**nothing)) for row in rows])


def prior_odds(rows: Sequence[PairRow]) -> float:
    """Return the logarithm of the odds that any pair is right."""
    right = sum(row.right for row in rows)
    return float(np.log(right / (len(rows) - right)))


def left_out(rows: Sequence[PairRow]) -> dict[str, tuple[int, ...]]:
    """Return for each capture its right pairs; the right and the wrong ones by the fit to the others; and by 10⁻⁵⁰."""
    found = {}
    with_walls = _have_walls(rows)
    least = ACCEPTED_ODDS_WITH_WALLS if with_walls else ACCEPTED_ODDS
    for capture in sorted({row.capture for row in rows}):
        weights = fitted([row for row in rows if row.capture != capture])
        own = [row for row in rows if row.capture == capture]
        right = np.array([row.right for row in own])
        odds = _terms(own, walls=with_walls) @ weights
        exponents = np.array([row.log10_false_alarms for row in own])
        fit, plain = (odds >= least) | (exponents <= CERTAIN), exponents <= -50
        if with_walls:  # without walls, by the fit to the other table
            without = _terms(own, walls=False) @ np.array(WEIGHTS)
            fit |= (without >= least) & (np.array([row.marks.walls for row in own]) <= PARALLEL)
        counts = (right, fit & right, fit & ~right, plain & right, plain & ~right)
        found[capture] = tuple(int(one.sum()) for one in counts)
    return found


def main() -> None:
    """Print the tables of the captures that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", nargs="*", type=Path, metavar="DIR")
    parser.add_argument("--runs", type=Path, default=Path(), metavar="OUT", help="results of poses.tours.measure")
    parser.add_argument("--table", type=Path, required=True, metavar="FILE")
    given = parser.parse_args()
    if given.captures:
        write_table(given.table, [row for one in given.captures for row in pair_rows(one, given.runs / one.name)])
    rows = read_table(given.table)
    print("| capture | right pairs | accepted: right | wrong | 10⁻⁵⁰: right | wrong |")
    print("|---" * 6 + "|")
    counts = left_out(rows)
    for capture, line in counts.items():
        print(f"| {capture} | " + " | ".join(map(str, line)) + " |")
    print("| all | " + " | ".join(str(sum(column)) for column in zip(*counts.values(), strict=True)) + " |")
    print("coefficients:", ", ".join(f"{weight:.3f}" for weight in fitted(rows)))
    print(f"prior: {prior_odds(rows):.2f}")


if __name__ == "__main__":
    main()
