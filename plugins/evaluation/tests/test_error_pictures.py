"""Pictures and clouds of errors: what colour says what."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from pano_mvs_evaluation.clouds.pictures import _top_view, _write_pictures, distance_colors, write_error_cloud
from pano_mvs_evaluation.drawing import WIDTH
from pano_mvs_evaluation.ranges.error_picture import error_colored, signed_error, write_error_picture

from pano_mvs.core.errors import UsageError
from pano_mvs.io.ply import open_ply_points
from tests.stored import read_picture

GREY, BLACK = (128, 128, 128), (25, 25, 25)


def test_hue_tells_the_sign_and_lightness_the_size() -> None:
    errors = np.array([-1.0, -0.1, -0.05, 0.0, 0.05, 0.1, 1.0])
    colors = error_colored(errors, 0.1).astype(int)
    np.testing.assert_array_equal(colors[0], colors[1])
    np.testing.assert_array_equal(colors[5], colors[6])
    assert (colors[:3, 2] > colors[:3, 0]).all()  # too near: blue
    assert (colors[4:, 0] > colors[4:, 2]).all()  # too far: red
    lightness = colors.sum(axis=1)
    assert (np.diff(lightness[1:4]) > 0).all()
    assert (np.diff(lightness[3:6]) < 0).all()


def test_missing_is_black_and_what_does_not_count_is_grey() -> None:
    truth = np.array([[2.0, 2.0, np.nan]])
    error = signed_error(np.array([[2.2, np.nan, 1.0]]), truth)
    np.testing.assert_allclose(error, [[0.1, np.nan, np.nan]])
    colors = error_colored(error, 0.1, counted=np.isfinite(truth))
    assert [tuple(color) for color in colors[0, 1:]] == [BLACK, GREY]


@pytest.mark.parametrize("size", [pytest.param((8, 16), marks=pytest.mark.slow), (600, 1200)])
def test_the_picture_holds_four_panels_of_any_size_with_the_seam_and_the_poles(
    tmp_path: Path, size: tuple[int, int]
) -> None:
    truth = np.full(size, 2.0, np.float32)
    estimated = truth.copy()
    estimated[:, : size[1] // 2] *= 1.5
    estimated[-size[0] // 4 :] = np.nan
    image = np.full((10, 20, 3), (200, 30, 30), np.uint8)
    path = tmp_path / "new" / "a.jpg"
    write_error_picture(path, estimated, truth, image=image)
    picture = cv2.cvtColor(read_picture(path), cv2.COLOR_BGR2RGB).astype(int)
    assert picture.shape == (1200, 2 * 1024, 3)

    def share(color: tuple[int, int, int], part: NDArray[np.int_]) -> float:
        return float((np.abs(part - color).max(axis=-1) < 9).mean())  # of JPEG; the paper is lighter

    left, right = np.split(picture[: len(picture) // 2], 2, axis=1)
    panel = share((200, 30, 30), left)
    assert 0.6 < panel < 0.95
    wanted = {"far": (3 / 8, (116, 18, 18)), "right": (3 / 8, (245, 245, 242)), "none": (1 / 4, BLACK)}
    for name, (part, color) in wanted.items():
        assert share(color, right) == pytest.approx(part * panel, rel=0.35), name
    far, none = (np.argwhere(np.abs(right - color).max(axis=-1) < 20).mean(axis=0) for color in ((116, 18, 18), BLACK))
    assert far[1] < 512, "the left half is too far"
    assert none[0] > far[0], "the lowest quarter has no range"


def test_a_picture_without_panorama_or_truth_is_made_too(tmp_path: Path) -> None:
    nothing = np.full((8, 16), np.nan, np.float32)
    write_error_picture(tmp_path / "a.jpg", nothing, nothing, counted=np.zeros((8, 16), bool))
    picture = read_picture(tmp_path / "a.jpg")
    assert (picture[:600, 1024:] == GREY).all(axis=-1).mean() > 0.5


@pytest.mark.filterwarnings("error")
def test_pictures_of_a_cloud_are_as_wide_as_the_page_with_any_names(tmp_path: Path) -> None:
    blue = np.full((8, 8, 3), (0, 0, 255), np.uint8)
    limits = [0.01 * number for number in range(1, 12)]
    _write_pictures(tmp_path / "e.png", [("$x_$ 東.png", blue), ("a$b$.jpg", blue[:2])], limits)
    picture = read_picture(tmp_path / "e.png")
    widths = (picture == (255, 0, 0)).all(axis=2).sum(axis=1)
    assert widths.max() > 0.95 * WIDTH
    assert np.median(widths[widths > 0]) > 0.95 * WIDTH
    _write_pictures(tmp_path / "none.png", [], limits)
    assert read_picture(tmp_path / "none.png").shape[1] == WIDTH


def test_a_cloud_of_any_width_fits_into_the_view_from_above() -> None:
    """`width * ((WIDTH - 1) / width)` exceeds WIDTH - 1 for some widths; then a column beyond the last was drawn."""
    widths = np.linspace(2, 9, 400).astype(np.float32).astype(np.float64)
    rounded_up = widths[widths * ((WIDTH - 1) / widths) > WIDTH - 1]
    assert len(rounded_up) > 5
    for width in rounded_up[:5]:
        points = np.zeros((1001, 3), np.float32)
        points[10:996, 0] = np.linspace(0, width, 986)
        points[996:, 0] = width * (1 + 0.6 / (WIDTH - 1))  # among the outermost 1 %
        view = _top_view(points, np.zeros(1001, np.float32), (0.05, 0.1))
        assert view.shape[1] == WIDTH


def test_a_cloud_carries_its_errors_as_numbers_and_as_colours(tmp_path: Path) -> None:
    points = np.random.default_rng(0).normal(size=(9, 3)).astype(np.float32)
    distances = np.array([0.01, 0.03, 0.2, np.inf, 0.01, 0.02, 0.05, 0.06, 0], np.float32)
    path = tmp_path / "new" / "a.ply"
    write_error_cloud(path, (points[i : i + 4] for i in (0, 4, 8)), distances, limits=(0.02, 0.05), farthest=1.0)
    read = open_ply_points(path)
    np.testing.assert_array_equal(np.concatenate(list(read.chunks(2))), points)
    np.testing.assert_array_equal(read.vertices["distance"], np.minimum(distances, 1))
    colors = np.stack([read.vertices[name] for name in ("red", "green", "blue")], axis=-1)
    np.testing.assert_array_equal(colors, distance_colors(distances, (0.02, 0.05)))
    with pytest.raises(UsageError, match="9 points, but 8 distances"):
        write_error_cloud(path, [points], distances[:8], limits=(0.02,), farthest=1.0)
