"""Times of earlier runs: what is kept, and what is expected of a unit because of it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pano_mvs.core.digest import digest_from_bytes
from pano_mvs.engine.cache.unit_times import FILE_NAME, CaptureSize, ExpectedUnit, Sample, UnitTimes
from pano_mvs.scene.image_file import write_png

SAMPLE = Sample("a", 1, images=10, pixels=1000.0, units=10, seconds=2.0, stored_bytes=100.0)
SIZE = CaptureSize(10, 1000.0)


def times(folder: Path, *samples: Sample) -> UnitTimes:
    found = UnitTimes(folder / FILE_NAME)
    for sample in samples:
        found.add("depth", sample)
    found.save()
    return UnitTimes(folder / FILE_NAME)


def expected(found: UnitTimes, size: CaptureSize = SIZE, *, whole: bool = False, threads: int = 1) -> ExpectedUnit:
    unit = found.expected_unit("depth", size, settings="a", threads=threads, whole=whole)
    assert unit is not None
    return unit


def test_nothing_is_expected_without_experience(tmp_path: Path) -> None:
    assert times(tmp_path).expected_unit("depth", SIZE, settings="a", threads=1, whole=False) is None
    assert not (tmp_path / FILE_NAME).exists(), "nothing new, nothing written"
    found = times(tmp_path, SAMPLE)
    assert found.expected_unit("other", SIZE, settings="a", threads=1, whole=False) is None
    assert found.expected_pairs("other", 5, settings="a") is None


def test_a_unit_takes_what_one_took_scaled_by_pixels_and_for_the_whole_capture_by_images(tmp_path: Path) -> None:
    found = times(tmp_path, SAMPLE)
    assert expected(found) == ExpectedUnit(2.0, 100.0)
    assert expected(found, CaptureSize(30, 2000.0)) == ExpectedUnit(4.0, 200.0)
    assert expected(found, CaptureSize(30, 2000.0), whole=True) == ExpectedUnit(12.0, 600.0)


def test_the_same_settings_count_before_others_and_threads_and_size_after_them(tmp_path: Path) -> None:
    other_settings, other_threads = replace(SAMPLE, settings="b", seconds=50.0), replace(SAMPLE, threads=8, seconds=9.0)
    assert expected(times(tmp_path, other_settings)).seconds == 50.0, "better than nothing"
    assert expected(times(tmp_path, SAMPLE, other_settings)).seconds == 2.0
    assert expected(times(tmp_path, other_threads)).seconds == 2.0
    assert expected(times(tmp_path, other_threads), threads=8).seconds == 9.0


def test_the_median_of_the_three_most_similar_runs_counts(tmp_path: Path) -> None:
    far = [replace(SAMPLE, pixels=1e6, seconds=1e5)] * 3
    near = [replace(SAMPLE, seconds=seconds) for seconds in (1.0, 70.0, 3.0)]
    assert expected(times(tmp_path, *near, *far)).seconds == 3.0


def test_only_the_latest_eight_runs_are_kept_also_those_of_other_processes(tmp_path: Path) -> None:
    here, there = UnitTimes(tmp_path / FILE_NAME), UnitTimes(tmp_path / FILE_NAME)
    for number in range(6):
        here.add("depth", replace(SAMPLE, seconds=10.0 + number))
        there.add("depth", replace(SAMPLE, seconds=20.0 + number))
    here.save()
    there.save()
    value = json.loads((tmp_path / FILE_NAME).read_bytes().partition(b"\n")[2])
    assert [sample[5] for sample in value["depth"]] == [14.0, 15.0, 20.0, 21.0, 22.0, 23.0, 24.0, 25.0]


@pytest.mark.parametrize(("units", "images", "pairs"), [(45, 20, 190), (30, 20, 60), (30, 3, 3)])
def test_pairs_are_expected_as_all_or_as_a_number_per_image(
    tmp_path: Path, units: int, images: int, pairs: int
) -> None:
    found = times(tmp_path, replace(SAMPLE, units=units))
    assert found.expected_pairs("depth", images, settings="a") == pairs


def test_the_size_of_a_capture_is_that_of_its_pictures(tmp_path: Path) -> None:
    files = []
    for number in range(20):
        files.append((tmp_path / f"{number}.png",))
        write_png(files[-1][0], np.zeros((8, 16 if number else 400, 3), np.uint8))
    assert CaptureSize.of_files(files) == CaptureSize(20, 128.0)
    text = tmp_path / "a.txt"
    text.write_text("x" * 300)
    assert CaptureSize.of_files([(text,)]) == CaptureSize(1, 300.0)
    assert CaptureSize.of_files([(tmp_path / "gone.png",)]) == CaptureSize(1, 1.0)
    assert CaptureSize.of_files([]) == CaptureSize(0, 1.0)


BAD = [
    {"depth": [["a", 1, 10, 1000.0, 10, 2.0]]},
    {"depth": [["a", 1, 10, 0.0, 10, 2.0, 1.0]]},
    {"depth": [["a", 1, 10, 1.0, 10, -2.0, 1.0]]},
    {"depth": [[1, 1, 10, 1.0, 10, 2.0, 1.0]]},
    {"depth": [["a", 1, 1.5, 1.0, 10, 2.0, 1.0]]},
    {"depth": [["a", 1, 10, 1.0, 10, None, 1.0]]},
    {"depth": 3},
    [],
    None,
]


@pytest.mark.parametrize("value", BAD)
def test_what_is_not_a_sample_is_ignored(tmp_path: Path, value: object) -> None:
    body = json.dumps(value)
    (tmp_path / FILE_NAME).write_text(f"{digest_from_bytes(body.encode())}\n{body}")
    found = UnitTimes(tmp_path / FILE_NAME)
    assert found.expected_unit("depth", SIZE, settings="a", threads=1, whole=False) is None
    assert expected(times(tmp_path, SAMPLE)).seconds == 2.0, "the file is replaced"


@given(position=st.integers(0, 400), byte=st.integers(0, 255))
def test_a_changed_byte_costs_the_samples_and_nothing_else(
    tmp_path_factory: pytest.TempPathFactory, position: int, byte: int
) -> None:
    folder = tmp_path_factory.mktemp("damage")
    times(folder, SAMPLE)
    data = bytearray((folder / FILE_NAME).read_bytes())
    position %= len(data)
    was_changed = data[position] != byte
    data[position] = byte
    (folder / FILE_NAME).write_bytes(bytes(data))
    found = UnitTimes(folder / FILE_NAME).expected_unit("depth", SIZE, settings="a", threads=1, whole=False)
    assert (found is None) == was_changed
