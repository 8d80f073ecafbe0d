"""How significant wrong learned pairs are.

Each DIR is a capture with truth.json, see `tools.benchmarks.poses.tours.measure`. Each panorama is matched with those
that have the most similar learned key points, as `matches.lightglue` does. The best relative pose of each pair is right
if it agrees with the truth to 3° and 6°, or to 6° and 15° where the truth was drawn by hand. The table shows right and
wrong pairs by log₁₀ of their false alarms and by the median angle that the best rotation leaves between the matches
that agree, and how many of them `verify_pair` accepts. Below is where a logistic regression on the logarithm of this
exponent gives even odds, which is the limit of `verify_pair` for learned matches. Results stay in DIR/pairs, also those
of a run that was interrupted.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping
from functools import partial
from itertools import pairwise, product
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from scipy.optimize import minimize

from pano_mvs.algorithms.features.tangent import extract_sift
from pano_mvs.algorithms.learned.aliked import extract_aliked, joined
from pano_mvs.algorithms.learned.lightglue import match_learned
from pano_mvs.algorithms.learned.weak_images import learned_pairs
from pano_mvs.algorithms.matching.brute_force import match_features
from pano_mvs.algorithms.poses.frame.upside_down import ups_of_picture
from pano_mvs.algorithms.two_view.verification import verify_pair
from pano_mvs.geometry import angle_between, geodesic_angle, nearest_rotation
from pano_mvs.scene import Features
from tools.benchmarks.poses.precision import cached
from tools.benchmarks.poses.tours.measure import read_truth

EDGES = (-np.inf, -200.0, -100.0, -75.0, -50.0, -35.0, -25.0, -15.0, -6.0, np.inf)
LEFT_DEG = (0.0, 3.0, 5.0, 8.0, np.inf)
_EXACT_DEG, _DRAWN_DEG = (3.0, 6.0), (6.0, 15.0)


def keypoints(picture: Path) -> Features:
    """Return the SIFT and the learned key points of a panorama."""
    stored = cv2.imread(str(picture))
    assert stored is not None, picture
    image = np.ascontiguousarray(stored[..., ::-1])
    mask = np.ones(image.shape[:2], np.bool_)
    return joined(extract_sift(image, mask), extract_aliked(image, mask, ups=ups_of_picture(image, mask)))


def candidates(first: Features, second: Features) -> np.ndarray:
    """Return the matches of both kinds of key points, as `matches.lightglue` finds them."""
    own = match_features(first.without_learned(), second.without_learned())
    return np.concatenate([own, match_learned(first, second)])


class JudgedPair(NamedTuple):
    """A pair with a hypothesis: log₁₀ of its false alarms, what a rotation leaves, and whether the pose is right."""

    exponent: float
    left_deg: float
    accepted: bool
    right: bool


def judged_pairs(capture: Path, *, neighbours: int) -> Iterator[JudgedPair]:
    """Yield the pairs of a capture that have a hypothesis."""
    truth = read_truth(capture)
    assert truth is not None, f"{capture} has no truth.json with headings"
    poses, limits = truth
    most = _EXACT_DEG if limits[0] < 2 else _DRAWN_DEG
    folder = capture / "pairs"
    found: Mapping[str, Features] = {
        name: cached(folder / f"{name}.pkl", partial(keypoints, capture / "images" / name)) for name in sorted(poses)
    }
    for first, second in learned_pairs(found, neighbours=neighbours).pairs:
        ends = found[first], found[second]
        matches = cached(folder / f"{first}_{second}.pkl", partial(candidates, *ends))
        view = verify_pair(*ends, matches, rng=np.random.default_rng(0))
        best, true = view if view else next(iter(view.alternatives), None), poses[second] @ poses[first].inverse()
        if best is not None:
            off = geodesic_angle(best.rotation, true.rotation), angle_between(best.direction, true.translation)
            p, q = (end.bearings[idx] for end, idx in zip(ends, best.matches_idx.T, strict=True))
            left = np.rad2deg(np.median(angle_between(p @ nearest_rotation(q.T @ p).T, q)))
            yield JudgedPair(view.log10_false_alarms, float(left), bool(view), bool(np.all(np.rad2deg(off) < most)))


def even_exponent(exponents: np.ndarray, right: np.ndarray) -> float:
    """Return the exponent at which a pair is as likely right as wrong, by logistic regression; NaN if all are alike."""
    if right.all() or not right.any():
        return float("nan")
    x, sign = np.log(np.maximum(-exponents, 1.0)), np.where(right, 1.0, -1.0)

    def loss(line: np.ndarray) -> float:
        # The weak prior keeps the slope finite if a limit separates all pairs.
        return float(np.logaddexp(0, -sign * (line[0] + line[1] * x)).sum() + 0.01 * line[1] ** 2)

    offset, slope = minimize(loss, np.zeros(2)).x
    return float(-np.exp(-offset / slope))


def main() -> None:
    """Print the table of the captures that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", nargs="+", type=Path, metavar="DIR")
    parser.add_argument("--neighbours", type=int, default=8)
    given = parser.parse_args()
    pairs = [pair for capture in given.captures for pair in judged_pairs(capture, neighbours=given.neighbours)]
    exponents, left, accepted, right = (np.array(column) for column in zip(*pairs, strict=True))
    print("| log₁₀ of the false alarms | left by a rotation | right | wrong | accepted: right | wrong |")
    print("|---" * 6 + "|")
    for (low, high), (near, far) in product(pairwise(EDGES), pairwise(LEFT_DEG)):
        inside = (exponents > low) & (exponents <= high) & (left >= near) & (left < far)
        counts = (int((inside & one).sum()) for one in (right, ~right, accepted & right, accepted & ~right))
        print(f"| {low:g} to {high:g} | {near:g}° to {far:g}° | " + " | ".join(map(str, counts)) + " |")
    print(f"even odds at {even_exponent(exponents, right):.0f}")
