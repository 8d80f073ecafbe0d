"""Masks: every way in which people store them, brought to size without losing a line, and painted over."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from pano_mvs.core.errors import InputError
from pano_mvs.scene.masking import decode_mask, painted_over, placed_mask
from tests.io.images.pictures import png_chunk
from tests.stored import read_picture

VALID = np.array([[True, True, False, True], [False, True, True, True]])


def written(path: Path, picture: NDArray[np.generic], *options: int) -> Path:
    assert cv2.imwrite(str(path), picture, options)
    return path


def palette_png(index: NDArray[np.uint8], colors_rgb: bytes) -> bytes:
    height, width = index.shape
    rows = b"".join(b"\0" + row.tobytes() for row in index)
    header = struct.pack(">IIBBBBB", width, height, 8, 3, 0, 0, 0)
    parts = [(b"IHDR", header), (b"PLTE", colors_rgb), (b"IDAT", zlib.compress(rows)), (b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(png_chunk(*part) for part in parts)


def test_grey_masks_of_any_depth(tmp_path: Path) -> None:
    for dtype, least in ((np.uint8, 1), (np.uint16, 1)):
        path = written(tmp_path / "mask.png", np.where(VALID, least, 0).astype(dtype))
        np.testing.assert_array_equal(decode_mask(path), VALID)
    path = written(tmp_path / "mask.tiff", np.where(VALID, np.float32(0.001), np.float32(0)))
    np.testing.assert_array_equal(decode_mask(path), VALID)
    path = written(tmp_path / "two.png", np.where(VALID, 255, 0).astype(np.uint8), cv2.IMWRITE_PNG_BILEVEL, 1)
    np.testing.assert_array_equal(decode_mask(path), VALID)


def test_colours_count_where_any_is_not_black(tmp_path: Path) -> None:
    picture = np.zeros((2, 4, 3), np.uint8)
    picture[VALID, 0] = 7
    np.testing.assert_array_equal(decode_mask(written(tmp_path / "mask.png", picture)), VALID)


def test_a_palette_counts_by_its_colours(tmp_path: Path) -> None:
    path = tmp_path / "mask.png"
    path.write_bytes(palette_png(np.where(VALID, np.uint8(0), np.uint8(1)), b"\x80\x00\x00" + b"\x00\x00\x00"))
    np.testing.assert_array_equal(decode_mask(path), VALID)


def test_what_is_transparent_is_ignored(tmp_path: Path) -> None:
    picture = np.full((2, 4, 4), 255, np.uint8)
    picture[..., 3] = np.where(VALID, 9, 0)
    np.testing.assert_array_equal(decode_mask(written(tmp_path / "mask.png", picture)), VALID)
    picture[0, 0, :3] = 0
    assert not decode_mask(written(tmp_path / "mask.png", picture))[0, 0]
    picture[..., :3] = 0
    np.testing.assert_array_equal(decode_mask(written(tmp_path / "mask.png", picture)), VALID)
    opaque = np.full((2, 4, 4), 255, np.uint8)
    opaque[~VALID, :3] = 0
    np.testing.assert_array_equal(decode_mask(written(tmp_path / "mask.png", opaque)), VALID)


def test_the_blacks_of_a_jpeg_are_black(tmp_path: Path) -> None:
    drawn = np.full((32, 64), 255, np.uint8)
    drawn[5:19, 7:33] = 0
    path = written(tmp_path / "mask.jpg", drawn, cv2.IMWRITE_JPEG_QUALITY, 60)
    stored = read_picture(path, cv2.IMREAD_GRAYSCALE)
    assert stored[6:18, 8:32].max() > 0  # or the test shows nothing
    np.testing.assert_array_equal(decode_mask(path), drawn > 0)


def test_a_mask_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"gone\.png: cannot be read .* Check"):
        decode_mask(tmp_path / "gone.png")
    for data in (b"", b"no picture"):
        (tmp_path / "bad.png").write_bytes(data)
        with pytest.raises(InputError, match=r"bad\.png: the mask is not an image .* Save it as PNG"):
            decode_mask(tmp_path / "bad.png")


sizes = st.integers(1, 40)


@given(seed=st.integers(0, 2**16), source=st.tuples(sizes, sizes), wanted=st.tuples(sizes, sizes), crop=st.booleans())
def test_a_pixel_is_valid_if_all_that_it_touches_is(
    seed: int, source: tuple[int, int], wanted: tuple[int, int], crop: bool
) -> None:
    rng = np.random.default_rng(seed)
    mask = rng.random(source) < 0.8
    whole = source if not crop else (source[0] + 11, source[1] + 7)
    left, top = (int(rng.integers(0, whole[1] - source[1] + 1)), int(rng.integers(0, whole[0] - source[0] + 1)))
    placed = placed_mask(mask, wanted, of=(left, top, source[1], source[0]), whole_hw=whole)
    whole_mask = np.ones(whole, np.bool_)
    whole_mask[top : top + source[0], left : left + source[1]] = mask
    for row in range(wanted[0]):
        for column in range(wanted[1]):
            rows = slice(row * whole[0] // wanted[0], -(-(row + 1) * whole[0] // wanted[0]))
            columns = slice(column * whole[1] // wanted[1], -(-(column + 1) * whole[1] // wanted[1]))
            assert placed[row, column] == whole_mask[rows, columns].all()


@pytest.mark.parametrize("width", [17, 30, 64, 100, 250])
def test_a_line_of_one_pixel_cuts_a_mask_in_two_at_any_size(width: int) -> None:
    mask = np.ones((100, 200), np.bool_)
    mask[61] = mask[:, 77] = False
    placed = placed_mask(mask, (width // 2, width), of=(0, 0, 200, 100), whole_hw=(100, 200))
    assert not placed[61 * (width // 2) // 100].any()
    assert not placed[:, 77 * width // 200].any()
    assert placed.any()


def drawn(seed: int, size_hw: tuple[int, int] = (32, 64)) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    rng = np.random.default_rng(seed)
    valid = np.ones(size_hw, np.bool_)
    for _ in range(int(rng.integers(1, 5))):
        top, left = rng.integers(0, size_hw[0]), rng.integers(0, size_hw[1])
        valid[top : top + rng.integers(1, 20)][:, (left + np.arange(rng.integers(1, 30))) % size_hw[1]] = False
    return rng.integers(0, 256, (*size_hw, 3), np.uint8), valid


@given(seed=st.integers(0, 2**16), shift=st.integers(-64, 64))
def test_paint_knows_nothing_of_what_it_covers_and_rolls_with_the_picture(seed: int, shift: int) -> None:
    picture, valid = drawn(seed)
    painted = painted_over(picture, valid)
    np.testing.assert_array_equal(painted[valid], picture[valid])
    noise = np.random.default_rng(seed + 1).integers(0, 256, picture.shape, np.uint8)
    np.testing.assert_array_equal(painted_over(np.where(valid[..., None], picture, noise), valid), painted)
    rolled = painted_over(np.roll(picture, shift, axis=1), np.roll(valid, shift, axis=1))
    np.testing.assert_array_equal(rolled, np.roll(painted, shift, axis=1))


def test_paint_is_the_colour_around() -> None:
    picture = np.zeros((64, 128, 3), np.uint8)
    picture[:, 32:96] = 200
    valid = np.ones((64, 128), np.bool_)
    valid[20:30, 50:70] = valid[-12:] = valid[10:20, :4] = valid[10:20, -4:] = False
    painted = painted_over(np.where(valid[..., None], picture, np.uint8(77)), valid)
    away = np.ones(128, np.bool_)  # from the edge between the two colours
    away[16:48] = away[80:112] = False
    np.testing.assert_array_equal(painted[:58, away], picture[:58, away])  # below, both sides of the pole are near


def test_paint_where_little_or_nothing_is_valid() -> None:
    picture, valid = np.full((256, 512, 3), 9, np.uint8), np.zeros((256, 512), np.bool_)
    assert (painted_over(picture, valid) == 128).all()
    valid[0, 0] = True
    assert (painted_over(picture, valid) == 9).all()
