from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pano_mvs.algorithms.faces.layout import face_centers, tangent_tiles
from pano_mvs.algorithms.faces.sampling import sample_view
from pano_mvs.algorithms.features.selection import distinct_keypoints, spread_keypoints
from pano_mvs.algorithms.features.sphorb import extract_sphorb
from pano_mvs.algorithms.features.tangent import extract_orb, extract_sift
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import (
    Rigid3,
    angle_between,
    pixel_from_ray,
    ray_grid,
    roll_panorama,
    rotate_panorama,
    rotation_from_rotvec,
)
from pano_mvs.scene import Features
from pano_mvs.testing.room import default_room, render

SIZE = (256, 512)
PIXEL = 2 * np.pi / SIZE[1]
EXTRACTORS: dict[str, Callable[..., Features]] = {"sift": extract_sift, "orb": extract_orb, "sphorb": extract_sphorb}


def spread_directions(rng: np.random.Generator, count: int, *, apart: float) -> NDArray[np.float64]:
    """Directions that keep their distance; both poles, the seam, and then any."""
    kept = [np.array(v, float) for v in ((0, 1, 0), (0, -1, 0), (0, 0, -1))]
    for v in rng.normal(size=(count, 3)):
        v /= np.linalg.norm(v)
        if all(v @ other < np.cos(apart) for other in kept):
            kept.append(v)
    return np.array(kept)


def blobs(
    centers: NDArray[np.float64], radii_px: NDArray[np.float64] | Sequence[float], *, size_hw: tuple[int, int] = SIZE
) -> NDArray[np.uint8]:
    rays = ray_grid(size_hw)
    image = np.full(size_hw, 100.0)
    for center, radius_px in zip(centers, radii_px, strict=True):
        image += 110 * np.exp(-(1 - rays @ center) / (radius_px * PIXEL) ** 2)
    return np.repeat(np.rint(image).clip(0, 255).astype(np.uint8)[..., None], 3, axis=2)


@pytest.fixture(scope="module")
def room_image() -> NDArray[np.uint8]:
    return render(default_room(), Rigid3.identity(), SIZE, supersample=1)[0]


@pytest.fixture(scope="module")
def of_room(room_image: NDArray[np.uint8]) -> Callable[..., Features]:
    """What a method finds in the room, by its name and settings; each is computed once."""
    return cache(lambda name, **settings: EXTRACTORS[name](room_image, everywhere(room_image), **settings))


def everywhere(image: NDArray[np.uint8]) -> NDArray[np.bool_]:
    return np.ones(image.shape[:2], np.bool_)


def test_face_centers_are_twenty_and_evenly_spread() -> None:
    centers = face_centers()
    np.testing.assert_allclose(np.linalg.norm(centers, axis=1), 1)
    gram = np.sort(centers @ centers.T, axis=1)
    assert centers.shape == (20, 3)
    np.testing.assert_allclose(gram, np.tile(gram[0], (20, 1)), atol=1e-12)


@pytest.mark.parametrize("size_hw", [(64, 128), (512, 1024)])
def test_every_direction_lies_well_inside_the_tile_that_owns_it(size_hw: tuple[int, int]) -> None:
    rays = np.random.default_rng(0).normal(size=(2000, 3))
    rays = np.concatenate([rays, np.eye(3), -np.eye(3)])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    owner = np.argmax(rays @ face_centers().T, axis=1)
    for idx, tile in enumerate(tangent_tiles(size_hw)):
        in_tile = rays[owner == idx] @ tile.view_from_cam.T
        pixels = in_tile[:, :2] / in_tile[:, 2:] * tile.focal_px + tile.principal_xy
        assert pixels.min() > 20
        assert np.all(np.array(tile.size_hw[::-1]) - pixels > 20)
        np.testing.assert_allclose(tile.bearings_from_pixels(pixels), rays[owner == idx], atol=1e-12)


def test_a_tile_shows_what_lies_in_its_directions() -> None:
    """Of a picture whose brightness is linear in the ray, every tile is that function, at seam and poles too."""
    axis = np.array([0.5, 0.6, -0.62])
    image = np.rint(127 + 120 * (ray_grid(SIZE) @ axis)).astype(np.uint8)
    for tile in tangent_tiles(SIZE):
        rays = tile.rays()
        expected = 127 + 120 * (rays @ axis) / np.linalg.norm(rays, axis=-1)
        assert np.abs(sample_view(image, tile) - expected).max() < 2.0


@pytest.mark.slow
@pytest.mark.parametrize(("name", "bias_px", "rms_px"), [("sift", 0.02, 0.06), ("orb", 0.1, 0.8), ("sphorb", 0.1, 1.0)])
def test_key_points_have_no_bias(name: str, bias_px: float, rms_px: float) -> None:
    """A quarter of a pixel is what SIFT without the precise upscale, or ORB without its half pixel, would show."""
    rng = np.random.default_rng(1)
    centers = spread_directions(rng, 600, apart=16 * PIXEL)
    image = blobs(centers, rng.uniform(1.4, 2.6, size=len(centers)))
    found = EXTRACTORS[name](image, everywhere(image), max_keypoints=20_000)
    nearest = np.argmax(found.bearings @ centers.T, axis=1)
    near = angle_between(found.bearings, centers[nearest]) < 2 * PIXEL
    true, offset = centers[nearest[near]], (found.bearings[near] - centers[nearest[near]]) / PIXEL
    assert len(np.unique(nearest[near])) > 0.8 * len(centers)
    assert np.sqrt(np.mean(np.sum(offset**2, axis=1))) < rms_px
    away = np.abs(true[:, 1]) < 0.95
    east = np.cross([0.0, 1.0, 0.0], true[away])
    east /= np.linalg.norm(east, axis=1, keepdims=True)
    north = np.cross(true[away], east)
    for direction in (east, north):
        assert abs(np.mean(np.sum(offset[away] * direction, axis=1))) < bias_px
    # A shift on the tiles points elsewhere on each of them and would cancel on the panorama.
    tile_from_cam = np.array([tile.view_from_cam for tile in tangent_tiles(SIZE)])
    owner = np.argmax(true @ face_centers().T, axis=1)
    assert np.abs(np.mean(np.einsum("nij,nj->ni", tile_from_cam[owner], offset), axis=0)[:2]).max() < bias_px


@pytest.mark.slow
@pytest.mark.parametrize("name", EXTRACTORS)
def test_poles_and_seam_are_places_like_any_other(name: str) -> None:
    """The poles lie on the common edge of two tiles, which must not leave a key point to each other."""
    places = np.array([[0.0, 1, 0], [0, -1, 0], [0, 0, -1], [-1e-9, -0.4, -1]])
    places /= np.linalg.norm(places, axis=1, keepdims=True)
    found = []
    for radius_px in (1.5, 1.8, 2.2, 2.7, 3.2):
        image = blobs(places, [radius_px] * len(places))
        bearings = EXTRACTORS[name](image, everywhere(image)).bearings
        found.append(angle_between(places[:, None], bearings).min(axis=1) < 1.5 * PIXEL)
    assert np.all(np.sum(found, axis=0) >= 3)


@pytest.mark.slow
@pytest.mark.parametrize("name", EXTRACTORS)
def test_record_is_sound_sorted_and_the_same_again(
    name: str, room_image: NDArray[np.uint8], of_room: Callable[..., Features]
) -> None:
    first = of_room(name)
    again = EXTRACTORS[name](room_image, everywhere(room_image))
    first.check()
    assert len(first) > 500
    assert np.all(np.diff(first.scores) <= 0)
    assert np.all(first.sizes_rad > 0)
    assert first.descriptors.tobytes() == again.descriptors.tobytes()
    assert first.bearings.tobytes() == again.bearings.tobytes()
    x, y = np.floor(pixel_from_ray(first.bearings, SIZE)).astype(int).T
    np.testing.assert_array_equal(first.colors_rgb, room_image[y.clip(0, 255), x % 512])


@pytest.mark.parametrize("name", EXTRACTORS)
def test_no_two_key_points_at_one_place(name: str, of_room: Callable[..., Features]) -> None:
    assert not cKDTree(of_room(name).bearings).query_pairs(0.49 * PIXEL)


def test_sift_descriptors_are_whole_numbers_of_one_length(of_room: Callable[..., Features]) -> None:
    found = of_room("sift")
    np.testing.assert_array_equal(found.descriptors, np.rint(found.descriptors))
    np.testing.assert_allclose(np.linalg.norm(found.descriptors, axis=1), 512, rtol=0.01)
    plain = of_room("sift", root=False)
    np.testing.assert_array_equal(found.bearings, plain.bearings)
    assert not np.array_equal(found.descriptors, plain.descriptors)


def repeated_share(found: Features, other: Features, new_from_old: NDArray[np.float64]) -> float:
    strong = found.bearings[: len(found) // 2] @ new_from_old.T
    return float(np.mean(cKDTree(other.bearings).query(strong)[0] < 1.0 * PIXEL))


@pytest.mark.slow
@pytest.mark.parametrize("name", EXTRACTORS)
def test_rolling_the_picture_rolls_the_key_points(
    name: str, room_image: NDArray[np.uint8], of_room: Callable[..., Features]
) -> None:
    rolled, new_from_old = roll_panorama(room_image, 201)
    other = EXTRACTORS[name](rolled, everywhere(rolled), max_keypoints=20_000)
    assert repeated_share(of_room(name, max_keypoints=20_000), other, new_from_old) > 0.7


def test_turning_the_camera_turns_the_key_points(
    room_image: NDArray[np.uint8], of_room: Callable[..., Features]
) -> None:
    new_from_old = rotation_from_rotvec([1.2, 0.3, -0.8])
    turned = rotate_panorama(room_image, new_from_old)
    other = extract_sift(turned, everywhere(turned), max_keypoints=20_000)
    assert repeated_share(of_room("sift", max_keypoints=20_000), other, new_from_old) > 0.7


@pytest.mark.slow
@pytest.mark.parametrize("name", EXTRACTORS)
def test_masked_pixels_and_their_border_have_no_key_points(name: str, room_image: NDArray[np.uint8]) -> None:
    rows = np.arange(SIZE[0])[:, None]
    columns = np.arange(SIZE[1])[None]
    mask = (rows < 200) & ~((columns > 100) & (columns < 180) & (rows > 90) & (rows < 150))
    blacked = np.where(mask[..., None], room_image, 0).astype(np.uint8)
    found = EXTRACTORS[name](blacked, mask, max_keypoints=20_000)
    x, y = pixel_from_ray(found.bearings, SIZE).T
    assert len(found) > 200
    assert np.all(mask[np.floor(y).astype(int).clip(0, 255), np.floor(x).astype(int) % 512])
    assert y.max() < 198
    everything = np.zeros(SIZE, np.bool_)
    assert len(EXTRACTORS[name](room_image, everything)) == 0


def test_the_edge_of_a_mask_makes_no_key_points() -> None:
    """A plain picture, half of it cut away: what the cut looks like is nobody's business."""
    image = np.full((*SIZE, 3), 180, np.uint8)
    mask = np.ones(SIZE, np.bool_)
    mask[140:, 60:300] = False
    image[~mask] = 0
    for extract in EXTRACTORS.values():
        assert len(extract(image, mask)) == 0


def test_a_plain_picture_has_none() -> None:
    for extract in EXTRACTORS.values():
        found = extract(np.full((*SIZE, 3), 90, np.uint8), np.ones(SIZE, np.bool_))
        found.check()
        assert len(found) == 0


def test_few_key_points_are_spread_evenly(of_room: Callable[..., Features]) -> None:
    found = of_room("sift", max_keypoints=300)
    assert len(found) == 300
    counts = np.bincount(np.argmax(found.bearings @ face_centers().T, axis=1), minlength=20)
    everything = of_room("sift", max_keypoints=20_000)
    available = np.bincount(np.argmax(everything.bearings @ face_centers().T, axis=1), minlength=20)
    assert np.all(counts >= np.minimum(available, 5))
    assert np.all(np.diff(found.scores) <= 0)


def test_distinct_keypoints_keep_the_strongest_of_each_crowd() -> None:
    bearings = np.array([[0, 0, 1.0], [0.001, 0, 1.0], [0.002, 0, 1.0], [1.0, 0, 0]])
    bearings /= np.linalg.norm(bearings, axis=1, keepdims=True)
    # The middle one is suppressed by the first; so it may not suppress the third.
    kept = distinct_keypoints(bearings, np.array([3, 2, 1, 0], np.float32), radius_rad=0.0015)
    assert kept.tolist() == [0, 2, 3]
    assert distinct_keypoints(np.zeros((0, 3)), np.zeros(0, np.float32), radius_rad=0.1).size == 0


def test_spread_keypoints_take_the_best_of_every_cell_first() -> None:
    rng = np.random.default_rng(2)
    bearings = np.concatenate([[0, 0, 1] + 0.05 * rng.normal(size=(500, 3)), rng.normal(size=(100, 3))])
    bearings /= np.linalg.norm(bearings, axis=1, keepdims=True)
    scores = np.concatenate([10 + rng.random(500), rng.random(100)]).astype(np.float32)
    kept = spread_keypoints(bearings, scores, max_keypoints=200)
    assert np.sum(kept >= 500) > 80
    assert np.argmax(scores) in kept
    np.testing.assert_array_equal(spread_keypoints(bearings, scores, max_keypoints=600), np.argsort(-scores))


def test_refuses_a_mask_of_another_size() -> None:
    with pytest.raises(UsageError, match="mask"):
        extract_sift(np.zeros((*SIZE, 3), np.uint8), np.ones((4, 8), np.bool_))
