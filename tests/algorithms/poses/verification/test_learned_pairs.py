"""Cameras that only weak or learned matches with one other image place are doubtful."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pano_mvs.algorithms.poses.verification.verify_poses import with_unconfirmed_doubts
from pano_mvs.geometry import Rigid3
from pano_mvs.scene import Poses, TwoView
from tests.algorithms.poses.synthetic_capture import features_from_bearings

OWN, LEARNED = 40, 60


def pair_of(count: int, *, start: int, exponent: float = -80.0) -> TwoView:
    matches = np.arange(start, start + count, dtype=np.int32)
    residuals = np.zeros(count, np.float32)
    view = TwoView(np.stack([matches, matches], axis=1), np.eye(3), np.array([0.0, 0, 1]), residuals, "general")
    return replace(view, log10_false_alarms=exponent)


SIFT, NETWORK, FEW = pair_of(30, start=0), pair_of(50, start=OWN - 10), pair_of(6, start=0)
WEAK = pair_of(30, start=0, exponent=-20.0)


@pytest.mark.parametrize(
    ("pairs", "doubted"),
    [
        ({"ab": SIFT, "bc": SIFT, "cd": SIFT}, ""),
        ({"ab": SIFT, "bc": SIFT, "cd": NETWORK}, "d"),
        ({"ab": SIFT, "bc": NETWORK, "cd": SIFT}, "abcd"),
        ({"ab": NETWORK, "bc": NETWORK, "ac": NETWORK, "cd": SIFT}, ""),
        ({"ab": NETWORK, "bc": NETWORK, "cd": NETWORK, "ad": NETWORK}, ""),
        ({"ab": NETWORK}, "ab"),
        ({"ab": FEW}, ""),
        ({"ab": SIFT, "bc": SIFT, "cd": WEAK}, "d"),
        ({"ab": SIFT, "bc": WEAK, "ac": WEAK}, ""),
    ],
    ids=["own", "last", "middle", "triangle", "ring", "two", "few", "weak", "weak triangle"],
)
def test_a_bridge_of_weak_or_learned_matches_is_doubtful(pairs: dict[str, TwoView], doubted: str) -> None:
    names = sorted({*"".join(pairs)})
    rays = np.random.default_rng(1).normal(size=(OWN + LEARNED, 3))
    features = dict.fromkeys(names, replace(features_from_bearings(rays), learned=LEARNED))
    cameras = {name: Rigid3(np.eye(3), np.array([float(idx), 0, 0])) for idx, name in enumerate(names)}
    poses = Poses.without_points(cameras, frame="made up", scale="made up", metric=False)
    found = with_unconfirmed_doubts(poses, features, {(pair[0], pair[1]): view for pair, view in pairs.items()})
    assert sorted(found.doubts) == sorted(doubted)
