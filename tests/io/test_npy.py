"""Arrays of .npy and .npz files, whose headers promise what they like."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.core.errors import InputError
from pano_mvs.io.ranges import read_npy, read_npz


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
