"""How well what images show tells right places of cameras from wrong ones, where structure repeats.

Captures of the families of `belief` are drawn and matched. Models grow from right seeds as `growth_by_images` grows
them, but always at a right place, the best one of these. At each step, all places that are swept are compared. A place
is right within 3° and 15 % of the distance to the nearest other cameras, in the unit of the model. The table shows the
area under the ROC over all places, and at how many of the steps that have right and wrong places the best one is right.

`--fit` also fits weights of what is confirmed under a small and under a large parallax, of correlation and cover, to
all families, each with the same weight, by logistic regression. The row "fitted" shows such weights from other
families.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from pano_mvs.algorithms.poses.growth_by_images import Growth, ranked_by_images
from pano_mvs.algorithms.poses.placement.placed_model import Pairs, PlacedModel, pairs_of
from pano_mvs.algorithms.poses.verification.appearance import Appearance
from pano_mvs.algorithms.poses.verification.arrangements import CHANCE_SHARE, place_score
from pano_mvs.algorithms.poses.verification.confirmation import MIN_TEXTURED, Confirmation, Evidence, Picture
from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import Rigid3, angle_between, geodesic_angle
from tools.benchmarks.belief.families import FAMILIES, LEARNED, Capture, draw
from tools.benchmarks.belief.fitting import area_under_roc
from tools.benchmarks.belief.measuring import matched
from tools.benchmarks.table import print_table

_WIDTH_PX, _SEEDS, _PENALTY = 128, 2, 0.3
REPEATING = ("hall", "colonnade", "street", "corridor", "twin_rooms", "stairs", "three")


@dataclass(frozen=True)
class Place:
    """A place of an image that was swept while a model grew."""

    family: str
    step: str  # of the growth of a model; places of one step are alternatives
    right: bool
    confirmed: Evidence
    appearance: Appearance

    @property
    def measured(self) -> FloatArray:
        """Shares that are confirmed under a parallax up to 30° and under a larger one, correlation, cover."""
        textured = max(self.confirmed.textured.sum(), MIN_TEXTURED * 4 * np.pi)
        near, far = (float(part.sum() / textured) for part in np.split(self.confirmed.confirmed, [5]))
        return np.array([near, far, self.appearance.correlation, self.appearance.cover])


MEASURES: dict[str, Callable[[Place], float]] = {
    "confirmed share": lambda place: float(np.nan_to_num(place.confirmed.share)),
    "agreement": lambda place: place.appearance.agreement,
    "correlation": lambda place: place.appearance.correlation,
    "cover (less is better)": lambda place: -place.appearance.cover,
    "place_score": lambda place: place_score(float(np.nan_to_num(place.confirmed.share)), place.appearance),
}


def places_of(capture: Capture) -> Iterator[Place]:
    """Yield the places that were swept while models of a capture grew at right places."""
    features, views = matched(capture, learned=False)
    names = tuple(features)
    truth = {idx: capture.truth[name] for idx, name in enumerate(names) if name in capture.truth}

    def load(image: int) -> Picture:
        picture = capture.pictures[names[image]]
        return picture, np.ones(picture.shape[:2], np.bool_)

    confirmation = Confirmation(load, width_px=_WIDTH_PX)
    pairs = pairs_of(features, views, consistent=False)
    seeds = [
        (edge, rank)
        for edge, rank in ranked_by_images(pairs, [*truth], confirmation)
        if _is_right_seed(pairs, edge, rank, truth)
    ]
    for number, (edge, rank) in enumerate(seeds[:_SEEDS]):
        model = PlacedModel(pairs)
        model.seed(edge, rank)
        growth = Growth(model, set(truth) - {*edge}, confirmation, adjust=True)
        right = True
        while right:
            growth.usable()
            swept = [option for option in growth.options if option.evidence is not None]
            label = f"{capture.family} {capture.seed} {number} {len(model.cameras)}"
            best = None
            for option in sorted(swept, key=lambda each: -each.score):
                is_right = _is_right(option.image, option.pose, model.cameras, truth)
                best = option if best is None and is_right and option.share >= CHANCE_SHARE else best
                assert option.evidence is not None
                yield Place(capture.family.partition("/")[0], label, is_right, option.evidence, option.appearance)
            right = best is not None
            if best is not None:
                growth.add(best)


def _is_right_seed(pairs: Pairs, edge: tuple[int, int], rank: int, truth: Mapping[int, Rigid3]) -> bool:
    view, true = pairs.geometries[edge][rank].view, truth[edge[1]] @ truth[edge[0]].inverse()
    turned = float(geodesic_angle(view.rotation, true.rotation))
    return bool(turned < np.deg2rad(3.0) and angle_between(view.direction, true.translation) < np.deg2rad(6.0))


def _is_right(image: int, pose: Rigid3, cameras: Mapping[int, Rigid3], truth: Mapping[int, Rigid3]) -> bool:
    def distances(poses: Mapping[int, Rigid3]) -> FloatArray:
        centers = np.array([poses[idx].center for idx in sorted(cameras)])
        apart: FloatArray = np.linalg.norm(centers[:, None] - centers, axis=2)
        return apart[np.triu_indices(len(centers), 1)]

    unit = float(np.median(distances(cameras) / np.maximum(distances(truth), 1e-9)))
    near = sorted(cameras, key=lambda idx: float(np.linalg.norm(truth[idx].center - truth[image].center)))[:3]
    turned, off = [], []
    for camera in near:
        found, true = pose @ cameras[camera].inverse(), truth[image] @ truth[camera].inverse()
        turned.append(float(geodesic_angle(found.rotation, true.rotation)))
        away, apart = np.linalg.norm([found.translation / unit - true.translation, true.translation], axis=1)
        off.append(float(away / max(float(apart), 1e-9)))
    return max(turned) < np.deg2rad(3.0) and float(np.median(off)) < 0.15


def fitted(places: Sequence[Place]) -> tuple[FloatArray, float]:
    """Return the weights of `Place.measured` (4,) and the constant of the logarithm of the odds that a place is right.

    Every family has the same weight.
    """
    values = np.array([place.measured for place in places])
    right = np.array([place.right for place in places], np.float64)
    families = [place.family for place in places]
    weight = np.array([len(places) / (families.count(one) * len({*families})) for one in families])
    mean, spread = values.mean(axis=0), values.std(axis=0)
    rows = np.column_stack([np.ones(len(values)), (values - mean) / spread])

    def cost(found: FloatArray) -> tuple[float, FloatArray]:
        logit = rows @ found
        lost = weight @ (np.logaddexp(0.0, -logit) + (1 - right) * logit)
        penalised = np.concatenate([[0.0], found[1:]])
        gradient = rows.T @ (weight * (1 / (1 + np.exp(-logit)) - right)) + 2 * _PENALTY * penalised
        return float(lost + _PENALTY * penalised @ penalised), gradient

    found = minimize(cost, np.zeros(rows.shape[1]), jac=True).x
    weights = found[1:] / spread
    return weights, float(found[0] - weights @ mean)


def rows(places: Sequence[Place], *, fit: bool) -> Iterator[list[object]]:
    """Yield a row of the table for each measure."""
    measured = {label: np.array([measure(place) for place in places]) for label, measure in MEASURES.items()}
    if fit:
        left_out = np.zeros(len(places))
        for family in {place.family for place in places}:
            weights = fitted([place for place in places if place.family != family])[0]
            for idx, place in enumerate(places):
                if place.family == family:
                    left_out[idx] = place.measured @ weights
        measured["fitted"] = left_out
    right = np.array([place.right for place in places], np.bool_)
    steps: dict[str, list[int]] = {}
    for idx, place in enumerate(places):
        steps.setdefault(place.step, []).append(idx)
    told = [own for own in steps.values() if 0 < right[own].sum() < len(own)]
    for label, values in measured.items():
        best = [bool(right[max(own, key=lambda idx: values[idx])]) for own in told]
        yield [label, f"{area_under_roc(values, right):.3f}", f"{np.mean(best):.3f}" if best else "–", len(best)]


def main() -> None:
    """Measure the captures that the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    choices = [name for name in FAMILIES if not name.endswith(LEARNED)]
    parser.add_argument("--families", nargs="+", choices=choices, default=list(REPEATING))
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--rounds", type=int, default=2, help="captures of each family; default 2")
    parser.add_argument("--fit", action="store_true", help="fit weights")
    options = parser.parse_args()
    places: list[Place] = []
    for seed in range(options.first_seed, options.first_seed + options.rounds):
        for family in options.families:
            try:
                capture = draw(family, seed)
            except ValueError as error:  # the drawn place is too small for its cameras
                print(f"{family} {seed}: {error}", flush=True)
                continue
            places += places_of(capture)
    columns = "measure", "area under the ROC", "best place of a step is right", "steps"
    print_table(columns, rows(places, fit=options.fit))
    if options.fit:
        weights, constant = fitted(places)
        print("near, far, correlation, cover:", np.round(weights, 1).tolist(), "constant:", round(constant, 1))
