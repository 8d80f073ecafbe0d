"""Fit which planes stay in the pixels of a view whose own ranges are not on them.

`laid.csv` holds such pixels of rendered captures and houses and of synthetic scenes with true poses, drawn by solid
angle: whether the plane is nearer to the true range than the pixel's own range, and what `laid_evidence` measured.
"room" and a number is a room of `depth.protruding`. Names that end in “b” are the fifth to ninth view of a capture.
Prints, with each place left out in turn, how many of the better planes are laid, and of the worse ones. `--data`,
`--scene`, `--house` and `--room` measure places again with the preset quality; rows of other places stay as they are.
With `--coefficients pano_mvs/algorithms/structure/laid_coefficients.py`, the model replaces the one in use.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.logistic import Model
from pano_mvs.algorithms.structure import lay
from pano_mvs.algorithms.structure.lay import proposed_planes
from pano_mvs.algorithms.structure.view import grid_rows, on_grid
from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import pixel_solid_angle
from pano_mvs.scene import RangeMap
from pano_mvs.scene.range_map import CONSISTENT_CONFIDENCE
from tests.synthetic.scenes import SCENES
from tools.benchmarks.belief.fitting import most_likely, quantile_knots
from tools.benchmarks.belief.refit import source_of
from tools.benchmarks.captures import SCRATCH, Capture, read_capture, scene_capture
from tools.benchmarks.dense_chain import DenseChain, given_records, true_poses
from tools.benchmarks.depth.houses import read_house
from tools.benchmarks.depth.protruding import protruding_room
from tools.benchmarks.table import print_table

TABLE = Path(__file__).with_name("laid.csv")
SIGNS = {"nearer": -1, "unlike": -1, "through": -1, "shared": -1}
PER_PLACE = 300
PENALTY = 1.0


@dataclass(frozen=True)
class Pixels:
    """Pixels with a plane that their own ranges are not on, as arrays (N,)."""

    columns: dict[str, FloatArray]
    better: NDArray[np.bool_]
    place: NDArray[Any]

    def __getitem__(self, chosen: NDArray[np.bool_]) -> Pixels:
        columns = {name: values[chosen] for name, values in self.columns.items()}
        return Pixels(columns, self.better[chosen], self.place[chosen])


def read(table: Path = TABLE) -> Pixels:
    """Return the pixels of the table."""
    with table.open(newline="") as file:
        rows = list(csv.DictReader(file))
    return Pixels(
        {name: np.array([float(row[name] or "nan") for row in rows]) for name in SIGNS},
        np.array([row["better"] == "1" for row in rows], np.bool_),
        np.array([row["place"] for row in rows]),
    )


def fit(pixels: Pixels) -> Model:
    """Return the probability that the plane is better than a pixel's own range."""
    knots = {name: quantile_knots(pixels.columns[name], sign) for name, sign in SIGNS.items()}
    ones = np.ones(len(pixels.better))
    return most_likely(pixels.columns, pixels.better.astype(np.float64), ones, knots=knots, penalty=PENALTY)


def left_out(pixels: Pixels) -> NDArray[np.bool_]:
    """Return whether each plane is laid by the model that was fitted to all other places, (N,)."""
    laid = np.zeros(len(pixels.better), np.bool_)
    for place in np.unique(pixels.place):
        mine = pixels.place == place
        laid[mine] = fit(pixels[~mine]).probabilities(pixels[mine].columns) >= lay.LEAST_PROBABILITIES[1]
    return laid


def measured(chain: DenseChain, capture: Capture) -> list[list[str]]:
    """Return rows of the table: pixels of a place, drawn by solid angle."""
    poses = true_poses(capture)
    done, index, given = chain.run(capture), chain.index("structure", poses), given_records(capture, poses)
    rows: list[list[str]] = []
    solid: list[float] = []
    for image in index.neighbours:
        proposals: list[lay.Proposal] = []

        def recorded(*given: Any, kept: list[lay.Proposal] = proposals, **named: Any) -> lay.Proposal:
            kept.append(proposed_planes(*given, **named))
            return kept[-1]

        with patch.object(lay, "proposed_planes", recorded):
            chain.run_one("structure", image, index, given, done)
        before = done.results["planes"][image]
        assert isinstance(before, RangeMap)
        for proposal in proposals:
            count = grid_rows(before.range.shape[0])
            own, true = (on_grid(ranges, count) for ranges in (before.range, capture.ranges[image]))
            unsure = on_grid(before.confidence, count) < CONSISTENT_CONFIDENCE[0]
            with np.errstate(invalid="ignore", divide="ignore"):
                on_plane, by_own = (np.abs(np.log(ranges / true)) for ranges in (proposal.laid, own))
            areas = pixel_solid_angle((own.shape[0], own.shape[1]))
            for at in zip(*np.nonzero(proposal.off & unsure & np.isfinite(true)), strict=True):
                values = [proposal.evidence[name][at] for name in SIGNS]
                better = int(not by_own[at] < on_plane[at])
                figures = [f"{value:.4g}" if np.isfinite(value) else "" for value in values]
                rows.append([capture.name, str(better), *figures])
                solid.append(float(areas[at[0]]))
    if not rows:
        return []
    weights = np.array(solid) / sum(solid)
    chosen = np.random.default_rng(0).choice(len(rows), min(PER_PLACE, len(rows)), replace=False, p=weights)
    return [rows[idx] for idx in np.sort(chosen)]


def main(
    data: list[Path] | None = None,
    scene: list[str] | None = None,
    house: list[Path] | None = None,
    room: list[int] | None = None,
    views: int = 5,
    coefficients: Path | None = None,
) -> None:
    """Print how well places are predicted that were left out.

    Args:
        data: captures with truth to measure again.
        scene: synthetic scenes to measure again.
        house: houses of `poses.tours.houses` to measure again, named as there.
        room: numbers of rooms of `depth.protruding` to measure again.
        views: number of views of each.
        coefficients: file for the fitted model.
    """
    cv2.setNumThreads(1)
    captures = [read_capture(folder) for folder in data or ()]
    captures += [
        scene_capture(SCENES[name](seed=0, exposure=0.0), SCRATCH / f"{name}-512", width=512) for name in scene or ()
    ]
    captures += [read_house(folder, width=512).capture for folder in house or ()]
    captures += [
        protruding_room(number, SCRATCH / f"room-{number}-1024", width=1024, views=views).capture
        for number in room or ()
    ]
    if captures:
        chain = DenseChain("quality")
        again = [row for capture in captures for row in measured(chain, capture.first(views))]
        names = ["place", "better", *SIGNS]
        with TABLE.open(newline="") as file:
            found = {row[0] for row in again}
            kept = [[row[name] for name in names] for row in csv.DictReader(file) if row["place"] not in found]
        with TABLE.open("w", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows([names, *sorted(kept + again)])
    pixels = read()
    laid = left_out(pixels)
    rows = []
    for name in ("all", *np.unique(pixels.place)):
        here = np.full(len(laid), True) if name == "all" else pixels.place == name
        counts = [(here & which).sum() for which in (pixels.better, pixels.better & laid)]
        counts += [(here & which).sum() for which in (~pixels.better, ~pixels.better & laid)]
        rows.append((str(name), *map(str, counts)))
    print_table(["place", "better on the plane", "laid", "worse on it", "laid"], rows)
    if coefficients:
        source = source_of(fit(pixels)).replace("belief.refit", "depth.laid")
        coefficients.write_text(source, encoding="utf-8")
