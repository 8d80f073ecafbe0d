"""How much of the sky is found, and what is lost.

Synthetic places with the sky over a court, behind branches and slats, and through the windows of a room, and two places
of each kind of `tools.benchmarks.sky.places` that the models of `filters.sky` were not fitted to; known poses, four
views, 512×256: `depth.sweep` with 96 planes, `filters.consistency`, `filters.sky`. Prints the share of the pixels
without a surface that is found, and the share of all other pixels that loses its range, of the worst view and on
average, and without the stage the share of the sky on which other views confirm a range.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from pano_mvs.scene.range_map import CONSISTENT_CONFIDENCE
from tests.synthetic.places import window_room, yard
from tests.synthetic.scenes import Scene, courtyard
from tools.benchmarks.captures import SCRATCH, Capture, scene_capture
from tools.benchmarks.dense_chain import DenseChain
from tools.benchmarks.depth.scores import share_of_sphere
from tools.benchmarks.sky.places import KINDS, place
from tools.benchmarks.table import print_table

UNSEEN = (100, 101)
MAKERS = {maker.__name__: maker for maker in (courtyard, yard, window_room)}
PLACES: tuple[tuple[str, dict[str, Any]], ...] = (
    ("courtyard", {"seed": 11, "sky": "blue"}),
    ("courtyard", {"seed": 11, "sky": "overcast"}),
    ("yard", {"seed": 0, "sky": "blue"}),
    ("yard", {"seed": 0, "sky": "overcast"}),
    ("yard", {"seed": 3, "sky": "clouds", "exposure": 0.1}),
    ("yard", {"seed": 3, "sky": "overcast", "exposure": 0.15}),
    ("window_room", {"seed": 0, "sky": "blue"}),
    ("window_room", {"seed": 0, "sky": "overcast"}),
    ("window_room", {"seed": 3, "sky": "clouds", "exposure": 0.05}),
)


def figures(capture: Capture) -> list[float]:
    """Return the worst and mean share of the sky that is found, of the rest that is lost, and what is confirmed."""
    chain = DenseChain("known_poses", overrides=["depth.planes=96"])
    chain.dense = ["depth", "checked", "sky"]
    maps = chain.run(capture).range_maps
    rows = []
    for image, truth in capture.ranges.items():
        found, nothing = maps["sky"][image].sky, ~np.isfinite(truth)
        assert found is not None
        confirmed = maps["checked"][image].confidence >= CONSISTENT_CONFIDENCE[0]
        cases = ((found, nothing), (found, ~nothing), (confirmed, nothing))
        rows.append([share_of_sphere(where, within=part) if part.any() else np.nan for where, part in cases])
    found_there, lost, confirmed_there = np.array(rows).T
    worst = float(found_there.min())  # NaN without any sky
    return [worst, *(float(each) for each in (found_there.mean(), lost.max(), lost.mean(), confirmed_there.mean()))]


def main(kind: list[str] | None = None, width: int = 512, scratch: Path = SCRATCH / "sky") -> None:
    """Print the table.

    Args:
        kind: only these; default all.
        width: of the panoramas.
        scratch: folder of rendered panoramas.
    """
    cv2.setNumThreads(1)

    def captures() -> Iterator[tuple[str, Callable[[], Scene]]]:
        for maker, arguments in PLACES:
            name = " ".join([maker, *(f"{key} {value}" for key, value in arguments.items())])
            yield name, partial(MAKERS[maker], **arguments)
        for each in KINDS:
            yield from ((f"{each}-{seed}", partial(place, each, seed)) for seed in UNSEEN)

    def rows() -> Iterator[list[str]]:
        for name, scene in captures():
            if kind is None or re.split("[ -]", name)[0] in kind:
                capture = scene_capture(scene(), scratch / f"{name}-{width}", width=width)
                yield [name, *(f"{figure:.2f}" for figure in figures(capture))]

    print_table(["place", "found, worst %", "mean", "lost, worst %", "mean", "confirmed without %"], rows())
