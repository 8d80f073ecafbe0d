"""The benchmark of corrections compares the cameras of a capture before and after them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pano_mvs.geometry import Rigid3
from pano_mvs.scene import Features, Poses, TwoView
from pano_mvs.testing.tiny_capture import Variant, tiny_capture
from tests.algorithms.poses.synthetic_capture import random_poses
from tools.benchmarks.belief import corrections
from tools.benchmarks.belief.corrections import Corrected, corrected, measure
from tools.benchmarks.belief.families import Capture
from tools.benchmarks.poses.placements import Placements, judge_placements


def one_lost(family: str, seed: int) -> Corrected:
    """Return a capture of five cameras: one was wrong and becomes right, one the reverse, one is left out."""
    truth = random_poses(np.random.default_rng(seed), 5)
    gained, lost, removed, doubted, *_ = truth

    def judged(*wrong: str, without: str = "", doubts: str = "") -> Placements:
        cameras = {
            name: Rigid3.from_center(pose.rotation, pose.center + 20 * (name in wrong))
            for name, pose in truth.items()
            if name != without
        }
        poses = Poses.without_points(cameras, frame="any", scale="any", metric=False)
        return judge_placements(replace(poses, doubts=dict.fromkeys(filter(None, [doubts]), "any")), truth)

    return Corrected(family, seed, judged(gained), judged(lost, without=removed, doubts=doubted), 1.5)


def test_lost_cameras_are_named_and_families_summed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def draw(family: str, seed: int) -> Capture:
        if seed == 2:
            raise ValueError("the place is too small")
        return Capture(family, seed, {}, {}, "")

    monkeypatch.setattr(corrections, "draw", draw)
    monkeypatch.setattr(corrections, "matched", lambda capture, learned: ({}, {}))
    monkeypatch.setattr(corrections, "corrected", lambda capture, *_: one_lost(capture.family, capture.seed))
    notes = measure(["hall", "stairs"], range(1, 4))
    rows = capsys.readouterr().out.splitlines()[2:]
    assert rows == [
        "| hall | 2 | 10 | 8 | 6 | 2 | 2 | 3.0 |",
        "| stairs | 2 | 10 | 8 | 6 | 2 | 2 | 3.0 |",
        "| all | 4 | 20 | 16 | 12 | 4 | 4 | 6.0 |",
    ]
    lost = ", ".join(one_lost("hall", 1).lost)
    assert len(one_lost("hall", 1).lost) == 2
    assert notes[:2] == [f"hall 1 lost {lost}", "hall 2 was not measured: the place is too small"]
    assert len(notes) == 6


def test_a_capture_is_solved_and_corrected() -> None:
    tiny = tiny_capture(Variant(size_hw=(64, 128)))
    names = tiny.names
    pictures = dict(zip(names, tiny.pictures, strict=True))
    capture = Capture("tiny", 0, pictures, dict(zip(names, tiny.poses, strict=True)), "")
    found = corrected(capture, tiny.each(Features), tiny.each(TwoView))
    assert found.before.right.sum() == len(names)
    assert not found.lost
    assert found.cpu_s > 0
