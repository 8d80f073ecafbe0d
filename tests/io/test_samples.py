"""The sample captures that travel with the program are whole, small, and credited."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pytest

from pano_mvs.geometry import pixel_from_ray, ray_grid
from pano_mvs.io.images.captures import describe_picture, list_pictures
from pano_mvs.io.truth import read_truth

SAMPLES = Path(__file__).parents[2] / "workflows" / "samples"
CLASSROOM, REAL_ROOMS = SAMPLES / "classroom", SAMPLES / "real_rooms"


def test_they_are_small() -> None:
    assert sum(path.stat().st_size for path in SAMPLES.rglob("*") if path.is_file()) < 10e6


@pytest.mark.parametrize(("folder", "size"), [(CLASSROOM, (512, 1024)), (REAL_ROOMS, (1024, 2048))])
def test_each_has_four_panoramas_and_says_whose_they_are(folder: Path, size: tuple[int, int]) -> None:
    pictures = list_pictures(folder / "images")
    assert [describe_picture(path).size_hw for path in pictures] == [size] * 4
    text = (folder / "ATTRIBUTION.md").read_text(encoding="utf-8")
    assert "Licence" in text
    assert "What was changed" in text


def test_the_mit_licence_travels_with_the_photographs() -> None:
    text = (REAL_ROOMS / "ATTRIBUTION.md").read_text(encoding="utf-8")
    assert "Copyright (c) 2017 Rich Gilbank" in text
    assert "The above copyright notice and this permission notice shall be included" in text


def test_the_truth_of_the_classroom_is_of_these_very_pictures() -> None:
    truth = read_truth(CLASSROOM / "truth")
    pictures = list_pictures(CLASSROOM / "images")
    matched = truth.match([path.name for path in pictures])
    assert len(matched) == len(truth.views) == 4
    for path in pictures:
        view = matched[path.name]
        assert hashlib.sha256(path.read_bytes()).hexdigest() == view.sha256
        range_map = truth.range_map(view)
        assert range_map is not None
        assert range_map.shape == (512, 1024)
        assert 0.9 < np.isfinite(range_map).mean() < 1


def test_poses_and_ranges_of_the_classroom_agree() -> None:
    """Points seen by one view lie where another view's range map has them, unless something stands in front."""
    truth = read_truth(CLASSROOM / "truth")
    first, *others = truth.views.values()
    grid = ray_grid((512, 1024))[::8, ::8]
    ranges = truth.range_map(first)
    assert ranges is not None
    points = first.cam_from_world.inverse().apply(ranges[::8, ::8, None] * grid)
    for other in others:
        in_other = other.cam_from_world.apply(points)
        distance = np.linalg.norm(in_other, axis=-1)
        seen = np.isfinite(distance)
        column, row = pixel_from_ray(in_other[seen], (512, 1024)).astype(int).T
        others_ranges = truth.range_map(other)
        assert others_ranges is not None
        there = others_ranges[np.minimum(row, 511), column % 1024]
        assert np.mean(np.abs(there / distance[seen] - 1) < 0.02) > 0.65
