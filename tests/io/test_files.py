"""Range maps and confidences come back as they were written, and previews show them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.core.errors import InputError, UsageError
from pano_mvs.geometry import Rigid3
from pano_mvs.io.images.preview import (
    color_mapped,
    mark_unconfirmed,
    range_limits,
    scale_ticks,
    unconfirmed_classes,
    write_preview,
)
from pano_mvs.io.ranges import read_confidence_png, read_range_tiff, write_confidence_png, write_range_tiff
from pano_mvs.testing.room import default_room, render
from tests.stored import read_picture


def range_map() -> NDArray[np.float32]:
    values = np.random.default_rng(0).gamma(2, 2, (24, 48)).astype(np.float32)
    values[values < 1] = np.nan
    values[0, :2] = (1e-30, 3e30)
    return values


def test_a_range_map_keeps_every_bit_and_its_nans(tmp_path: Path) -> None:
    write_range_tiff(tmp_path / "a.tiff", range_map())
    write_range_tiff(tmp_path / "b.tiff", range_map())
    np.testing.assert_array_equal(read_range_tiff(tmp_path / "a.tiff"), range_map())
    assert (tmp_path / "a.tiff").read_bytes() == (tmp_path / "b.tiff").read_bytes()


def test_another_file_is_no_range_map(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"gone\.tiff: cannot be read"):
        read_range_tiff(tmp_path / "gone.tiff")
    cv2.imwrite(str(tmp_path / "grey.tiff"), np.zeros((4, 4), np.uint8))
    (tmp_path / "text.tiff").write_text("hello")
    (tmp_path / "empty.tiff").touch()
    for name in ("grey", "text", "empty"):
        with pytest.raises(InputError, match=rf"{name}\.tiff: a range map is a one-channel float32 TIFF"):
            read_range_tiff(tmp_path / f"{name}.tiff")


def test_a_confidence_map_is_an_8_bit_png(tmp_path: Path) -> None:
    confidence = np.arange(256, dtype=np.uint8).reshape(8, 32)
    write_confidence_png(tmp_path / "a.png", confidence)
    np.testing.assert_array_equal(read_confidence_png(tmp_path / "a.png"), confidence)
    np.testing.assert_array_equal(read_picture(tmp_path / "a.png", cv2.IMREAD_UNCHANGED), confidence)
    with pytest.raises(UsageError, match=r"a confidence map is \(H, W\) uint8"):
        write_confidence_png(tmp_path / "a.png", confidence.astype(float))
    cv2.imwrite(str(tmp_path / "colour.png"), np.zeros((4, 4, 3), np.uint8))
    with pytest.raises(InputError, match=r"colour\.png: a confidence map is an 8-bit grey PNG"):
        read_confidence_png(tmp_path / "colour.png")


def test_a_preview_shows_the_panorama_above_its_range(tmp_path: Path) -> None:
    image, ranges = render(default_room(), Rigid3.identity(), (64, 128))
    ranges[20:30, 40:60] = np.nan
    write_preview(tmp_path / "a.jpg", image, ranges)
    write_preview(tmp_path / "b.jpg", image, ranges)
    assert (tmp_path / "a.jpg").read_bytes() == (tmp_path / "b.jpg").read_bytes()
    shown = read_picture(tmp_path / "a.jpg")
    assert shown.shape[1] == 1280
    assert shown.shape[0] > 1280
    small = cv2.resize(shown[:640], (128, 64), interpolation=cv2.INTER_AREA)[..., ::-1]
    assert np.abs(small.astype(float) - image).mean() < 5
    hole = shown[644 + 210 : 644 + 290, 410:590].astype(float)
    assert np.abs(hole - 128).max() < 12


def test_weak_ranges_are_pale_and_filled_ones_striped() -> None:
    colors = np.full((20, 40, 3), (200, 40, 0), np.uint8)
    confidence = np.full((20, 40), 200, np.uint8)
    confidence[:, 10:20], confidence[:, 20:30], confidence[:, 30:] = 90, 30, 0
    marked = mark_unconfirmed(colors, confidence)
    np.testing.assert_array_equal(marked[:, :10], colors[:, :10])
    np.testing.assert_array_equal(marked[:, 30:], colors[:, 30:])
    assert len(np.unique(marked[:, 10:20].reshape(-1, 3), axis=0)) == 1
    assert (marked[:, 10:20] > colors[:, 10:20]).all()
    assert {tuple(color) for color in marked[:, 20:30].reshape(-1, 3)} == {tuple(marked[0, 10]), (255, 255, 255)}
    assert unconfirmed_classes(confidence) == ["weak", "filled"]


def test_where_views_were_not_compared_nothing_is_pale() -> None:
    colors, confidence = np.zeros((2, 4, 3), np.uint8), np.full((2, 4), 90, np.uint8)
    np.testing.assert_array_equal(mark_unconfirmed(colors, confidence), colors)
    assert unconfirmed_classes(confidence) == []


def test_a_preview_explains_its_marks(tmp_path: Path) -> None:
    image, ranges = render(default_room(), Rigid3.identity(), (64, 128))
    confidence = np.full(ranges.shape, 200, np.uint8)
    write_preview(tmp_path / "sure.jpg", image, ranges, confidence=confidence)
    confidence[:20], confidence[20:30] = 90, 30
    write_preview(tmp_path / "weak.jpg", image, ranges, confidence=confidence)
    sure, weak = read_picture(tmp_path / "sure.jpg"), read_picture(tmp_path / "weak.jpg")
    assert weak.shape[0] > sure.shape[0]
    assert weak[650:840].mean() > sure[650:840].mean() + 40


def test_near_is_red_far_is_blue_and_nothing_is_grey() -> None:
    ranges = np.array([[1.0, 3.0, 9.0, np.nan, 0.1, 100.0]], np.float32)
    near, middle, far, nothing, nearer, farther = color_mapped(ranges, 1.0, 9.0)[0].astype(int)
    assert near[0] > 2 * near[2]
    assert middle[1] == max(middle)
    assert far[2] > 2 * far[1]
    assert nothing.tolist() == [128, 128, 128]
    assert (nearer.tolist(), farther.tolist()) == (near.tolist(), far.tolist())


@pytest.mark.parametrize(
    "ranges", [np.full((2, 4), np.nan), np.full((2, 4), 3.0), np.array([[0.01, 5000.0]]), np.array([[1e-5, 2e-5]])]
)
def test_the_scale_has_round_numbers_for_any_range(tmp_path: Path, ranges: NDArray[Any]) -> None:
    near, far = range_limits(ranges.astype(np.float32))
    ticks = scale_ticks(near, far)
    assert 2 <= len(ticks) <= 10
    assert ticks == sorted(set(ticks))
    assert near <= ticks[0] < ticks[-1] <= far
    write_preview(tmp_path / "a.jpg", np.zeros((2, 4, 3), np.uint8), ranges.astype(np.float32))
