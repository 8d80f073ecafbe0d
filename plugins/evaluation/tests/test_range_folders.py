"""Range maps of anybody: formats, units, folders, names."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.core.errors import InputError
from pano_mvs.io.images.names import without_extension
from pano_mvs.io.ranges import write_confidence_png, write_range_tiff
from pano_mvs.io.truth import RangeFile, find_ranges, find_true_ranges
from tests.stored import write_npz

RANGES = np.random.default_rng(0).uniform(0.5, 60, (4, 8)).astype(np.float32)
RANGES[1, 2] = np.nan


def write(path: Path, array: NDArray[Any] = RANGES) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".tiff":
        write_range_tiff(path, array)
    elif path.suffix == ".npy":
        np.save(path, array)
    elif path.suffix == ".npz":
        np.savez(path, array)
    elif path.suffix == ".exr":
        openexr = pytest.importorskip("OpenEXR")
        openexr.File({"compression": openexr.ZIP_COMPRESSION, "type": openexr.scanlineimage}, {"Y": array}).write(
            str(path)
        )
    else:
        cv2.imwrite(str(path), np.nan_to_num(array * 1000).round().astype(np.uint16))
    return path


@pytest.mark.parametrize("suffix", [".tiff", ".exr", ".npy", ".npz", ".png"])
def test_every_format_gives_the_same_map(tmp_path: Path, suffix: str) -> None:
    write(tmp_path / "deep" / f"a.b{suffix}")
    unit = 0.001 if suffix == ".png" else 1.0
    ((name, file),) = find_ranges(tmp_path, unit=unit).items()
    assert name == "deep/a.b"
    np.testing.assert_allclose(file.read(), RANGES, rtol=0, atol=5.1e-4 if suffix == ".png" else 0)
    assert file.read_confidence() is None


@pytest.mark.parametrize("suffix", [".tiff", ".npy", ".npz"])
def test_what_is_no_range_is_nan_whatever_stands_there(tmp_path: Path, suffix: str) -> None:
    hard = np.array([[0, -1, np.inf, np.nan], [1, 2, -np.inf, 3]], np.float32)
    write(tmp_path / f"a{suffix}", hard)
    np.testing.assert_array_equal(
        find_ranges(tmp_path)["a"].read(), np.array([[np.nan] * 4, [1, 2, np.nan, 3]], np.float32)
    )


def test_an_output_folder_is_its_ranges_with_their_confidence(tmp_path: Path) -> None:
    write(tmp_path / "range" / "x" / "1.tiff")
    confidence = np.arange(32, dtype=np.uint8).reshape(4, 8)
    (tmp_path / "confidence" / "x").mkdir(parents=True)
    write_confidence_png(tmp_path / "confidence" / "x" / "1.png", confidence)
    (tmp_path / "preview").mkdir()
    (tmp_path / "preview" / "9.png").write_bytes(b"no range")
    ((name, file),) = find_ranges(tmp_path).items()
    assert name == "x/1"
    np.testing.assert_array_equal(file.read_confidence(), confidence)


def test_an_archive_holds_one_array_for_each_picture(tmp_path: Path) -> None:
    write_npz(tmp_path / "depth.npz", {"000": RANGES, "001": 2 * RANGES})
    for path in (tmp_path, tmp_path / "depth.npz"):
        found = find_ranges(path, unit=0.5)
        assert list(found) == ["000", "001"]
        np.testing.assert_array_equal(found["001"].read(), RANGES)
    np.savez(tmp_path / "each.npz", other=RANGES[..., None], range=2 * RANGES)
    np.testing.assert_array_equal(RangeFile(tmp_path / "each.npz").read(), 2 * RANGES)


def test_of_two_files_for_one_picture_the_exacter_is_taken(tmp_path: Path) -> None:
    write(tmp_path / "a.png")
    write(tmp_path / "a.tiff", 2 * RANGES)
    (file,) = find_ranges(tmp_path).values()
    assert str(file) == str(tmp_path / "a.tiff")


def test_truth_is_found_with_poses_and_without(tmp_path: Path) -> None:
    (tmp_path / "poses.json").write_text(
        '{"views": [{"id": 3, "image": "images/z.png", "R": [[1,0,0],[0,1,0],[0,0,1]], "t": [0,0,0]}]}'
    )
    write_npz(tmp_path / "depth.npz", {"003": RANGES, "else": RANGES})
    found = find_true_ranges(tmp_path, unit=2.0)
    assert list(found) == ["images/z.png"]
    np.testing.assert_array_equal(found["images/z.png"].read(), 2 * RANGES)
    np.savez(tmp_path / "depth.npz", nothing=RANGES)
    with pytest.raises(InputError, match="no array named after an image"):
        find_true_ranges(tmp_path)
    (tmp_path / "poses.json").unlink()
    assert list(find_true_ranges(tmp_path)) == ["nothing"]


def test_only_extensions_of_pictures_are_dropped() -> None:
    assert [without_extension(name) for name in ("a.b/c.PNG", "v1.5", ".png", "a\\b.tiff")] == [
        "a.b/c",
        "v1.5",
        ".png",
        "a/b",
    ]


class TestFaults:
    def test_nothing_there(self, tmp_path: Path) -> None:
        with pytest.raises(InputError, match=r"no such folder or \.npz file"):
            find_ranges(tmp_path / "none")
        with pytest.raises(InputError, match="no range maps here"):
            find_ranges(tmp_path)

    @pytest.mark.parametrize("suffix", [".tiff", ".png", ".npy", ".npz", ".exr"])
    @pytest.mark.parametrize("content", [b"", b"junk" * 9])
    def test_damaged(self, tmp_path: Path, suffix: str, content: bytes) -> None:
        path = tmp_path / f"a{suffix}"
        path.write_bytes(content)
        with pytest.raises(InputError, match=f"a{suffix}: "):
            RangeFile(path).read()

    def test_a_colour_picture_is_no_range_map(self, tmp_path: Path) -> None:
        cv2.imwrite(str(tmp_path / "a.png"), np.zeros((4, 8, 3), np.uint8))
        with pytest.raises(InputError, match=r"a\.png: holds \(4, 8, 3\) uint8, not a map of ranges"):
            find_ranges(tmp_path)["a"].read()
        cv2.imwrite(str(tmp_path / "a.png"), np.zeros((4, 8), np.uint8))
        with pytest.raises(InputError, match="16-bit PNG, and give its unit"):
            find_ranges(tmp_path)["a"].read()

    def test_several_arrays_of_which_none_is_meant(self, tmp_path: Path) -> None:
        np.savez(tmp_path / "a.npz", x=RANGES, y=RANGES)
        with pytest.raises(InputError, match="holds 2 arrays"):
            RangeFile(tmp_path / "a.npz").read()
        np.savez(tmp_path / "b.npz")
        with pytest.raises(InputError, match="contains no arrays"):
            find_ranges(tmp_path / "b.npz")
