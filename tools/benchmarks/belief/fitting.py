"""Fit the model of belief of `poses.verify` to measured cameras, and see how well it is calibrated."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from pano_mvs.algorithms.logistic import Model, Term, counted_share, steps_behind

FloatArray = NDArray[np.float64]

SIGNS = {
    "ratio": 1,
    "share": 1,
    "wide_share": 1,
    "likeness": 1,
    "unlike": -1,
    "contradicted": -1,
    "pairs_contradicting": -1,
    "agreeing": 1,
    "scale_worst": -1,
    "place_rival": -1,
    "repeats": -1,
    "linked": 1,
    "links_contradicting": -1,
}
"""Each measurement, and whether more of it speaks for a camera (1) or against it (−1)."""

OF_IMAGES = {"ratio", "share", "wide_share", "likeness", "unlike"}
OF_PAIRS = {*SIGNS} - OF_IMAGES
LINKS = {"linked", "links_contradicting"}
UNKNOWN_OF_TOURS = {"wide_share", "likeness", "unlike", "contradicted", "pairs_contradicting"}
"""What was not measured yet when `learned.csv` was, the cameras with links."""
QUANTILES = (0.01, 0.04, 0.1, 0.25, 0.5)
ENOUGH = {"ratio": 0.35, "share": 0.25}
"""Values beyond which more of a measurement says nothing more, where places that were left out are predicted better
with such a limit than without it."""
FULL_FROM = dict.fromkeys(("wide_share", "likeness", "unlike"), ("pairs_contradicting", 0.1))
"""From which share of contradicting pairs a measurement counts in full. Where no pair contradicts another one, there is
no other arrangement for which it could speak."""
PENALTY = 3.0


@dataclass(frozen=True)
class Cameras:
    """Measured cameras as arrays.

    Attributes:
        columns: measurement to its values (N,), NaN where missing.
        right: (N,) bool.
        doubted: (N,) bool, by the rules that the model is compared with.
        family: (N,) str.
        capture: (N,) str.
    """

    columns: Mapping[str, FloatArray]
    right: NDArray[np.bool_]
    doubted: NDArray[np.bool_]
    family: NDArray[Any]
    capture: NDArray[Any]

    @property
    def place(self) -> NDArray[Any]:
        """The kind of place of each camera (N,), which its family shares with those of other sizes and matches."""
        return np.array([family.split("/")[0] for family in self.family])

    def __getitem__(self, chosen: NDArray[np.bool_]) -> Cameras:
        columns = {name: values[chosen] for name, values in self.columns.items()}
        return Cameras(columns, self.right[chosen], self.doubted[chosen], self.family[chosen], self.capture[chosen])


def cameras_of(captures: Sequence[Mapping[str, Any]]) -> Cameras:
    """Return the cameras of measured captures (lines of `collect`)."""
    rows = [row for capture in captures for row in capture["cameras"]]
    names = sorted({name for row in rows for name in row["evidence"]})
    columns = {
        name: np.array([np.nan if row["evidence"].get(name) is None else row["evidence"][name] for row in rows])
        for name in names
    }
    return Cameras(
        columns,
        np.array([row["right"] for row in rows], np.bool_),
        np.array([row["doubted"] for row in rows], np.bool_),
        np.array([row["family"] for row in rows]),
        np.array([f"{row['family']} {row['seed']} {row['variant']}" for row in rows]),
    )


def read_table(path: Path) -> Cameras:
    """Return the cameras of a file that `write_table` has written."""
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    columns = {name: np.array([float(row.get(name) or "nan") for row in rows]) for name in SIGNS}
    flags = {name: np.array([row[name] == "1" for row in rows], np.bool_) for name in ("right", "doubted")}
    captures = [f"{row['family']} {row['seed']} {row['variant']}" for row in rows]
    return Cameras(
        columns, flags["right"], flags["doubted"], np.array([row["family"] for row in rows]), np.array(captures)
    )


def write_table(path: Path, cameras: Cameras) -> None:
    """Write cameras as CSV, with four digits of each measurement."""
    with path.open("w", newline="") as file:
        out = csv.writer(file, lineterminator="\n")
        out.writerow(["family", "seed", "variant", "right", "doubted", *SIGNS])
        for idx, capture in enumerate(cameras.capture):
            values = [cameras.columns[name][idx] for name in SIGNS]
            figures = [f"{value:.4g}" if np.isfinite(value) else "" for value in values]
            out.writerow([*capture.split(), int(cameras.right[idx]), int(cameras.doubted[idx]), *figures])


def fit(cameras: Cameras, *, penalty: float = PENALTY, signs: Mapping[str, int] = SIGNS) -> Model:
    """Return the model with the largest likelihood less a penalty on the squared losses.

    Knots are quantiles of each measurement, up to what is enough of it. All losses are at least 0, so that each
    measurement only ever counts the way of its sign, and a missing one is never better than the best. Each camera
    counts four times: with all that was measured, with the measurements of images alone, with those of pairs alone, and
    without any, since users may lack either or both.

    Links are fitted to all cameras, beside what is known of those that have any; the rest to the others.
    """
    of_links = {name: sign for name, sign in signs.items() if name not in UNKNOWN_OF_TOURS}
    if not LINKS & signs.keys():
        return _fitted(cameras, penalty=penalty, signs=signs)
    links = _fitted(cameras, penalty=penalty, signs=of_links)
    if of_links == dict(signs):
        return links
    linked = {name: links.terms[name] for name in signs if name in LINKS and name in links.terms}
    rest = {name: sign for name, sign in signs.items() if name not in LINKS}
    without = ~np.any([np.isfinite(cameras.columns[name]) for name in sorted(LINKS)], axis=0)
    model = _fitted(cameras[without], penalty=penalty, signs=rest)
    intercept = model.intercept + sum(term.missing for term in linked.values())
    return Model(round(intercept, 4), {**model.terms, **linked})


def _fitted(cameras: Cameras, *, penalty: float, signs: Mapping[str, int]) -> Model:
    cameras = joined([cameras, *(_only(cameras, names) for names in (OF_IMAGES, OF_PAIRS, set[str]()))])
    knots = {name: quantile_knots(cameras.columns[name], sign, enough=ENOUGH.get(name)) for name, sign in signs.items()}
    return most_likely(
        cameras.columns,
        cameras.right.astype(np.float64),
        np.ones(len(cameras.right)),
        knots=knots,
        penalty=penalty,
        full_from=FULL_FROM,
    )


def most_likely(
    columns: Mapping[str, FloatArray],
    target: FloatArray,
    weights: FloatArray,
    *,
    knots: Mapping[str, tuple[float, ...]],
    penalty: float,
    full_from: Mapping[str, tuple[str, float]] | None = None,
) -> Model:
    """Return the model with the largest likelihood less a penalty on the squared losses, all of which are at least 0.

    Args:
        columns: measurement to its values (N,), NaN where missing.
        target: (N,) what is to be predicted, 0 to 1.
        weights: (N,) of each row.
        knots: of each measurement that is used.
        penalty: on the squared losses.
        full_from: see `Term.full_from`, of measurements for which another one says how far they count.
    """
    full_from = full_from or {}

    def behind_of(name: str) -> FloatArray:
        own = steps_behind(columns[name], knots[name])
        return own * counted_share(columns, full_from[name])[:, None] if name in full_from else own

    behind = np.hstack([behind_of(name) for name in knots])

    def cost(values: FloatArray) -> tuple[float, FloatArray]:
        logit = values[0] - behind @ values[1:]
        likelihood = weights * (np.logaddexp(0.0, -logit) + (1 - target) * logit)
        error = weights * (1 / (1 + np.exp(-logit)) - target)
        gradient = np.concatenate([[error.sum()], -behind.T @ error + 2 * penalty * values[1:]])
        return float(likelihood.sum() + penalty * (values[1:] ** 2).sum()), gradient

    start = np.concatenate([[3.0], np.full(behind.shape[1], 0.1)])
    found = minimize(
        cost,
        start,
        jac=True,
        method="L-BFGS-B",
        bounds=[(None, None), *[(0, None)] * behind.shape[1]],
        options={"maxiter": 2000, "maxfun": 4000, "ftol": 1e-12},
    )
    terms, at = {}, 1
    for name, own in knots.items():
        losses = np.round(found.x[at : at + len(own)], 4)
        terms[name] = Term(own, tuple(losses[:-1].tolist()), float(losses[-1]), full_from.get(name))
        at += len(own)
    return Model(
        round(float(found.x[0]), 4), {name: term for name, term in terms.items() if any(term.losses) or term.missing}
    )


def _only(cameras: Cameras, names: Set[str]) -> Cameras:
    missing = np.full(len(cameras.right), np.nan)
    columns = {name: values if name in names else missing for name, values in cameras.columns.items()}
    return replace(cameras, columns=columns)


def joined(parts: Sequence[Cameras]) -> Cameras:
    """Return the cameras of several tables as one."""
    columns = {name: np.concatenate([part.columns[name] for part in parts]) for name in parts[0].columns}
    return Cameras(
        columns,
        *(
            np.concatenate([getattr(part, name) for part in parts])
            for name in ("right", "doubted", "family", "capture")
        ),
    )


def quantile_knots(
    values: FloatArray, sign: int, *, quantiles: Sequence[float] = QUANTILES, enough: float | None = None
) -> tuple[float, ...]:
    """Return quantiles of the known ones of values (N,), from the worst to the best, up to what is enough."""
    known = values[np.isfinite(values)]
    if not len(known):
        return (0.0, 1.0) if sign > 0 else (1.0, 0.0)
    ordered = quantiles if sign > 0 else [1 - one for one in quantiles]
    found = [float(f"{value:.4g}") for value in np.quantile(known, ordered)]
    if enough is not None:  # without a knot so near that the step to it would be a threshold
        found = [*(value for value in found if value < 0.9 * enough), enough]
    distinct = [found[0]]
    for value in found[1:]:
        if sign * (value - distinct[-1]) > 1e-9:
            distinct.append(value)
    if len(distinct) == 1:
        distinct.insert(0, distinct[0] - sign * max(1e-3, 0.1 * abs(distinct[0])))
    return tuple(distinct)


def left_out(cameras: Cameras, *, penalty: float = PENALTY, signs: Mapping[str, int] = SIGNS) -> FloatArray:
    """Return the probability of each camera by the model that was fitted to all other kinds of places, (N,)."""
    found = np.full(len(cameras.right), np.nan)
    for place in np.unique(cameras.place):
        mine = cameras.place == place
        found[mine] = fit(cameras[~mine], penalty=penalty, signs=signs).probabilities(cameras[mine].columns)
    return found


def calibration_error(probability: FloatArray, right: NDArray[np.bool_], *, bins: int = 10) -> float:
    """Return the expected calibration error: the mean gap between probability and frequency over equal-width bins."""
    number = np.minimum((probability * bins).astype(int), bins - 1)
    gaps = [
        (number == each).mean() * abs(probability[number == each].mean() - right[number == each].mean())
        for each in np.unique(number)
    ]
    return float(sum(gaps))


def area_under_roc(probability: FloatArray, right: NDArray[np.bool_]) -> float:
    """Return the share of pairs of a right and a wrong camera in which the right one is more probable."""
    good, bad = probability[right], probability[~right]
    if not len(good) or not len(bad):
        return float("nan")
    return float((good[:, None] > bad[None]).mean() + 0.5 * (good[:, None] == bad[None]).mean())


@dataclass(frozen=True)
class Outcome:
    """How often a verdict is wrong, in both ways."""

    right: int
    wrong: int
    right_doubted: int
    wrong_silent: int

    @staticmethod
    def of(right: NDArray[np.bool_], doubted: NDArray[np.bool_]) -> Outcome:
        """Return the outcome of doubts about cameras."""
        return Outcome(
            int(right.sum()), int((~right).sum()), int((right & doubted).sum()), int((~right & ~doubted).sum())
        )

    def line(self, label: str) -> str:
        """Return a row of a table."""
        doubted = f"{self.right_doubted} ({100 * self.right_doubted / max(1, self.right):.1f} %)"
        silent = f"{self.wrong_silent} ({1000 * self.wrong_silent / max(1, self.right + self.wrong):.1f} ‰ of all)"
        return f"| {label} | {self.right} | {self.wrong} | {doubted} | {silent} |"
