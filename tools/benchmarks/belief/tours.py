"""Collect evidence of tours.

Each DIR is a capture with truth.json that `python -m tools benchmarks poses.tours.measure DIR … --out OUT` has run with
`quality`. Its pairs are verified again with other random samples for each of the seeds. FILE receives a line for each
tour and seed, as `belief.collect` writes them for generated captures; the name of a tour is its family.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from pano_mvs.algorithms.poses.scaled_translation import solve_scaled_translation
from pano_mvs.algorithms.poses.verification.confirmation import Picture
from pano_mvs.algorithms.poses.verification.verify_poses import verify_poses
from pano_mvs.algorithms.two_view import verify_pair
from pano_mvs.scene import Features, TwoView
from pano_mvs.scene.pose_groups import split_groups
from tools.benchmarks.belief.families import LEARNED, Capture
from tools.benchmarks.belief.measuring import rows_of
from tools.benchmarks.poses.tours.measure import read_truth
from tools.benchmarks.poses.tours.pair_evidence import learned_views


def measure_tour(
    folder: Path, features: Mapping[str, Features], views: Mapping[tuple[str, str], TwoView], *, seed: int = 0
) -> list[dict[str, Any]]:
    """Return the cameras of a tour that its pairs place, as JSON objects (`belief.measuring.Measured`).

    Args:
        folder: the capture, with images/ and truth.json.
        features: key points of the images.
        views: the verified pairs.
        seed: of the samples with which the pairs were verified.
    """
    truth = read_truth(folder)
    assert truth is not None, f"{folder} has no truth.json with headings"
    capture = Capture(folder.name + LEARNED, seed, {}, truth[0], "")
    read: dict[str, Picture] = {}

    def load(name: str) -> Picture:
        if name not in read:
            picture = cv2.imread(str(folder / "images" / name))
            assert picture is not None, f"{folder / 'images' / name} cannot be read"
            read[name] = cv2.cvtColor(picture, cv2.COLOR_BGR2RGB).astype(np.uint8), np.ones(picture.shape[:2], np.bool_)
        return read[name]

    poses = solve_scaled_translation(features, views, load=load, rng=np.random.default_rng(0))
    rows: list[dict[str, Any]] = []
    for number, found in enumerate(split_groups(verify_poses(poses, load, features=features, two_views=views))):
        rows += rows_of(capture, "asked", found, group=number, learned=True, limits=truth[1])
    return rows


def verified_again(
    features: Mapping[str, Features], views: Mapping[tuple[str, str], TwoView], *, seed: int
) -> dict[tuple[str, str], TwoView]:
    """Return pairs whose matches were verified with other random samples."""
    rng, found = np.random.default_rng(seed), dict[tuple[str, str], TwoView]()
    for (first, second), view in views.items():
        own, matches = np.random.default_rng(rng.integers(2**31)), view.all_matches_idx
        found[first, second] = (
            verify_pair(features[first], features[second], matches, rng=own) if len(matches) else view
        )
    return found


def main() -> None:
    """Measure the tours that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path)
    parser.add_argument("tours", nargs="+", type=Path, metavar="DIR")
    parser.add_argument("--runs", type=Path, required=True, metavar="OUT", help="results of poses.tours.measure")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2])
    given = parser.parse_args()
    for tour in given.tours:
        features, views = learned_views(given.runs / tour.name, merged=True)
        for seed in given.seeds:
            rows = measure_tour(tour, features, verified_again(features, views, seed=seed), seed=seed)
            with given.file.open("a", encoding="utf-8") as out:
                out.write(json.dumps({"family": tour.name + LEARNED, "seed": seed, "cameras": rows}) + "\n")
