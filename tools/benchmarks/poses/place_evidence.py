"""How well what images show tells right places of cameras from wrong ones, where structure repeats.

Captures of the families of `belief` are drawn and matched. Of each, blocks of true cameras that stand side by side are
models from which to go on: the places that pairs suggest for the nearest other images are compared by the share of what
each sees there that the block confirms, by how it looks there (`Appearance`), by the weight of its pairs, and by
`place_score`. A place is right within 3° and 15 % of the distance to the nearest camera of the block. The table shows
the area under the ROC over all places, and how often the best place of a block is right.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from pano_mvs.algorithms.poses.growth_by_images import ranges_of_key_points
from pano_mvs.algorithms.poses.placement.placed_model import PlacedModel, pairs_of
from pano_mvs.algorithms.poses.verification.appearance import Appearance, Surroundings
from pano_mvs.algorithms.poses.verification.arrangements import place_score
from pano_mvs.algorithms.poses.verification.confirmation import Confirmation, Picture, nearest_cameras
from pano_mvs.geometry import Rigid3, geodesic_angle
from tools.benchmarks.belief.families import FAMILIES, LEARNED, Capture, draw
from tools.benchmarks.belief.fitting import area_under_roc
from tools.benchmarks.belief.measuring import matched
from tools.benchmarks.table import print_table

_WIDTH_PX, _NEXT = 128, 5
REPEATING = ("hall", "colonnade", "street", "corridor", "twin_rooms", "stairs")


@dataclass(frozen=True)
class Place:
    """A place that pairs suggest for an image, and what is measured there."""

    block: str
    right: bool
    share: float
    pairs: float
    appearance: Appearance


MEASURES: dict[str, Callable[[Place], float]] = {
    "confirmed share": lambda place: place.share,
    "agreement": lambda place: place.appearance.agreement,
    "correlation": lambda place: place.appearance.correlation,
    "cover (less is better)": lambda place: -place.appearance.cover,
    "weight of pairs": lambda place: place.pairs,
    "place_score": lambda place: place_score(place.share, place.appearance),
}


def places_of(capture: Capture, *, rng: np.random.Generator) -> Iterator[Place]:
    """Yield the places that pairs suggest beside blocks of true cameras of a capture."""
    features, views = matched(capture, learned=False)
    names = tuple(features)
    truth = {idx: capture.truth[name] for idx, name in enumerate(names) if name in capture.truth}

    def load(image: int) -> Picture:
        picture = capture.pictures[names[image]]
        return picture, np.ones(picture.shape[:2], np.bool_)

    confirmation = Confirmation(load, width_px=_WIDTH_PX)
    pairs = pairs_of(features, views, consistent=False)
    for number in range(4 if len(truth) > 7 else 2):
        count = int(rng.integers(2, max(3, min(7, len(truth) - 1))))
        first = int(rng.choice(list(truth)))
        others = {idx: pose for idx, pose in truth.items() if idx != first}
        block = {idx: truth[idx] for idx in (first, *nearest_cameras(truth[first], others, count=count - 1))}
        model = PlacedModel(pairs).with_cameras(block)
        maps = {idx: confirmation.ranges(idx, block) for idx in block}
        for idx in block:
            model.confirmed_ranges[idx] = ranges_of_key_points(maps[idx], pairs.bearings[idx])
        surroundings = Surroundings(confirmation, block, maps)
        distance = {
            idx: min(float(np.linalg.norm(pose.center - own.center)) for own in block.values())
            for idx, pose in truth.items()
            if idx not in block
        }
        for image in sorted(distance, key=lambda idx: (distance[idx], idx))[:_NEXT]:
            evidence, found = model.place(image, most=8)
            for place in found:
                pose, _, _ = model.polished(image, evidence, place)
                share = float(np.nan_to_num(confirmation.share(image, pose, block)))
                appearance = surroundings.appearance(image, place.cam_from_world)
                yield Place(
                    f"{capture.family} {capture.seed} {number}",
                    _is_right(pose, truth[image], distance=distance[image]),
                    share,
                    place.score / evidence.total,
                    appearance,
                )


def _is_right(pose: Rigid3, true: Rigid3, *, distance: float) -> bool:
    turned = float(geodesic_angle(pose.rotation, true.rotation))
    return turned < np.deg2rad(3.0) and float(np.linalg.norm(pose.center - true.center)) < 0.15 * distance


def rows(places: list[Place]) -> Iterator[list[object]]:
    """Yield a row of the table for each measure."""
    right = np.array([place.right for place in places], np.bool_)
    blocks: dict[str, list[Place]] = {}
    for place in places:
        blocks.setdefault(place.block, []).append(place)
    told = [own for own in blocks.values() if 0 < sum(place.right for place in own) < len(own)]
    for label, measure in MEASURES.items():
        values = np.array([measure(place) for place in places])
        best = [max(own, key=measure).right for own in told]
        yield [label, f"{area_under_roc(values, right):.3f}", f"{np.mean(best):.3f}" if best else "–", len(best)]


def main() -> None:
    """Measure the captures that the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    choices = [name for name in FAMILIES if not name.endswith(LEARNED)]
    parser.add_argument("--families", nargs="+", choices=choices, default=list(REPEATING))
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--rounds", type=int, default=2, help="captures of each family; default 2")
    options = parser.parse_args()
    places: list[Place] = []
    for seed in range(options.first_seed, options.first_seed + options.rounds):
        for family in options.families:
            try:
                capture = draw(family, seed)
            except ValueError as error:  # the drawn place is too small for its cameras
                print(f"{family} {seed}: {error}", flush=True)
                continue
            places += places_of(capture, rng=np.random.default_rng([seed, 11]))
    print_table(("measure", "area under the ROC", "best place of a block is right", "blocks"), rows(places))
