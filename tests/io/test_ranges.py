"""Ranges and normals in other formats, re-read by OpenCV, numpy and OpenEXR."""

from __future__ import annotations

import json
import struct
import sys
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import OpenEXR
import PIL.Image
import pytest
from numpy.typing import NDArray
from pydantic import ValidationError

from pano_mvs.api import Context, RangeMap, UsageError
from pano_mvs.core.errors import InputError
from pano_mvs.io.ranges import (
    read_normals,
    read_npy,
    read_npz,
    write_normals_png,
    write_normals_tiff,
    write_range_png,
)
from pano_mvs.scene.exr import read_exr, write_exr
from pano_mvs.stages.exports.files import RangesParams, ranges
from pano_mvs.testing.tiny_capture import Variant, tiny_capture
from tests.stored import read_picture

SIZE_HW = 24, 48


def some_ranges() -> np.ndarray:
    rng = np.random.default_rng(3)
    values = rng.gamma(2, 3, SIZE_HW).astype(np.float32)
    values[rng.random(SIZE_HW) < 0.2] = np.nan
    return values


def some_normals() -> np.ndarray:
    rng = np.random.default_rng(4)
    normals = rng.normal(size=(*SIZE_HW, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    normals[rng.random(SIZE_HW) < 0.2] = np.nan
    normals[0, :6] = [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]]
    return normals.astype(np.float32)


@pytest.mark.parametrize("unit", [0.001, 0.0005, 0.01])
def test_a_16_bit_png_is_the_range_to_half_a_step(tmp_path: Path, unit: float) -> None:
    values = some_ranges()
    assert write_range_png(tmp_path / "a.png", values, unit=unit) == 0
    steps = read_picture(tmp_path / "a.png", cv2.IMREAD_UNCHANGED)
    assert steps.dtype == np.uint16
    np.testing.assert_array_equal(steps == 0, np.isnan(values))
    assert np.nanmax(np.abs(np.where(steps > 0, steps * unit, np.nan) - values)) <= unit / 2 + 1e-6


def test_what_a_16_bit_png_cannot_hold_is_invalid_and_counted(tmp_path: Path) -> None:
    values = np.array([[1e-6, 0.0004, 65.535, 65.5354, 65.5356, 1e9, np.nan, 2.0]], np.float32)
    assert write_range_png(tmp_path / "a.png", values, unit=0.001) == 2
    steps = read_picture(tmp_path / "a.png", cv2.IMREAD_UNCHANGED)
    assert steps.tolist() == [[1, 1, 65535, 65535, 0, 0, 0, 2000]]


def test_normals_come_back_from_tiff_and_png(tmp_path: Path) -> None:
    """Red, green and blue are x, y and z to other readers too."""
    normals = some_normals()
    write_normals_tiff(tmp_path / "a.tiff", normals)
    write_normals_png(tmp_path / "a.png", normals)
    np.testing.assert_array_equal(read_normals(tmp_path / "a.tiff"), normals)
    np.testing.assert_allclose(read_normals(tmp_path / "a.png"), normals, atol=2e-5)
    np.testing.assert_array_equal(read_normals(tmp_path / "a.png")[0, :6], normals[0, :6])
    tiff = cv2.cvtColor(read_picture(tmp_path / "a.tiff", cv2.IMREAD_UNCHANGED), cv2.COLOR_BGR2RGB)
    np.testing.assert_array_equal(tiff, normals)
    png = cv2.cvtColor(read_picture(tmp_path / "a.png", cv2.IMREAD_UNCHANGED), cv2.COLOR_BGR2RGB)
    assert png[0, :2].tolist() == [[65535, 32768, 32768], [1, 32768, 32768]]
    np.testing.assert_array_equal((png == 0).all(axis=-1), np.isnan(normals[..., 0]))


def test_an_exr_keeps_every_bit(tmp_path: Path) -> None:
    values = some_ranges()
    for name in ("a.exr", "b.exr"):
        write_exr(tmp_path / name, {"Z": values})
    with OpenEXR.File(str(tmp_path / "a.exr")) as file:
        np.testing.assert_array_equal(file.channels()["Z"].pixels, values)
    np.testing.assert_array_equal(read_exr(tmp_path / "a.exr")["Z"], values)
    assert (tmp_path / "a.exr").read_bytes() == (tmp_path / "b.exr").read_bytes()


def test_without_openexr_the_remedy_is_told_before_anything_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    with pytest.raises(ValidationError, match=r"pip install 'pano-mvs\[exr\]'"):
        RangesParams(formats=("tiff", "exr"))
    with pytest.raises(UsageError, match=r"pip install 'pano-mvs\[exr\]'"):
        write_exr(Path("a.exr"), {"Z": some_ranges()})
    with pytest.raises(UsageError, match=r"pip install 'pano-mvs\[exr\]'"):
        read_exr(Path("a.exr"))


def test_other_arrays_and_other_files_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(b"no picture")
    with pytest.raises(InputError, match=r"a\.png: normals are a float32 TIFF or a 16-bit PNG"):
        read_normals(tmp_path / "a.png")
    with pytest.raises(InputError, match=r"a\.png: not a readable EXR file"):
        read_exr(tmp_path / "a.png")
    doubles: Any = np.zeros((2, 4))
    with pytest.raises(UsageError, match=r"a range map is \(H, W\) float32"):
        write_range_png(tmp_path / "b.png", doubles, unit=1)
    with pytest.raises(UsageError, match=r"normals are \(H, W, 3\) float32"):
        write_normals_png(tmp_path / "b.png", np.zeros((2, 4), np.float32))
    with pytest.raises(UsageError, match="channels of an EXR file are"):
        write_exr(tmp_path / "b.exr", {"Z": doubles})


def test_the_stage_writes_all_formats_of_one_map(tmp_path: Path) -> None:
    """All agree, nothing comes from a masked pixel, though the map given has ranges there."""
    capture = tiny_capture(Variant(masked=True))
    name = capture.names[0]
    image, true_range = capture.images[name], capture.ranges[0]
    mask = image.load_mask()
    assert 0 < mask.mean() < 1
    everywhere = RangeMap(true_range, np.full(true_range.shape, 200, np.uint8))
    params = RangesParams(formats=("tiff", "png", "exr", "npy"), normals=("tiff", "png", "exr", "npy"))
    ctx = Context(np.random.default_rng(0), tmp_path)
    files = ranges(everywhere, image, params, ctx).files
    assert set(files) == {
        *(f"range/{{item}}.{suffix}" for suffix in ("tiff", "png", "exr", "npy", "json")),
        "confidence/{item}.png",
        *(f"normals/{{item}}.{suffix}" for suffix in ("tiff", "png", "exr", "npy")),
    }
    tiff = read_picture(files["range/{item}.tiff"], cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(tiff, np.where(mask, true_range, np.float32(np.nan)))
    np.testing.assert_array_equal(np.load(files["range/{item}.npy"]), tiff)
    np.testing.assert_array_equal(read_exr(files["range/{item}.exr"])["Z"], tiff)
    unit = json.loads(files["range/{item}.json"].read_text())["unit"]
    steps = read_picture(files["range/{item}.png"], cv2.IMREAD_UNCHANGED)
    np.testing.assert_allclose(np.where(steps > 0, steps * unit, np.nan), tiff, atol=0.00051)
    confidence = read_picture(files["confidence/{item}.png"], cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(confidence, np.where(mask, 200, 0))
    normals = np.load(files["normals/{item}.npy"])
    assert np.isnan(normals[~mask]).all()
    assert np.isfinite(normals[mask]).mean() > 0.9
    np.testing.assert_array_equal(read_normals(files["normals/{item}.tiff"]), normals)
    channels = read_exr(files["normals/{item}.exr"])
    np.testing.assert_array_equal(np.stack([channels[name] for name in "RGB"], axis=-1), normals)
    np.testing.assert_allclose(read_normals(files["normals/{item}.png"]), normals, atol=2e-5)


def test_another_library_reads_the_maps(tmp_path: Path) -> None:
    """Pillow reads TIFF by libtiff and PNG by its own decoder: the same numbers, and the same depth of bits."""
    values, level = some_ranges(), np.full(SIZE_HW, 200, np.uint8)
    params = RangesParams(formats=("tiff", "png"))
    files = ranges(RangeMap(values, level), None, params, Context(np.random.default_rng(0), tmp_path)).files
    found = {}
    for name, mode in {"range/{item}.tiff": "F", "range/{item}.png": "I;16", "confidence/{item}.png": "L"}.items():
        with PIL.Image.open(files[name]) as picture:
            assert picture.mode == mode
            found[name] = np.array(picture)
    np.testing.assert_array_equal(found["range/{item}.tiff"], values)
    np.testing.assert_array_equal(found["range/{item}.png"] > 0, np.isfinite(values))
    np.testing.assert_allclose(found["range/{item}.png"] * 0.001, np.nan_to_num(values), atol=0.00051)
    np.testing.assert_array_equal(found["confidence/{item}.png"], np.where(np.isfinite(values), 200, 0))


def test_normals_that_came_with_the_ranges_are_kept(tmp_path: Path) -> None:
    ranges_map = np.full(SIZE_HW, 2, np.float32)
    given = np.nan_to_num(some_normals(), nan=0.0).astype(np.float16)
    given[(given == 0).all(axis=-1)] = (0, 0, 1)
    known = RangeMap(ranges_map, np.full(SIZE_HW, 200, np.uint8), given)
    files = ranges(known, None, RangesParams(normals=("npy",)), Context(np.random.default_rng(0), tmp_path)).files
    np.testing.assert_array_equal(np.load(files["normals/{item}.npy"]), given.astype(np.float32))


def test_the_uncertainty_is_written_where_it_is_known(tmp_path: Path) -> None:
    capture = tiny_capture(Variant(masked=True))
    image, true_range = capture.images[capture.names[0]], capture.ranges[0]
    sigma = np.full(true_range.shape, 0.02, np.float16)
    known = RangeMap(true_range, np.full(true_range.shape, 200, np.uint8), uncertainty=sigma)
    files = ranges(known, image, RangesParams(), Context(np.random.default_rng(0), tmp_path)).files
    written = read_picture(files["uncertainty/{item}.tiff"], cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(written, np.where(image.load_mask(), np.float32(np.float16(0.02)), np.nan))
    without = ranges(known, image, RangesParams(uncertainty=False), Context(np.random.default_rng(0), tmp_path)).files
    assert set(without) == {"range/{item}.tiff", "confidence/{item}.png"}


def header(shape: str, descr: str = "'<f4'") -> bytes:
    text = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY\1\0" + struct.pack("<H", len(text)) + text


@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("dtype", ["<f4", ">f8", "<u2", "|u1"])
def test_arrays_come_back(tmp_path: Path, order: Literal["C", "F"], dtype: str) -> None:
    array: NDArray[Any] = np.asarray(np.arange(24).reshape(4, 6), np.dtype(dtype), order=order)
    np.save(tmp_path / "a.npy", array)
    np.savez_compressed(tmp_path / "a.npz", range=array)
    np.testing.assert_array_equal(read_npy(tmp_path / "a.npy"), array)
    np.testing.assert_array_equal(read_npz(tmp_path / "a.npz", "range"), array)


@pytest.mark.parametrize(
    ("start", "what"),
    [
        (header("(1000000000000,)"), "states 4000000000000 bytes, but there are"),
        (header("(4611686018427387904, 4)"), "states"),
        (header("(-1, 5)"), "states the shape"),
        (header("(5,)", "'|O'"), "Python objects"),
        (header(f"({'9' * 5000},)"), "Cannot parse header"),
        (header("(2, 2)"), "it ends after 8 of 16 bytes"),
        (b"\x93NUMPY\1\0", ""),
        (b"", ""),
    ],
)
def test_headers_are_believed_as_far_as_the_bytes_reach(tmp_path: Path, start: bytes, what: str) -> None:
    (tmp_path / "a.npy").write_bytes(start + bytes(8))
    with pytest.raises(InputError, match=rf"a\.npy: not a readable \.npy file \(.*({what})") as caught:
        read_npy(tmp_path / "a.npy")
    assert len(str(caught.value)) < 1000
