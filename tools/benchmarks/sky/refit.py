"""Fit the models of `filters.sky` to the areas of drawn places, and print what they find of kinds that were left out.

`areas.csv` holds what was measured on areas of the places `FITTED` of `places`; the benchmark
`depth.sky` uses others. `--measure` draws the places, runs the sweep and writes the table again; later areas are those
that the models in use reach. `--coefficients FILE` writes the models, to
pano_mvs/algorithms/masks/sky_coefficients.py.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.logistic import Model
from pano_mvs.algorithms.masks.sky import MIN_PROBABILITIES, judged_areas, view_of
from pano_mvs.algorithms.masks.sky_coefficients import FIRST, LATER
from pano_mvs.algorithms.masks.sky_features import View
from pano_mvs.core.arrays import FloatArray, Mask
from pano_mvs.scene.range_map import RangeMap
from tools.benchmarks.belief.fitting import most_likely, quantile_knots
from tools.benchmarks.captures import SCRATCH, Capture, scene_capture
from tools.benchmarks.dense_chain import DenseChain, true_poses
from tools.benchmarks.sky.places import KINDS, place

TABLE = Path(__file__).with_name("areas.csv")
FITTED: tuple[tuple[str, int], ...] = (
    *((kind, seed) for kind in KINDS for seed in (0, 1)),
    *((kind, 2) for kind in ("terrace", "hall", "windows", "balcony", "night", "overexposed", "plain", "openings")),
)
"""The places of the table: more of those that are told apart with difficulty."""

SIGNS = {
    "up": 1,
    "confirmed": -1,
    "bright": 1,
    "blue": 1,
    "edge_prefers": 1,
    "behind": 1,
    "far_beside": 1,
    "like": -1,
    "touches": 1,
}
"""Each measurement, and whether more of it speaks for the sky (1) or against it (−1)."""

OF_KNOWN_SKY = ("like", "touches")
DARK = "night"
"""Places that are not fitted: with them, dark halls behind windows are taken for the sky of a night."""

QUANTILES = (0.02, 0.1, 0.25, 0.5, 0.75, 0.9, 0.98)
PENALTY = 3.0
LEVEL_WEIGHT = 0.7
"""Weight of an area with its height; the rest has the same area without it, as where gravity is unknown."""

# Of smaller areas, this share is enough.
_SMALL, _SMALL_EVERY = 5e-5, 5


@dataclass(frozen=True)
class Areas:
    """Measured areas as arrays.

    Attributes:
        columns: measurement to its values (N,), NaN where missing.
        sky: (N,) the share of each that is sky.
        share: (N,) of the sphere.
        later: (N,) bool, whether colours of the sky were known.
        kind: (N,) str of the place.
    """

    columns: Mapping[str, FloatArray]
    sky: FloatArray
    share: FloatArray
    later: NDArray[np.bool_]
    kind: NDArray[Any]

    def __getitem__(self, chosen: NDArray[np.bool_]) -> Areas:
        columns = {name: values[chosen] for name, values in self.columns.items()}
        return Areas(columns, self.sky[chosen], self.share[chosen], self.later[chosen], self.kind[chosen])


def read_areas(path: Path = TABLE) -> Areas:
    """Return the areas of a table."""
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))

    def numbers(name: str) -> FloatArray:
        return np.array([float(row[name] or "nan") for row in rows])

    kinds = np.array([row["kind"] for row in rows])
    return Areas({name: numbers(name) for name in SIGNS}, numbers("sky"), numbers("share"), numbers("later") > 0, kinds)


def fit(areas: Areas) -> tuple[Model, Model]:
    """Return the models of the first and of the later areas."""
    areas = areas[areas.kind != DARK]
    return _fitted(areas[~areas.later]), _fitted(areas[areas.later])


def _fitted(areas: Areas) -> Model:
    """Return the likeliest model; an area weighs as much as the root of its size, for its border and its inside."""
    weights = np.sqrt(areas.share / 1e-3)
    columns = {name: np.tile(areas.columns[name], 2) for name in SIGNS}
    columns["up"][len(weights) :] = np.nan
    knots = {
        name: quantile_knots(areas.columns[name], sign, quantiles=QUANTILES)
        for name, sign in SIGNS.items()
        if np.isfinite(areas.columns[name]).any()
    }
    both = np.concatenate([LEVEL_WEIGHT * weights, (1 - LEVEL_WEIGHT) * weights])
    return most_likely(columns, np.tile(areas.sky, 2), both, knots=knots, penalty=PENALTY)


def outcome(models: tuple[Model, Model], areas: Areas) -> tuple[float, float]:
    """Return the share of the sky that is found and that of the rest that is lost, by solid angle; NaN without any."""
    first, later = (model.probabilities(areas.columns) for model in models)
    taken = np.where(areas.later, later > MIN_PROBABILITIES[1], first > MIN_PROBABILITIES[0])
    parts = (areas.share * areas.sky, areas.share * (1 - areas.sky))
    found, lost = (float(part[taken].sum() / part.sum()) if part.sum() > 1e-6 else float("nan") for part in parts)
    return found, lost


def left_out(areas: Areas) -> dict[str, tuple[float, float]]:
    """Return the outcome of each kind of place with the models that were fitted to all others."""
    return {kind: outcome(fit(areas[areas.kind != kind]), areas[areas.kind == kind]) for kind in np.unique(areas.kind)}


def checked_capture(kind: str, seed: int, scratch: Path) -> tuple[Capture, Mapping[str, RangeMap], DenseChain]:
    """Return a drawn place, the range maps of its views after the check by other views, and what made them."""
    chain = DenseChain("known_poses", overrides=["depth.planes=96"])
    chain.dense = ["depth", "checked"]
    capture = scene_capture(place(kind, seed), scratch / f"{kind}-{seed}", width=512)
    return capture, chain.run(capture).range_maps["checked"], chain


def views_of(kind: str, seed: int, scratch: Path) -> Iterator[tuple[View, Mask]]:
    """Yield every second view of a drawn place, with the pixels that have no surface."""
    capture, maps, chain = checked_capture(kind, seed, scratch)
    neighbours = chain.index("checked", true_poses(capture)).neighbours
    for image in list(capture.panoramas)[::2]:
        pose = capture.poses[image]
        sources = [
            (other.load(), other.load_mask(), capture.poses[name] @ pose.inverse())
            for name, other in ((name, capture.panoramas[name]) for name in neighbours[image])
        ]
        panorama = capture.panoramas[image]
        up = -pose.rotation[:, 1]
        view = view_of(maps[image], panorama.load(), panorama.load_mask(), sources=sources, up=up)
        yield view, ~np.isfinite(capture.ranges[image])


def _measured(scratch: Path) -> Iterator[list[str]]:
    for kind, seed in FITTED:
        for view, sky in views_of(kind, seed, scratch):
            for number, (areas, features) in enumerate(judged_areas(view, (FIRST, LATER))[1]):
                inside = areas >= 0
                total = np.bincount(areas[inside], view.weights[inside])
                share = total / view.weights.sum()
                found = np.bincount(areas[inside], (view.weights * sky)[inside]) / total
                for idx in np.flatnonzero((share >= _SMALL) | (np.arange(len(share)) % _SMALL_EVERY == 0)):
                    values = [features[name][idx] if name in features else np.nan for name in SIGNS]
                    figures = [f"{value:.3g}" if np.isfinite(value) else "" for value in values]
                    yield [kind, str(seed), str(int(number > 0)), f"{share[idx]:.3g}", f"{found[idx]:.3g}", *figures]


def source_of(models: tuple[Model, Model]) -> str:
    """Return the models as a Python module."""
    parts = [
        f"{name} = Model(\n    {model.intercept},\n    {{\n"
        + "".join(
            f'        "{key}": Term({one.knots}, {one.losses}, {one.missing}),\n' for key, one in model.terms.items()
        )
        + "    },\n)\n"
        for name, model in zip(("FIRST", "LATER"), models, strict=True)
    ]
    return (
        '"""The coefficients that `python -m tools benchmarks sky.refit` has fitted."""\n\n'
        "from pano_mvs.algorithms.logistic import Model, Term\n\n" + "\n".join(parts)
    )


def main(measure: bool = False, coefficients: Path | None = None, scratch: Path = SCRATCH / "sky_places") -> None:
    """Fit and compare.

    Args:
        measure: draw the places again and replace the table.
        coefficients: file for the fitted models.
        scratch: folder of rendered panoramas.
    """
    cv2.setNumThreads(1)
    if measure:
        rows = list(_measured(scratch))
        with TABLE.open("w", newline="") as file:
            out = csv.writer(file, lineterminator="\n")
            out.writerow(["kind", "seed", "later", "share", "sky", *SIGNS])
            out.writerows(rows)
    areas = read_areas()
    print(f"{len(areas.sky)} areas\n| kind left out | sky found, % | rest lost, % |\n|---|---|---|")
    for kind, (found, lost) in left_out(areas).items():
        print(f"| {kind} | {100 * found:.1f} | {100 * lost:.2f} |")
    models = fit(areas)
    if coefficients:
        coefficients.write_text(source_of(models))
