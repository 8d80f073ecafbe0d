"""How many of the pairs that verify `pairs.auto` chooses.

The panoramas of a walk through a house (`house_walk`) and of a suite of rooms (`suite_of_rooms`) are shuffled, so that
their order tells nothing. All pairs are matched and verified once; the table shows which of these were chosen, and how
many cameras the solver places right from all pairs and from the chosen ones: less than a tenth of the step of the walk
from the truth after alignment. FOLDER keeps the images.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from pano_mvs.algorithms.features.tangent import extract_sift
from pano_mvs.algorithms.matching.brute_force import match_features
from pano_mvs.algorithms.matching.pair_selection import automatic_pairs
from pano_mvs.algorithms.matching.vlad import vlad_descriptor
from pano_mvs.algorithms.poses.scaled_translation import solve_scaled_translation
from pano_mvs.algorithms.two_view import verify_pair
from pano_mvs.geometry import Rigid3, similarity_from_points
from pano_mvs.scene import Features, Poses, TwoView
from pano_mvs.scene.image_file import decode_image
from tools.benchmarks.poses.house_walk import STEP, write_walk
from tools.benchmarks.poses.suite_of_rooms import write_suite

WRITERS = {"walk": write_walk, "suite": write_suite}
TwoViews = dict[tuple[str, str], TwoView]


def capture(folder: Path, place: str, views: int, *, width: int) -> tuple[dict[str, Features], dict[str, Rigid3]]:
    """Return the key points of a capture in shuffled order, and the true poses."""
    truth = WRITERS[place](folder / f"{place}_{views}_{width}", views, width=width)
    names = np.random.default_rng(0).permutation(sorted(truth)).tolist()
    features = {
        name: extract_sift(picture, np.ones(picture.shape[:2], np.bool_), max_keypoints=4000)
        for name in names
        for picture in (decode_image(folder / f"{place}_{views}_{width}" / name),)
    }
    return features, truth


def verified(features: Mapping[str, Features]) -> TwoViews:
    """Return all pairs of images whose matches have a geometry."""
    names, found = list(features), TwoViews()
    for number, first in enumerate(names):
        for other, second in enumerate(names[:number]):
            candidates = match_features(features[second], features[first])
            rng = np.random.default_rng([number, other])
            view = verify_pair(features[second], features[first], candidates, rng=rng)
            if view:
                found[second, first] = view
    return found


def right(poses: Poses, truth: Mapping[str, Rigid3]) -> int:
    """Return the number of cameras that are less than a tenth of a step from the truth."""
    actual = np.array([truth[name].center for name in poses.names])
    offsets = similarity_from_points(poses.centers, actual).apply(poses.centers) - actual
    return int(np.count_nonzero(np.linalg.norm(offsets, axis=1) < 0.1 * STEP))


def main() -> None:
    """Measure and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--views", type=int, default=150)
    parser.add_argument("--width", type=int, default=512)
    options = parser.parse_args()
    print("| place | views | pairs | verified | chosen | of the verified | of strong ones | s | right: all | chosen |")
    for place in WRITERS:
        features, truth = capture(options.folder, place, options.views, width=options.width)
        began = time.process_time()
        pairs, reason = automatic_pairs({name: vlad_descriptor(one) for name, one in features.items()}, {}, {})
        seconds = time.process_time() - began
        every = verified(features)
        chosen = {frozenset(pair) for pair in pairs.pairs}
        kept = {pair: view for pair, view in every.items() if frozenset(pair) in chosen}
        strong = [pair for pair, view in every.items() if len(view) >= 100]
        of_strong = sum(pair in kept for pair in strong) / max(1, len(strong))
        counts = [
            right(solve_scaled_translation(features, views, rng=np.random.default_rng(0)), truth)
            for views in (every, kept)
        ]
        row = [place, len(features), len(features) * (len(features) - 1) // 2, len(every), len(chosen)]
        row += [f"{len(kept) / len(every):.3f}", f"{of_strong:.3f} of {len(strong)}", f"{seconds:.1f}", *counts]
        print(f"| {' | '.join(map(str, row))} | {reason}", flush=True)
