"""Fit the model of evidence, and compare it with the rules.

Run it with `python -m tools benchmarks belief.refit FIT --fresh FRESH`.

FIT and FRESH are files of `tools.benchmarks.belief.collect` or `belief.tours`, or tables: docs/benchmarks.md is about
`evidence.csv`, generated captures, and `learned.csv`, tours with learned matches; both are fitted. `--table FILE`
writes all of FIT into one. The script prints, for all families and for each, how many right cameras are doubted and how
many wrong ones are not, by `poses.verify` when the captures were measured and by the model, and how many captures
without a doubt hold a wrong camera.
Cameras of FIT are judged by a model without their kind of place, cameras of FRESH by the model of all of FIT. With
`--coefficients pano_mvs/algorithms/poses/verification/belief/coefficients.py`, the model replaces the one in use;
`--picture FILE` draws the reliability diagram.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.logistic import Model, Term
from pano_mvs.algorithms.poses.verification.belief.doubts import is_doubtful
from tools.benchmarks.belief.fitting import (
    PENALTY,
    SIGNS,
    Cameras,
    Outcome,
    area_under_roc,
    calibration_error,
    cameras_of,
    fit,
    joined,
    left_out,
    read_table,
    write_table,
)

FloatArray = NDArray[np.float64]

BINS = 10


UNDECIDABLE = "twin_house"
"""Rooms that are equal in everything: nothing measured can be for or against their cameras, so they are not fitted."""


def read(files: Sequence[Path]) -> Cameras:
    """Return the cameras of files of measured captures and of tables."""
    return joined(
        [
            read_table(file)
            if file.suffix == ".csv"
            else cameras_of([json.loads(line) for line in file.read_text().splitlines()])
            for file in files
        ]
    )


def decidable(cameras: Cameras) -> Cameras:
    """Return the cameras without those of `UNDECIDABLE`."""
    return cameras[cameras.place != UNDECIDABLE]


def doubted(probability: FloatArray) -> NDArray[np.bool_]:
    """Return which cameras are doubted."""
    return np.array([is_doubtful(one) for one in probability], np.bool_)


def show(title: str, cameras: Cameras, probability: FloatArray) -> None:
    """Print the outcomes of the rules and of the model, for each family and for all."""
    captures = len(np.unique(cameras.capture))
    print(f"\n{title}: {len(cameras.right)} cameras of {captures} solutions")
    print("| family | judged by | right | wrong | right, doubted | wrong, not doubted | calibration error | ROC |")
    print("|---" * 8 + "|")
    for family in ("all", *np.unique(cameras.family)):
        mine = np.full(len(cameras.right), True) if family == "all" else cameras.family == family
        own, right = probability[mine], cameras.right[mine]
        rules, model = Outcome.of(right, cameras.doubted[mine]), Outcome.of(right, doubted(own))
        print(f"{rules.line(f'{family} | rules')} – | – |")
        quality = f"{calibration_error(own, right):.3f} | {area_under_roc(own, right):.3f}"
        print(f"{model.line(f'{family} | model')} {quality} |")


def show_captures(cameras: Cameras, probability: FloatArray) -> None:
    """Print how many captures that were solved with their images have no doubt, and in how many of them all is right.

    Half of the captures were solved without images, or have a camera that was displaced on purpose; these are left out.
    """
    as_used = np.array([capture.split()[-1] == "asked" for capture in cameras.capture], np.bool_)
    print("\n| family | no doubt: all right | with a wrong camera | doubts: all right | with a wrong camera |")
    print("|---" * 5 + "|")
    counts = {family: np.zeros(4, int) for family in ("all", *np.unique(cameras.family))}
    for capture in np.unique(cameras.capture[as_used]):
        mine = cameras.capture == capture
        outcome = 2 * int(doubted(probability[mine]).any()) + int(not cameras.right[mine].all())
        for family in ("all", str(cameras.family[mine][0])):
            counts[family][outcome] += 1
    for family, found in counts.items():
        print(f"| {family} | {' | '.join(map(str, found))} |")


def draw(path: Path, probability: FloatArray, cameras: Cameras) -> None:
    """Write a reliability diagram: how many cameras are right, by their probability and by family."""
    from matplotlib import pyplot

    figure, (axes, families) = pyplot.subplots(1, 2, figsize=(10, 6.6), layout="constrained")
    right = cameras.right
    number = np.minimum((probability * BINS).astype(int), BINS - 1)
    axes.plot([0, 1], [0, 1], color="0.7", linewidth=1)
    for each in np.unique(number):
        inside = number == each
        share, count = right[inside].mean(), int(inside.sum())
        error = np.sqrt(share * (1 - share) / count)
        axes.errorbar(probability[inside].mean(), share, yerr=error, fmt="o", color="C0")
        axes.annotate(str(count), (probability[inside].mean(), share), textcoords="offset points", xytext=(6, -10))
    axes.set(xlabel="probability that a camera is right", ylabel="share of cameras that are right")
    names = sorted(np.unique(cameras.family), key=lambda name: right[cameras.family == name].mean())
    for row, name in enumerate(names):
        mine = cameras.family == name
        share = right[mine].mean()
        error = np.sqrt(share * (1 - share) / mine.sum())
        families.errorbar(share, row, xerr=error, fmt="o", color="C0", label="are right" if not row else None)
        families.plot(probability[mine].mean(), row, "|", color="C1", ms=14, mew=3, label="" if row else "expected")
    families.set(yticks=range(len(names)), yticklabels=names, xlabel="share of cameras")
    families.legend(loc="upper left")
    figure.savefig(path, bbox_inches="tight", dpi=150)
    pyplot.close(figure)


def source_of(model: Model) -> str:
    """Return the model as a Python module: a change of its coefficients is a change of the code of `poses.verify`."""
    terms = "".join(
        f'        "{name}": Term({", ".join(map(repr, _arguments(term)))}),\n' for name, term in model.terms.items()
    )
    return (
        '"""The coefficients that `python -m tools benchmarks belief.refit` has fitted."""\n\n'
        "from pano_mvs.algorithms.logistic import Model, Term\n\n"
        f"FITTED = Model(\n    {model.intercept},\n    {{\n{terms}    }},\n)\n"
    )


def _arguments(term: Term) -> tuple[object, ...]:
    found = term.knots, term.losses, term.missing
    return found if term.full_from is None else (*found, term.full_from)


def main() -> None:
    """Fit, compare and draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("fit", nargs="+", type=Path)
    parser.add_argument("--fresh", nargs="*", type=Path, default=[])
    parser.add_argument("--penalty", type=float, default=PENALTY, help="on the squared losses")
    parser.add_argument("--coefficients", type=Path, help="file for the fitted model")
    parser.add_argument("--table", type=Path, help="CSV file for the measurements of all cameras of FIT")
    parser.add_argument("--picture", type=Path, help="file for the reliability diagram")
    options = parser.parse_args()
    cameras = read(options.fit)
    if options.table:
        write_table(options.table, cameras)
    cameras = decidable(cameras)
    probability = left_out(cameras, penalty=options.penalty)
    show("Families left out of the fit", cameras, probability)
    show_captures(cameras, probability)
    model = fit(cameras, penalty=options.penalty)
    print(f"\n{len(model.terms)} of {len(SIGNS)} measurements count")
    for name, term in model.terms.items():
        print(f"  {name:22s} {term.knots} {term.losses} missing {term.missing}")
    if options.fresh:
        fresh = decidable(read(options.fresh))
        probability = model.probabilities(fresh.columns)
        show("Fresh draws", fresh, probability)
        cameras = fresh
    if options.coefficients:
        options.coefficients.write_text(source_of(model), encoding="utf-8")
    if options.picture:
        draw(options.picture, probability, cameras)
