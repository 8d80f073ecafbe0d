"""Kept sampling maps and masks of the tangent tiles change nothing but the time that SIFT takes."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.faces.layout import beyond_face_rad, face_centers, tangent_tiles
from pano_mvs.algorithms.faces.sampling import sample_view
from pano_mvs.algorithms.features import tangent
from pano_mvs.algorithms.features.tangent import owned_pixels, sample_tile
from pano_mvs.geometry import Rigid3
from pano_mvs.testing.room import default_room, render

SIZE = (128, 256)


@pytest.fixture(scope="module")
def room_image() -> NDArray[np.uint8]:
    return render(default_room(), Rigid3.identity(), SIZE, supersample=1)[0]


@pytest.mark.parametrize("max_width", [2048, 64], ids=["kept", "too large to keep"])
def test_a_tile_is_sampled_as_any_view(
    monkeypatch: pytest.MonkeyPatch, room_image: NDArray[np.uint8], max_width: int
) -> None:
    monkeypatch.setattr(tangent, "_MAX_WIDTH", max_width)
    grey = np.ascontiguousarray(room_image[..., 1])
    for idx, tile in enumerate(tangent_tiles(SIZE)):
        np.testing.assert_array_equal(sample_tile(grey, idx), sample_view(grey, tile))
        assert owned_pixels(SIZE, idx).shape == tile.size_hw


def test_beyond_a_face_is_where_another_centre_is_nearer() -> None:
    rays = np.random.default_rng(3).normal(size=(2000, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    owner = np.argmax(rays @ face_centers().T, axis=1)
    for idx in range(20):
        np.testing.assert_array_equal(beyond_face_rad(rays, idx) < 0, owner == idx)


def test_the_masks_cover_the_sphere_hardly_twice() -> None:
    """Every direction is in the mask of the tile that owns it, and few are in another one's too."""
    rays = np.random.default_rng(4).normal(size=(4000, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    masked = np.zeros((20, len(rays)), np.bool_)
    for idx, tile in enumerate(tangent_tiles(SIZE)):
        pixels = tile.pixels_from_rays(rays)
        inside = tile.contains(pixels)
        x, y = np.floor(pixels[inside]).astype(int).T
        masked[idx, inside] = owned_pixels(SIZE, idx)[y, x] == 255
    owner = np.argmax(rays @ face_centers().T, axis=1)
    assert masked[owner, np.arange(len(rays))].all()
    assert masked.sum(axis=0).mean() < 1.4


def test_masks_change_no_key_point(monkeypatch: pytest.MonkeyPatch, room_image: NDArray[np.uint8]) -> None:
    """SIFT that describes the whole of every tile keeps the same key points, with the same descriptors."""
    everywhere = np.ones(SIZE, np.bool_)
    found = tangent.extract_sift(room_image, everywhere)
    monkeypatch.setattr(tangent, "owned_pixels", lambda size_hw, idx: None)
    plain = tangent.extract_sift(room_image, everywhere)
    assert len(found) > 200
    np.testing.assert_array_equal(found.bearings, plain.bearings)
    np.testing.assert_array_equal(found.descriptors, plain.descriptors)


def test_a_wide_panorama_has_the_key_points_of_the_reduced_one(room_image: NDArray[np.uint8]) -> None:
    mask = np.ones(SIZE, np.bool_)
    mask[90:, :100] = False
    wide, wide_mask = (np.repeat(np.repeat(array, 2, axis=0), 2, axis=1) for array in (room_image, mask))
    wide_mask[180, 200] = False  # a pixel that is masked in part
    mask[90, 100] = False
    found, reduced = tangent.extract_sift(room_image, mask), tangent.extract_sift(wide, wide_mask, max_width=SIZE[1])
    assert len(found) > 200
    assert reduced.size_hw == wide.shape[:2]
    for name in ("bearings", "descriptors", "sizes_rad", "colors_rgb"):
        np.testing.assert_array_equal(getattr(reduced, name), getattr(found, name))
