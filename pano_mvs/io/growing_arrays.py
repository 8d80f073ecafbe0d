"""Arrays that grow in files, and are memory-mapped when they are complete."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, Self

import numpy as np
from numpy.typing import NDArray


class GrowingArrays:
    """Named arrays, whose rows are appended to a file each; use it as a context manager."""

    def __init__(self, folder: Path) -> None:
        """Begin in a folder, which is created if necessary."""
        folder.mkdir(exist_ok=True)
        self._folder = folder
        self._files: dict[str, BinaryIO] = {}
        self._kinds: dict[str, tuple[np.dtype[Any], tuple[int, ...], int]] = {}

    def append(self, arrays: Mapping[str, NDArray[Any] | None]) -> None:
        """Append rows (N, ...) to each array; None appends nothing."""
        for name, array in arrays.items():
            if array is None:
                continue
            if name not in self._files:
                self._files[name] = (self._folder / name).open("wb")
                self._kinds[name] = array.dtype, array.shape[1:], 0
            dtype, shape, rows = self._kinds[name]
            assert array.dtype == dtype
            assert array.shape[1:] == shape
            self._kinds[name] = dtype, shape, rows + len(array)
            self._files[name].write(np.ascontiguousarray(array).reshape(-1).view(np.uint8).data)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return all arrays, memory-mapped: their pages are read on use, and can be dropped at any time."""
        self._close()
        return {
            # Writable, since kernels are compiled once more for arrays that are read-only.
            name: np.memmap(self._folder / name, dtype, "r+", shape=(rows, *shape)).view(np.ndarray)
            if rows
            else np.zeros((0, *shape), dtype)
            for name, (dtype, shape, rows) in self._kinds.items()
        }

    def _close(self) -> None:
        for stream in self._files.values():
            stream.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._close()
