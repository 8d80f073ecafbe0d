"""Read and write files in tests without the code under test."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

import cv2
import numpy as np
from numpy.typing import NDArray


def read_picture(path: Path | str, flags: int = cv2.IMREAD_COLOR) -> NDArray[Any]:
    """Read a picture with OpenCV (colours in the order BGR), and fail if that cannot."""
    picture: NDArray[Any] | None = cv2.imread(os.fspath(path), flags)
    assert picture is not None, path
    return picture


def write_npz(path: Path | IO[bytes], arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays under names that need not be identifiers."""
    named: dict[str, Any] = dict(arrays)
    np.savez(path, **named)
