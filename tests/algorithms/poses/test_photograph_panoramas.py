"""Few of the panoramas among which photographs are localised are in memory at a time."""

from __future__ import annotations

import weakref
from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pytest

from pano_mvs.algorithms.poses import photograph_panoramas
from pano_mvs.algorithms.poses.photograph_panoramas import LocatedPanoramas
from pano_mvs.algorithms.poses.photograph_points import KnownPoints, known_points
from pano_mvs.geometry import Rigid3
from pano_mvs.scene import Features, RangeMap

COUNT, HW = 12, (16, 32)
NAMES = [f"{idx:02d}.png" for idx in range(COUNT)]


class Stored(Mapping[str, Features]):
    """Features that are made on each access."""

    def __init__(self, bits: str = "") -> None:
        self.bits = bits
        self.reads: Counter[str] = Counter()

    def __getitem__(self, name: str) -> Features:
        self.reads[name] += 1
        rng = np.random.default_rng(NAMES.index(name))
        rays = rng.normal(size=(40, 3))
        binary = name == self.bits
        values = rng.integers(0, 200, (40, 32 if binary else 128))
        return Features(
            rays / np.linalg.norm(rays, axis=1, keepdims=True),
            values.astype(np.uint8) if binary else values.astype(np.float32),
            np.ones(40, np.float32),
            np.ones(40, np.float32),
            np.zeros((40, 3), np.uint8),
            "hamming" if binary else "l2",
            HW,
        )

    def __contains__(self, name: object) -> bool:
        return name in NAMES

    def __iter__(self) -> Iterator[str]:
        return iter(NAMES)

    def __len__(self) -> int:
        return COUNT


RANGES = {name: RangeMap(np.full(HW, 2.0, np.float32), np.full(HW, 255, np.uint8)) for name in NAMES}


def among(features: Stored, candidates: int) -> LocatedPanoramas:
    poses = dict.fromkeys(NAMES, Rigid3.identity())
    return LocatedPanoramas(poses, features, RANGES, min_confidence=128, candidates=candidates)


def photographs_of(*names: str) -> list[Any]:
    """Return photographs that show what some panoramas show."""
    return [Stored()[name].descriptors for name in names]


@pytest.fixture
def alive(monkeypatch: pytest.MonkeyPatch) -> weakref.WeakSet[Any]:
    """The points of panoramas that are in memory."""
    made: weakref.WeakSet[Any] = weakref.WeakSet()

    class Remembered(KnownPoints):
        """Points that can be referred to weakly."""

    def remembered(*args: Any, **kwargs: Any) -> KnownPoints:
        points = known_points(*args, **kwargs)
        made.add(found := Remembered(points.descriptors, points.points_in_world, points.keypoints_idx))
        return found

    monkeypatch.setattr(photograph_panoramas, "known_points", remembered)
    return made


def test_choosing_reads_each_panorama_once_for_all_photographs_and_keeps_none(alive: weakref.WeakSet[Any]) -> None:
    features = Stored()
    panoramas = among(features, 1)
    shown = [NAMES[7], NAMES[2], NAMES[11]]
    assert panoramas.most_similar(photographs_of(*shown)) == [[name] for name in shown]
    assert features.reads == dict.fromkeys(NAMES, 1)
    assert not alive


def test_twice_the_candidates_stay_in_memory(alive: weakref.WeakSet[Any]) -> None:
    features = Stored()
    panoramas = among(features, 3)
    for start in (0, 1, 5, 8):
        assert list(panoramas.points(NAMES[start : start + 3])) == NAMES[start : start + 3]
        for name in NAMES[start : start + 3]:
            assert panoramas.surface(name) is panoramas.surface(name)
        assert len(alive) <= 6
    assert features.reads[NAMES[1]] == features.reads[NAMES[0]] == 2  # points and surface, not read again
    assert len(alive) == 6


@pytest.mark.parametrize("candidates", [0, COUNT, COUNT + 5])
def test_all_panoramas_are_used_if_there_are_no_more_than_the_candidates(candidates: int) -> None:
    features = Stored()
    panoramas = among(features, candidates)
    assert not panoramas.chooses
    for _ in range(2):
        (names,) = panoramas.most_similar(photographs_of(NAMES[4]))
        assert list(panoramas.points(names)) == names == NAMES
    assert features.reads == dict.fromkeys(NAMES, 1)


@pytest.mark.parametrize("candidates", [0, 3, COUNT - 1])
def test_panoramas_with_other_key_points_are_left_out(candidates: int) -> None:
    panoramas = among(Stored(bits=NAMES[5]), candidates)
    (names,) = panoramas.most_similar(photographs_of(NAMES[4]))
    assert len(names) == (candidates or COUNT - 1)
    assert NAMES[4] in names
    assert NAMES[5] not in names


def test_nothing_is_read_for_no_photographs() -> None:
    features = Stored()
    assert among(features, 3).most_similar([]) == []
    assert not features.reads


def test_no_panorama_can_be_used_without_ranges_or_sift() -> None:
    poses = {NAMES[0]: Rigid3.identity()}
    settings: dict[str, Any] = {"min_confidence": 128, "candidates": 3}
    assert LocatedPanoramas(poses, Stored(), RANGES, **settings)
    assert not LocatedPanoramas(poses, Stored(bits=NAMES[0]), RANGES, **settings)
    assert not LocatedPanoramas(poses, Stored(), {}, **settings)
