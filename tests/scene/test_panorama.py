"""A panorama shows nothing that is masked, and shows a cropped picture where it belongs.

Pictures that were decoded already are neither decoded again, nor mixed up, nor changed by who got them.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from pano_mvs.core.errors import InputError
from pano_mvs.geometry import pixel_from_ray, ray_from_pixel, ray_grid
from pano_mvs.scene import FilePart, Panorama
from pano_mvs.scene import panorama as module
from pano_mvs.scene.image_file import decode_image, write_png
from pano_mvs.scene.masking import Crop
from pano_mvs.scene.panorama import RecentPictures
from pano_mvs.scene.record import Record


def panorama(
    folder: Path,
    picture: NDArray[np.uint8],
    *,
    size_hw: tuple[int, int] | None = None,
    mask: NDArray[np.bool_] | None = None,
    whole_hw: tuple[int, int] | None = None,
    crop_ltwh: tuple[int, int, int, int] | None = None,
    **others: Any,
) -> Panorama:
    write_png(folder / "a.png", picture)
    if mask is not None:
        write_png(folder / "mask.png", mask.astype(np.uint8) * 255)
    source_hw = whole_hw or (picture.shape[0], picture.shape[1])
    mask_file = None if mask is None else FilePart(folder / "mask.png")
    return Panorama(FilePart(folder / "a.png"), size_hw or source_hw, source_hw, crop_ltwh, mask_file, **others)


def noise(seed: int, size_hw: tuple[int, int]) -> NDArray[np.uint8]:
    return np.random.default_rng(seed).integers(0, 256, (*size_hw, 3), np.uint8)


@given(
    seed=st.integers(0, 2**16), half=st.integers(8, 40), working=st.integers(2, 20), scale=st.sampled_from([1, 2, 3, 5])
)
def test_nothing_that_is_masked_is_seen_at_any_resolution(
    tmp_path_factory: pytest.TempPathFactory, seed: int, half: int, working: int, scale: int
) -> None:
    folder, rng = tmp_path_factory.getbasetemp(), np.random.default_rng(seed)
    whole, working_hw = (half, 2 * half), (2 * min(working, half // 2), 4 * min(working, half // 2))
    left, top = int(rng.integers(0, half)), int(rng.integers(0, half // 2))
    crop: Crop | None = (left, top, int(rng.integers(1, 2 * half - left)) + 1, int(rng.integers(1, half - top)) + 1)
    crop = crop if rng.random() < 0.7 else None
    file_hw = (crop[3], crop[2]) if crop else whole
    mask = np.repeat(np.repeat(rng.random(file_hw) < 0.9, scale, 0), scale, 1)
    assume(crop is None or mask.shape != whole)  # which covers the sphere
    picture = noise(seed, file_hw)
    first = panorama(folder, picture, size_hw=working_hw, mask=mask, whole_hw=whole, crop_ltwh=crop, nadir_deg=20.0)
    valid, seen = first.load_mask(), first.load()
    hidden = ~mask[::scale, ::scale]
    picture[hidden] = noise(seed + 1, file_hw)[hidden]
    again = panorama(folder, picture, size_hw=working_hw, mask=mask, whole_hw=whole, crop_ltwh=crop, nadir_deg=20.0)
    np.testing.assert_array_equal(again.load(), seen)
    np.testing.assert_array_equal(again.load_mask(), valid)
    np.testing.assert_array_equal(again.load()[valid], again.load_unmasked()[valid])


def test_cuts_around_the_poles_are_rows(tmp_path: Path) -> None:
    shown = panorama(tmp_path, noise(0, (40, 80)), nadir_deg=45.0, zenith_deg=10.0)
    rows = shown.load_mask().all(axis=1)
    np.testing.assert_array_equal(rows, (np.arange(40) >= 3) & (np.arange(40) < 30))  # 10° are two rows and a bit
    assert panorama(tmp_path, noise(0, (40, 80))).load_mask().all()
    np.testing.assert_array_equal(shown.load_unmasked(), noise(0, (40, 80)))


def test_a_mask_of_a_cropped_picture_covers_the_picture_or_the_sphere(tmp_path: Path) -> None:
    crop = (5, 4, 30, 12)
    inside = np.zeros((20, 40), np.bool_)
    inside[4:16, 5:35] = True
    drawn = np.random.default_rng(0).random((20, 40)) < 0.7
    of_sphere = panorama(tmp_path, noise(0, (12, 30)), whole_hw=(20, 40), crop_ltwh=crop, mask=drawn)
    np.testing.assert_array_equal(of_sphere.load_mask(), drawn & inside)
    twice = drawn[4:16, 5:35].repeat(2, axis=0).repeat(2, axis=1)
    for of_picture in (drawn[4:16, 5:35], twice):
        shown = panorama(tmp_path, noise(0, (12, 30)), whole_hw=(20, 40), crop_ltwh=crop, mask=of_picture)
        np.testing.assert_array_equal(shown.load_mask(), drawn & inside)


@pytest.mark.parametrize(("mask_hw", "columns"), [((20, 40), 14), ((10, 20), 10), ((40, 80), 10)])
def test_a_mask_in_the_shape_of_both_is_the_crops_unless_it_has_the_spheres_size(
    tmp_path: Path, mask_hw: tuple[int, int], columns: int
) -> None:
    drawn = np.ones(mask_hw, np.bool_)
    drawn[:, mask_hw[1] // 2 :] = False
    shown = panorama(tmp_path, noise(0, (10, 20)), whole_hw=(20, 40), crop_ltwh=(6, 4, 20, 10), mask=drawn)
    np.testing.assert_array_equal(shown.load_mask().sum(axis=0), np.where((np.arange(40) - 6) % 40 < columns, 10, 0))


def test_a_mask_of_another_shape_is_refused(tmp_path: Path) -> None:
    shown = panorama(tmp_path, noise(0, (20, 40)), mask=np.ones((20, 30), np.bool_))
    with pytest.raises(InputError, match=r"mask\.png: the mask has 30×20 px, .* \(a\.png, 40×20 px\)\. Draw it over"):
        shown.load()
    crop = panorama(
        tmp_path, noise(0, (10, 14)), whole_hw=(20, 40), crop_ltwh=(3, 3, 14, 10), mask=np.ones((20, 20), np.bool_)
    )
    with pytest.raises(InputError, match=r"20×20 px, .* a part of 14×10 px of 40×20"):
        crop.load_mask()


@pytest.mark.parametrize("crop_ltwh", [None, (3, 3, 14, 10)])
def test_a_picture_that_changed_its_size_since_is_named(
    tmp_path: Path, crop_ltwh: tuple[int, int, int, int] | None
) -> None:
    shown = panorama(tmp_path, noise(0, (20, 41)), whole_hw=(20, 40), crop_ltwh=crop_ltwh)
    with pytest.raises(InputError, match=r"a\.png: 41×20 px, but it had (40×20|14×10) when it was listed"):
        shown.load()


def stored(value: Record) -> Record:
    return type(value).from_parts(value.to_parts())


@pytest.mark.parametrize("crop_ltwh", [None, (5, 4, 30, 12), (6, 4, 20, 10)])
def test_further_masks_add_to_those_that_are_there(tmp_path: Path, crop_ltwh: tuple[int, int, int, int] | None) -> None:
    rng = np.random.default_rng(1)
    file_hw = (crop_ltwh[3], crop_ltwh[2]) if crop_ltwh else (20, 40)
    first = panorama(
        tmp_path,
        noise(0, file_hw),
        mask=rng.random(file_hw) < 0.8,
        size_hw=(10, 20),
        whole_hw=(20, 40),
        crop_ltwh=crop_ltwh,
        nadir_deg=30.0,
    )
    moving, sky = rng.random((10, 20)) < 0.8, np.ones((20, 40), np.bool_)
    sky[:5, 7:9] = False
    (tmp_path / "scratch").mkdir()
    second = first.with_mask(moving, tmp_path / "scratch")
    third = stored(second.with_mask(sky, tmp_path / "scratch"))
    expected = first.load_mask() & moving
    expected[:3, 3:5] = False  # what the sky touches at half the size
    assert isinstance(third, Panorama)
    np.testing.assert_array_equal(third.load_mask(), expected)
    assert sorted(path.name for path in (tmp_path / "scratch").iterdir()) == ["a.mask.png"]
    with pytest.raises(InputError, match="a stage's mask has 7×10 px"):
        first.with_mask(np.ones((10, 7), np.bool_), tmp_path / "scratch")


def spots(rays: NDArray[np.float64], centers: NDArray[np.float64], sigma_rad: float) -> NDArray[np.uint8]:
    """Return a picture of bright spots on the sphere: (..., 3) uint8 along rays (..., 3)."""
    nearest = np.clip((rays @ centers.T).max(axis=-1), -1, 1)
    bright = 250 * np.exp(-0.5 * (np.arccos(nearest) / sigma_rad) ** 2)
    return np.repeat(np.rint(bright).astype(np.uint8)[..., None], 3, axis=-1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("crop_ltwh", "file_hw", "size_hw"),
    [
        (None, (400, 800), (150, 300)),
        ((37, 53, 701, 311), (311, 701), (400, 800)),
        ((37, 53, 701, 311), (311, 701), (150, 300)),
        ((37, 53, 701, 311), (311, 701), (166, 332)),
        ((37, 53, 701, 311), (174, 392), (150, 300)),  # resized after it was taken
        ((37, 53, 701, 311), (174, 392), (222, 444)),
        ((0, 53, 800, 311), (311, 800), (150, 300)),
    ],
)
def test_a_known_ray_is_where_it_belongs_to_a_twentieth_of_a_pixel(
    tmp_path: Path, crop_ltwh: tuple[int, int, int, int] | None, file_hw: tuple[int, int], size_hw: tuple[int, int]
) -> None:
    rng = np.random.default_rng(3)
    wanted = np.stack([rng.uniform(150, 650, 12), rng.uniform(120, 300, 12)], axis=-1)
    centers = ray_from_pixel(wanted, (400, 800))
    left, top, width, height = crop_ltwh or (0, 0, 800, 400)
    over = 2  # samples along a side of a file's pixel
    y, x = np.meshgrid(
        top + (np.arange(over * file_hw[0]) + 0.5) * height / (over * file_hw[0]),
        left + (np.arange(over * file_hw[1]) + 0.5) * width / (over * file_hw[1]),
        indexing="ij",
    )
    fine = spots(ray_from_pixel(np.stack([x, y], axis=-1), (400, 800)), centers, 0.03)
    picture = fine.reshape(file_hw[0], over, file_hw[1], over, 3).mean(axis=(1, 3))
    shown = panorama(
        tmp_path, np.rint(picture).astype(np.uint8), size_hw=size_hw, whole_hw=(400, 800), crop_ltwh=crop_ltwh
    )
    bright = shown.load()[..., 0].astype(np.float64)
    rays = ray_grid(size_hw)
    for center in centers:
        near = (rays @ center > np.cos(0.075)) & (bright > 10)
        if (centers @ center > np.cos(0.2)).sum() > 1:
            continue
        # The pixels' solid angles are all but the same within a spot.
        weights = bright[near] * np.cos(np.arcsin(-rays[near][:, 1]))
        mean = weights @ rays[near]
        miss = pixel_from_ray(mean / np.linalg.norm(mean), size_hw) - pixel_from_ray(center, size_hw)
        assert np.abs(miss).max() < 0.05, (miss, center)


def picture(level: int, rows: int = 4) -> np.ndarray:
    return np.full((rows, 2 * rows, 3), level, np.uint8)


def test_the_least_recently_used_are_dropped() -> None:
    recent = RecentPictures(limit_bytes=4 * picture(0).nbytes)
    for level in range(4):
        recent.put(level, picture(level))
    assert recent.get(0) is not None
    recent.put(4, picture(4))
    assert recent.get(1) is None
    for level in (0, 2, 3, 4):
        kept = recent.get(level)
        assert kept is not None
        np.testing.assert_array_equal(kept, picture(level))


def test_large_pictures_are_not_kept() -> None:
    recent = RecentPictures(limit_bytes=4 * picture(0).nbytes)
    recent.put("small", picture(1))
    recent.put("large", picture(2, 5))
    assert recent.get("large") is None
    assert recent.get("small") is not None


def test_a_panorama_is_decoded_once_until_its_file_changes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_RECENT", RecentPictures(1 << 20))
    decoded: list[Path] = []

    def decode(path: Path, data: bytes, *, max_pixels: int) -> np.ndarray:
        decoded.append(path)
        return decode_image(path, data, max_pixels=max_pixels)

    monkeypatch.setattr(module, "decode_image", decode)
    write_png(tmp_path / "a.png", picture(10, 16))
    panorama = Panorama(FilePart(tmp_path / "a.png"), (16, 32), (16, 32))
    first = panorama.load()
    first[:] = 99
    assert (panorama.load() == 10).all()
    assert (Panorama(FilePart(tmp_path / "a.png"), (8, 16), (16, 32)).load() == 10).all()
    assert len(decoded) == 2  # once for each size
    write_png(tmp_path / "a.png", picture(20, 16))
    assert (panorama.load() == 20).all()
