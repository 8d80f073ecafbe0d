"""Fit the models of `filters.sky` to areas of places, and print what they find of kinds that were left out.

`areas.csv` holds what was measured on areas of the drawn places `FITTED` of `places`, of which the benchmark
`depth.sky` uses others, and of rendered rooms and houses. `--measure` draws the places, runs the sweep and measures
them again, and so does `--rooms DIR` with a capture with truth or a house of `poses.tours.houses`; rows of other kinds
stay as they are. Later areas are those that the models in use reach. `--coefficients FILE` writes the models, to
pano_mvs/algorithms/masks/sky_coefficients.py.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.logistic import Model
from pano_mvs.algorithms.masks.sky import MIN_PROBABILITY, judged_areas, view_of
from pano_mvs.algorithms.masks.sky_coefficients import FIRST, LATER
from pano_mvs.algorithms.masks.sky_features import View
from pano_mvs.algorithms.panoramas import nearest_resized
from pano_mvs.core.arrays import FloatArray
from pano_mvs.scene.range_map import RangeMap
from tools.benchmarks.belief.fitting import most_likely, quantile_knots
from tools.benchmarks.captures import SCRATCH, Capture, read_capture, scene_capture
from tools.benchmarks.dense_chain import DenseChain, true_poses
from tools.benchmarks.depth.houses import LEFT_OUT, read_house
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
    "surface": -1,
    "apart": -1,
    "behind": 1,
    "far_beside": 1,
}
"""Each measurement, and whether more of it speaks for the sky (1) or against it (−1)."""

LATER_SIGNS = {"first": 1, "like": -1, "touches": 1}
"""The same where the colours of the sky are known: the first model's log-odds, and what these colours add."""

DARK = "night"
"""Places that are not fitted: with them, dark halls behind windows are taken for the sky of a night."""

QUANTILES = (0.02, 0.1, 0.25, 0.5, 0.75, 0.9, 0.98)
PENALTY = 3.0
LEVEL_WEIGHT = 0.7
"""Weight of an area with its height; the rest has the same area without it, as where gravity is unknown."""

MEASURED = (*SIGNS, "like", "touches")
# Of smaller areas, this share is enough.
_SMALL, _SMALL_EVERY = 5e-5, 5
_MIN_KNOWN = 0.8  # of an area of a house, beside its panes and mirrors


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
    rows = _rows_of(path)

    def numbers(name: str) -> FloatArray:
        return np.array([float(row[name] or "nan") for row in rows])

    kinds = np.array([row["kind"] for row in rows])
    columns = {name: numbers(name) for name in MEASURED}
    return Areas(columns, numbers("sky"), numbers("share"), numbers("later") > 0, kinds)


def _rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def fit(areas: Areas) -> tuple[Model, Model]:
    """Return the models of the first and of the later areas; the second one builds on what the first one says.

    Each area counts twice, with its height and without it.
    """
    areas = areas[areas.kind != DARK]
    flat = replace(areas, columns={**areas.columns, "up": np.full(len(areas.sky), np.nan)})
    first = _fitted([areas[~areas.later], flat[~areas.later]], SIGNS)
    later = [with_odds(part[part.later], first) for part in (areas, flat)]
    return first, _fitted(later, LATER_SIGNS)


def _fitted(parts: list[Areas], signs: Mapping[str, int]) -> Model:
    """Return the likeliest model; an area weighs as much as the root of its size, for its border and its inside."""
    columns = {name: np.concatenate([part.columns[name] for part in parts]) for name in signs}
    weights = [
        share * np.sqrt(part.share / 1e-3) for share, part in zip((LEVEL_WEIGHT, 1 - LEVEL_WEIGHT), parts, strict=True)
    ]
    knots = {name: quantile_knots(parts[0].columns[name], sign, quantiles=QUANTILES) for name, sign in signs.items()}
    sky = np.concatenate([part.sky for part in parts])
    return most_likely(columns, sky, np.concatenate(weights), knots=knots, penalty=PENALTY)


def with_odds(areas: Areas, first: Model) -> Areas:
    """Return the areas with what the first model says of each."""
    return replace(areas, columns={**areas.columns, "first": first.log_odds(areas.columns)})


def outcome(models: tuple[Model, Model], areas: Areas) -> tuple[float, float]:
    """Return the share of the sky that is found and that of the rest that is lost, by solid angle; NaN without any."""
    columns = with_odds(areas, models[0]).columns
    first, later = (model.probabilities(columns) > MIN_PROBABILITY for model in models)
    taken = np.where(areas.later, later, first)
    parts = (areas.share * areas.sky, areas.share * (1 - areas.sky))
    found, lost = (float(part[taken].sum() / part.sum()) if part.sum() > 1e-6 else float("nan") for part in parts)
    return found, lost


def left_out(areas: Areas) -> dict[str, tuple[float, float]]:
    """Return the outcome of each kind of place with the models that were fitted to all others."""
    return {kind: outcome(fit(areas[areas.kind != kind]), areas[areas.kind == kind]) for kind in np.unique(areas.kind)}


@dataclass(frozen=True)
class Place:
    """A capture with what each pixel of its views, (H, W), shows: 1 the sky, 0 something else, NaN unknown."""

    kind: str
    seed: str
    capture: Capture
    sky: Mapping[str, NDArray[np.float32]]


def drawn_place(kind: str, seed: int, scratch: Path) -> Place:
    """Return a place of `places`."""
    return _with_sky(kind, str(seed), scene_capture(place(kind, seed), scratch / f"{kind}-{seed}", width=512))


def room_of(folder: Path) -> Place:
    """Return a rendered capture with truth, or a house of `poses.tours.houses`, named as there."""
    name, _, number = folder.resolve().name.partition("_")
    if not (folder / "truth.json").is_file():
        return _with_sky(f"rendered {name}", number, read_capture(folder, width=512))
    house = read_house(folder, width=512)
    sky = {view: np.where(kinds == LEFT_OUT, np.nan, 0).astype(np.float32) for view, kinds in house.kinds.items()}
    return Place(f"rendered {name}", number, house.capture, sky)


def _with_sky(kind: str, seed: str, capture: Capture) -> Place:
    sky = {name: np.float32(1) - np.isfinite(true).astype(np.float32) for name, true in capture.ranges.items()}
    return Place(kind, seed, capture, sky)


def checked_ranges(capture: Capture) -> tuple[Mapping[str, RangeMap], Mapping[str, tuple[str, ...]]]:
    """Return the range maps of a capture after the check by other views, and the neighbours of each view."""
    chain = DenseChain("known_poses", overrides=["depth.planes=96"])
    chain.dense = ["depth", "checked"]
    return chain.run(capture).range_maps["checked"], chain.index("checked", true_poses(capture)).neighbours


def views_of(one: Place) -> Iterator[tuple[View, NDArray[np.float32]]]:
    """Yield every second view of a place, with what its pixels show."""
    maps, neighbours = checked_ranges(one.capture)
    poses = one.capture.poses
    for image in list(one.capture.panoramas)[::2]:
        sources = [
            (other.load(), other.load_mask(), poses[name] @ poses[image].inverse())
            for name, other in ((name, one.capture.panoramas[name]) for name in neighbours[image])
        ]
        panorama, up = one.capture.panoramas[image], -poses[image].rotation[:, 1]
        if sources:
            view = view_of(maps[image], panorama.load(), panorama.load_mask(), sources=sources, up=up)
            yield view, nearest_resized(one.sky[image], view.valid.shape)


def rows_of_place(one: Place) -> Iterator[list[str]]:
    """Yield the rows of the table of a place."""
    for view, sky in views_of(one):
        for number, (areas, features) in enumerate(judged_areas(view, (FIRST, LATER))[1]):
            inside, known = areas >= 0, (areas >= 0) & np.isfinite(sky)
            total = np.bincount(areas[inside], view.weights[inside])
            seen, found = (
                np.bincount(areas[known], (view.weights * part)[known], len(total)) for part in (np.ones_like(sky), sky)
            )
            share = total / view.weights.sum()
            enough = (share >= _SMALL) | (np.arange(len(share)) % _SMALL_EVERY == 0)
            for idx in np.flatnonzero(enough & (seen >= _MIN_KNOWN * total)):
                values = [features[name][idx] if name in features else np.nan for name in MEASURED]
                figures = [f"{value:.3g}" if np.isfinite(value) else "" for value in values]
                later, of_sky = str(int(number > 0)), f"{found[idx] / seen[idx]:.3g}"
                yield [one.kind, one.seed, later, f"{share[idx]:.3g}", of_sky, *figures]


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


def main(
    measure: bool = False,
    rooms: list[Path] | None = None,
    coefficients: Path | None = None,
    scratch: Path = SCRATCH / "sky_places",
) -> None:
    """Fit and compare.

    Args:
        measure: draw the places again, and replace their rows of the table.
        rooms: captures with truth, or houses, whose rows are replaced or added.
        coefficients: file for the fitted models.
        scratch: folder of rendered panoramas.
    """
    cv2.setNumThreads(1)
    drawn = FITTED if measure else ()
    places = [partial(drawn_place, kind, seed, scratch) for kind, seed in drawn]
    measured = [
        row for make in (*places, *(partial(room_of, one) for one in rooms or ())) for row in rows_of_place(make())
    ]
    if measured:
        names = ["kind", "seed", "later", "share", "sky", *MEASURED]
        again = {(row[0], row[1]) for row in measured}
        kept = [[row[name] for name in names] for row in _rows_of(TABLE) if (row["kind"], row["seed"]) not in again]
        with TABLE.open("w", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows([names, *kept, *measured])
    areas = read_areas()
    print(f"{len(areas.sky)} areas\n| kind left out | sky found, % | rest lost, % |\n|---|---|---|")
    for kind, (found, lost) in left_out(areas).items():
        print(f"| {kind} | {100 * found:.1f} | {100 * lost:.2f} |")
    models = fit(areas)
    if coefficients:
        coefficients.write_text(source_of(models))
