"""Photographs among panoramas: candidates, the panoramas they match, and patches that refine them."""

from __future__ import annotations

import weakref
from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from pano_mvs_photographs import panoramas as photograph_panoramas
from pano_mvs_photographs.alignment import (
    MIN_SIDE_PX,
    PanoramaPatches,
    PhotographPatches,
    panorama_levels,
    photograph_levels,
    sight_points,
)
from pano_mvs_photographs.camera import (
    FocalPrior,
    PhotographCamera,
    Sightings,
    optical_center_offset,
    refine_by_sightings,
)
from pano_mvs_photographs.panoramas import (
    KnownPoints,
    LocatedPanoramas,
    SurfacePoints,
    known_points,
    surface_points,
)
from pano_mvs_photographs.panoramas import similar_panoramas as similar_to_each

from pano_mvs.algorithms.features.tangent import extract_sift
from pano_mvs.algorithms.matching.brute_force import match_l2
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3, geodesic_angle, rotation_from_rotvec
from pano_mvs.scene import Features, RangeMap
from pano_mvs.testing.room import default_room, range_along, render
from tests.synthetic.photograph import render_photograph

Descriptors = NDArray[np.float32]


@pytest.fixture
def panoramas() -> dict[str, Descriptors]:
    """Eight panoramas in pairs: two share the key points of a place, up to noise."""
    rng = np.random.default_rng(4)
    places = [rng.integers(0, 200, (60, 128)) for _ in range(4)]
    return {
        f"{place}{copy}": np.asarray(points + rng.integers(-3, 4, points.shape) + 3, np.float32)
        for copy in "ab"
        for place, points in enumerate(places)
    }


def photograph_of(panoramas: Mapping[str, Descriptors], name: str, count: int = 25) -> Descriptors:
    return panoramas[name][5 : 5 + count] + 1


def similar_panoramas(photograph: Descriptors, panoramas: Mapping[str, Descriptors], *, count: int) -> list[str]:
    (found,) = similar_to_each([photograph], panoramas.items(), count=count)
    return found


@pytest.mark.parametrize("place", range(4))
def test_the_panoramas_of_the_place_are_chosen(panoramas: dict[str, Descriptors], place: int) -> None:
    assert similar_panoramas(photograph_of(panoramas, f"{place}b"), panoramas, count=2) == [f"{place}a", f"{place}b"]


def test_the_order_of_the_capture_is_kept(panoramas: dict[str, Descriptors]) -> None:
    backwards = dict(reversed(panoramas.items()))
    assert similar_panoramas(photograph_of(panoramas, "1a"), backwards, count=2) == ["1b", "1a"]


@pytest.mark.parametrize("count", [0, 8, 20])
def test_small_captures_are_used_completely(panoramas: dict[str, Descriptors], count: int) -> None:
    assert similar_panoramas(photograph_of(panoramas, "1a"), panoramas, count=count) == list(panoramas)


def test_the_strongest_key_points_decide(panoramas: dict[str, Descriptors]) -> None:
    """Key points beyond the sample are not compared."""
    noise = np.asarray(np.random.default_rng(7).integers(0, 200, (300, 128)), np.float32)
    hidden = np.concatenate([photograph_of(panoramas, "2a", 4), noise[4:], photograph_of(panoramas, "1a", 50)])
    assert similar_panoramas(hidden, panoramas, count=2) == ["2a", "2b"]


def test_without_key_points_the_first_are_taken(panoramas: dict[str, Descriptors]) -> None:
    assert similar_panoramas(np.zeros((0, 128), np.float32), panoramas, count=2) == list(panoramas)[:2]
    bare = {name: np.zeros((0, 128), np.float32) for name in panoramas} | {"3b": panoramas["3b"]}
    assert similar_panoramas(photograph_of(panoramas, "3b"), bare, count=1) == ["3b"]


def test_photographs_are_compared_together_in_one_pass(panoramas: dict[str, Descriptors]) -> None:
    photographs = [photograph_of(panoramas, f"{place}a") for place in (2, 0, 3)]
    found = similar_to_each(photographs, iter(panoramas.items()), count=2)
    assert found == [similar_panoramas(photograph, panoramas, count=2) for photograph in photographs]
    assert found == [["2a", "2b"], ["0a", "0b"], ["3a", "3b"]]


def test_descriptors_with_fractions_are_compared_too(panoramas: dict[str, Descriptors]) -> None:
    fractions = {name: known / np.float32(512) for name, known in panoramas.items()}
    assert similar_panoramas(photograph_of(panoramas, "1a") / np.float32(512), fractions, count=2) == ["1a", "1b"]


def test_the_count_is_that_of_brute_force_matching(panoramas: dict[str, Descriptors]) -> None:
    """Matches are counted one to one, also where several key points have the same nearest neighbour."""
    rng = np.random.default_rng(11)
    copies = np.concatenate([photograph_of(panoramas, "2a", 30)] * 3)
    photograph = copies + np.asarray(rng.integers(0, 3, copies.shape), np.float32)
    expected = {name: len(match_l2(photograph, known, ratio=0.8)) for name, known in panoramas.items()}
    for count in range(1, 8):
        best = sorted(panoramas, key=lambda name: -expected[name])[:count]
        assert similar_panoramas(photograph, panoramas, count=count) == [name for name in panoramas if name in best]


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


SIZE_HW, PHOTO_HW, FOCAL_PX = (256, 512), (240, 320), 260.0
POSE = Rigid3.from_center(rotation_from_rotvec(np.array([0.1, 0.6, -0.1])), np.array([0.2, 0.1, 0.1]))
TRUE = PhotographCamera(POSE, FOCAL_PX, -0.03)

Given = tuple[SurfacePoints, NDArray[np.uint8], NDArray[np.uint8]]


@pytest.fixture(scope="module")
def given() -> Given:
    """Points of a panorama, the panorama, and a photograph."""
    panorama, ranges = render(default_room(), Rigid3.identity(), SIZE_HW, supersample=1)
    features = extract_sift(panorama, np.ones(SIZE_HW, np.bool_))
    range_map = RangeMap(ranges.astype(np.float32), np.full(SIZE_HW, 255, np.uint8))
    photograph = render_photograph(default_room(), POSE, PHOTO_HW, focal_px=FOCAL_PX, radial=-0.03, supersample=1)
    return surface_points(features, Rigid3.identity(), range_map, min_confidence=128), panorama, photograph


def sightings(given: Given, camera: PhotographCamera) -> Sightings:
    surface, panorama, photograph = given
    levels = photograph_levels(cv2.cvtColor(photograph, cv2.COLOR_RGB2GRAY))
    return sight_points(surface, panorama_levels(panorama, 1)[0], levels, camera=camera, size_hw=PHOTO_HW)


def test_surface_points_are_on_the_surfaces(given: Given) -> None:
    surface = given[0]
    true = range_along(default_room(), np.zeros(3), surface.bearings)
    assert len(true) > 200
    assert np.median(np.abs(surface.ranges / true - 1)) < 1e-3
    assert np.quantile(np.abs(surface.ranges / true - 1), 0.95) < 0.01
    assert ((surface.normals_in_cam * surface.bearings).sum(axis=1) < 0).all()


def test_patches_are_seen_where_the_camera_projects_them(given: Given) -> None:
    """A pixel of the panorama is three pixels of the photograph wide."""
    seen = sightings(given, TRUE)
    assert 0.7 * seen.tested < len(seen.pixels_px) > 40
    away = np.linalg.norm(seen.pixels_px - TRUE.project(seen.points_in_world, PHOTO_HW)[0], axis=1)
    assert np.median(away) < 0.8
    assert 0.1 < np.median(np.linalg.norm(seen.errors(TRUE, PHOTO_HW), axis=1)) < 2.0


def test_a_camera_is_recovered_from_sightings(given: Given) -> None:
    seen = sightings(given, TRUE)
    exact = Sightings(
        TRUE.project(seen.points_in_world, PHOTO_HW)[0], seen.points_in_world, seen.whitening, seen.tested
    )
    turn = rotation_from_rotvec(np.radians([0.4, -0.3, 0.2]))
    start = PhotographCamera(Rigid3.from_center(turn @ POSE.rotation, POSE.center + 0.03), 1.02 * FOCAL_PX, 0.0)
    found = refine_by_sightings(start, exact, size_hw=PHOTO_HW, prior=FocalPrior(FOCAL_PX, 0.5))
    found = refine_by_sightings(found, exact, size_hw=PHOTO_HW, prior=FocalPrior(FOCAL_PX, 0.5))
    assert np.degrees(geodesic_angle(found.cam_from_world.rotation, POSE.rotation)) < 0.1
    assert np.linalg.norm(found.cam_from_world.center - POSE.center) < 0.015
    assert found.focal_px == pytest.approx(FOCAL_PX, rel=0.01)


@pytest.mark.parametrize(("shape_hw", "levels"), [((21, 640), 0), ((22, 640), 1), ((240, 320), 4)])
def test_no_level_is_smaller_than_a_patch(shape_hw: tuple[int, int], levels: int) -> None:
    found = photograph_levels(np.zeros(shape_hw, np.uint8))
    assert [min(level.shape) >= MIN_SIDE_PX for level in found] == [True] * levels


@pytest.mark.parametrize(("shape_hw", "too_narrow"), [((21, 640), True), ((640, 22), False), ((100, 12000), True)])
def test_a_strip_cannot_be_aligned(given: Given, shape_hw: tuple[int, int], too_narrow: bool) -> None:
    strip = PhotographPatches(
        np.zeros((*shape_hw, 3), np.uint8), PanoramaPatches(lambda _: given[0], lambda _: given[1])
    )
    assert strip.too_narrow is too_narrow
    if too_narrow:
        with pytest.raises(UsageError, match="smaller than a patch"):
            strip.aligned(TRUE, ["a"], prior=FocalPrior(FOCAL_PX, 0.1))


@pytest.mark.parametrize(("offset", "std"), [((0.0, 0.0), 0.3), ((0.05, -0.03), 0.3), ((0.004, 0.0), 3.0)])
def test_the_optical_centre_is_found(given: Given, offset: tuple[float, float], std: float) -> None:
    """Sightings with known errors: as far from the middle as they were moved, within the deviations that it states."""
    seen = sightings(given, TRUE)
    noise = np.random.default_rng(3).normal(0, std, seen.pixels_px.shape)
    pixels = TRUE.project(seen.points_in_world, PHOTO_HW)[0] + 320 * np.array(offset) + noise
    moved = Sightings(pixels, seen.points_in_world, np.broadcast_to(np.eye(2) / std, seen.whitening.shape), seen.tested)
    found, stds = optical_center_offset(TRUE, moved, size_hw=PHOTO_HW, prior=FocalPrior(FOCAL_PX, 0.1))
    assert (np.abs(found - offset) < 4 * stds).all(), (found, stds)
    assert (stds < 0.003 * std / 0.3).all()


@pytest.mark.parametrize("left", [0, 32])
def test_alignment_tells_whether_a_photograph_was_cropped(given: Given, left: int) -> None:
    surface, panorama, photograph = given
    cropped = np.ascontiguousarray(photograph[:, left:])
    patches = PhotographPatches(cropped, PanoramaPatches(lambda _: surface, lambda _: panorama))
    turn = rotation_from_rotvec(np.array([0.0, -np.arctan(left / 2 / FOCAL_PX), 0.0]))
    start = PhotographCamera(Rigid3.from_center(turn @ POSE.rotation, POSE.center), FOCAL_PX, 0.0)
    aligned = patches.aligned(start, ["a"], prior=FocalPrior(FOCAL_PX, 0.1))
    assert aligned.confirmed > 40
    assert aligned.off_center == pytest.approx(left / 2 / (320 - left), abs=0.02)


def test_alignment_improves_a_camera_and_confirms_it(given: Given) -> None:
    surface, panorama, photograph = given
    patches = PhotographPatches(photograph, PanoramaPatches(lambda _: surface, lambda _: panorama))
    turn = rotation_from_rotvec(np.radians([0.5, -0.4, 0.3]))
    start = PhotographCamera(Rigid3.from_center(turn @ POSE.rotation, POSE.center + 0.03), 1.01 * FOCAL_PX, 0.0)
    aligned = patches.aligned(start, ["a"], prior=FocalPrior(FOCAL_PX, 0.1))
    assert np.degrees(geodesic_angle(aligned.camera.cam_from_world.rotation, POSE.rotation)) < 0.2
    assert np.linalg.norm(aligned.camera.cam_from_world.center - POSE.center) < 0.02
    assert aligned.share > 0.5
    away = rotation_from_rotvec(np.array([0.0, 0.8, 0.0]))
    wrong = patches.aligned(
        PhotographCamera(Rigid3.from_center(away @ POSE.rotation, POSE.center), FOCAL_PX, 0.0),
        ["a"],
        prior=FocalPrior(FOCAL_PX, 0.1),
    )
    assert wrong.share < 0.15
