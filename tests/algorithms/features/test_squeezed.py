"""Key points of squeezed tiles lie where the panorama shows them, and describe SIFT key points once more."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.features.squeezed import SQUEEZES, squeezed_keypoints, squeezed_layers
from pano_mvs.algorithms.features.tangent import extract_orb, extract_sift
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3, angle_between, pixel_from_ray, ray_grid
from pano_mvs.scene import Features
from pano_mvs.testing.room import default_room, render

SIZE = (192, 384)
PIXEL_RAD = 2 * np.pi / SIZE[1]
EVERYWHERE = np.ones(SIZE, np.bool_)


def _blobs(count: int = 24) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """Return a panorama with bright spots all around the horizon, up and down, and their bearings (N, 3)."""
    azimuth = np.deg2rad(np.arange(count) * 360 / count + 4)
    elevation = np.deg2rad(np.tile([-24.0, 3.0, 17.0], count // 3))
    cosine = np.cos(elevation)
    bearings = np.stack([cosine * np.sin(azimuth), -np.sin(elevation), cosine * np.cos(azimuth)], axis=-1)
    rays = ray_grid(SIZE)
    distance = np.arccos(np.clip(rays @ bearings.T, -1, 1)).min(axis=-1)
    gray = 40 + 180 * np.exp(-((distance / (3 * PIXEL_RAD)) ** 2))
    return np.repeat(np.rint(gray)[..., None], 3, axis=2).astype(np.uint8), bearings


@pytest.mark.parametrize("squeeze", SQUEEZES)
def test_key_points_of_squeezed_tiles_are_where_the_panorama_shows_them(squeeze: float) -> None:
    image, bearings = _blobs()
    found = squeezed_keypoints(image, EVERYWHERE, squeeze=squeeze)
    np.testing.assert_allclose(np.linalg.norm(found.bearings, axis=1), 1, atol=1e-9)
    apart = angle_between(bearings[:, None], found.bearings[None])
    # SIFT finds a spot in the panorama's own tiles to about a tenth of a pixel.
    assert apart.min(axis=1).max() < 0.3 * PIXEL_RAD
    assert np.median(apart.min(axis=1)) < 0.15 * PIXEL_RAD


def test_tiles_are_not_stretched() -> None:
    with pytest.raises(UsageError, match=r"squeezed by 1 or more, not by 0\.5"):
        squeezed_keypoints(_blobs()[0], EVERYWHERE, squeeze=0.5)


def test_masked_pixels_have_no_key_points() -> None:
    image, _ = _blobs()
    mask = EVERYWHERE.copy()
    mask[:, : SIZE[1] // 2] = False
    found = squeezed_keypoints(image, mask, squeeze=2.0)
    assert len(found.bearings)
    x = pixel_from_ray(found.bearings, SIZE)[:, 0]
    assert (x > SIZE[1] / 2).all()
    assert len(found.bearings) < 0.6 * len(squeezed_keypoints(image, EVERYWHERE, squeeze=2.0).bearings)


@pytest.fixture(scope="module")
def room_image() -> NDArray[np.uint8]:
    return render(default_room(), Rigid3.identity(), SIZE, supersample=1)[0]


@pytest.fixture(scope="module")
def room_features(room_image: NDArray[np.uint8]) -> Features:
    return extract_sift(room_image, EVERYWHERE)


def test_a_layer_has_the_nearest_squeezed_key_point_within_a_pixel(
    room_image: NDArray[np.uint8], room_features: Features
) -> None:
    layers = squeezed_layers(room_features, room_image, EVERYWHERE)
    assert len(layers) == len(SQUEEZES)
    for layer, squeeze in zip(layers, SQUEEZES, strict=True):
        found = squeezed_keypoints(room_image, EVERYWHERE, squeeze=squeeze)
        assert len(layer) > 0.1 * len(room_features)
        apart = angle_between(room_features.bearings[:, None], found.bearings[None])
        # Each squeezed key point belongs to its nearest key point, and each of these takes the nearest one.
        owner = apart.argmin(axis=0)
        taken = np.where(owner[None] == np.arange(len(room_features))[:, None], apart, np.inf)
        expected = np.flatnonzero(taken.min(axis=1) < PIXEL_RAD)
        np.testing.assert_array_equal(layer.keypoint_idx, expected)


def test_unsqueezed_descriptors_resemble_those_of_the_key_points(
    room_image: NDArray[np.uint8], room_features: Features
) -> None:
    layer = squeezed_layers(room_features, room_image, EVERYWHERE)[0]
    own, other = room_features.descriptors[layer.keypoint_idx], layer.descriptors.astype(np.float32)
    same = np.linalg.norm(own - other, axis=1)
    mixed = np.linalg.norm(own - np.roll(other, 1, axis=0), axis=1)
    assert np.median(same) < 0.5 * np.median(mixed)


@pytest.mark.parametrize("root", [True, False])
def test_descriptors_are_of_the_kind_of_the_key_points(room_image: NDArray[np.uint8], root: bool) -> None:
    features = extract_sift(room_image, EVERYWHERE, root=root)
    layer = squeezed_layers(features, room_image, EVERYWHERE)[0]
    own = features.descriptors[layer.keypoint_idx].astype(np.float64)
    # Rooted descriptors are flatter: their largest component is a smaller share of their length.
    flatness = layer.descriptors.max(axis=1).mean() / own.max(axis=1).mean()
    assert 0.95 < flatness < 1.05


def test_other_descriptors_have_no_layers(room_image: NDArray[np.uint8], room_features: Features) -> None:
    orb = extract_orb(room_image, EVERYWHERE)
    assert squeezed_layers(orb, room_image, EVERYWHERE) == ()
    drawn = np.random.default_rng(1).integers(0, 90, room_features.descriptors.shape).astype(np.float32)
    assert squeezed_layers(replace(room_features, descriptors=drawn), room_image, EVERYWHERE) == ()
    nothing = extract_sift(np.full((*SIZE, 3), 90, np.uint8), EVERYWHERE)
    assert squeezed_layers(nothing, room_image, EVERYWHERE) == ()
