"""All parts of the sphere are alike to an extractor: on a texture that looks alike in all directions."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pano_mvs.algorithms.features.sphorb import extract_sphorb
from pano_mvs.algorithms.features.tangent import extract_orb, extract_sift
from pano_mvs.algorithms.matching.brute_force import match_features
from pano_mvs.geometry import Rigid3, angle_between, pixel_from_ray, rotation_from_rotvec
from pano_mvs.scene import Features
from pano_mvs.testing.room import default_room, render

SIZE = (256, 512)
PIXEL = 2 * np.pi / SIZE[1]
COUNT = 10_000
EXTRACTORS: dict[str, Callable[..., Features]] = {"sift": extract_sift, "orb": extract_orb, "sphorb": extract_sphorb}
# Share of key points found again, share of key points matched rightly, share of right matches, their median error.
LIMITS = {"sift": (0.65, 0.5, 0.99, 0.15), "orb": (0.7, 0.2, 0.93, 0.5), "sphorb": (0.8, 0.35, 0.93, 0.4)}
TURN = (1.2, 0.3, -0.8)


@lru_cache
def turned_view(turn: tuple[float, float, float]) -> NDArray[np.uint8]:
    pose = Rigid3(rotation_from_rotvec(turn), np.zeros(3))
    return render(default_room(texture="isotropic"), pose, SIZE, supersample=2)[0]


@pytest.fixture(scope="module")
def found() -> dict[str, Features]:
    image = turned_view((0.0, 0.0, 0.0))
    return {name: extract(image, np.ones(SIZE, np.bool_), max_keypoints=COUNT) for name, extract in EXTRACTORS.items()}


@pytest.mark.parametrize("name", EXTRACTORS)
def test_density_is_the_same_at_all_latitudes(name: str, found: dict[str, Features]) -> None:
    """Ten bands of equal solid angle; a planar detector on the panorama finds several times more near the poles."""
    counts = np.histogram(found[name].bearings[:, 1], bins=10, range=(-1, 1))[0]
    assert np.abs(counts / counts.mean() - 1).max() < 0.25


@pytest.mark.parametrize("name", EXTRACTORS)
def test_density_is_the_same_across_the_seam(name: str, found: dict[str, Features]) -> None:
    """32 columns on either side of the seam, and narrow bands right at it and at the poles."""
    x = pixel_from_ray(found[name].bearings, SIZE)[:, 0]
    counts = np.histogram((x + 32) % SIZE[1], bins=8, range=(0, SIZE[1]))[0]
    assert counts[0] > 0.75 * counts.mean()
    assert np.abs(counts / counts.mean() - 1).max() < 0.25
    at_seam = np.sum((x < 8) | (x > SIZE[1] - 8))
    assert at_seam > 0.7 * len(x) * 16 / SIZE[1]
    at_poles = np.sum(np.abs(found[name].bearings[:, 1]) > np.cos(0.2))
    assert at_poles > 0.6 * len(x) * (1 - np.cos(0.2))


@pytest.mark.slow
@pytest.mark.parametrize("name", EXTRACTORS)
def test_turning_the_camera_keeps_key_points_and_descriptors(name: str, found: dict[str, Features]) -> None:
    new_from_old = rotation_from_rotvec(TURN)
    first = found[name]
    second = EXTRACTORS[name](turned_view(TURN), np.ones(SIZE, np.bool_), max_keypoints=COUNT)
    again, matched, right, error_px = LIMITS[name]
    strong = first.bearings[: len(first) // 2] @ new_from_old.T
    assert np.mean(cKDTree(second.bearings).query(strong)[0] < PIXEL) > again
    matches = match_features(first, second)
    errors = angle_between(first.bearings[matches[:, 0]] @ new_from_old.T, second.bearings[matches[:, 1]]) / PIXEL
    assert np.mean(errors < 2) > right
    assert np.sum(errors < 2) > matched * len(first)
    assert np.median(errors[errors < 2]) < error_px
