"""Read and write the channels of EXR files, with the extra `exr`."""

from __future__ import annotations

import importlib.util
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import InputError, UsageError
from pano_mvs.scene.image_header import MAX_PIXELS

# The exceptions that OpenEXR raises for damaged files.
_DAMAGE = (OSError, RuntimeError, ValueError, TypeError, LookupError, OverflowError, MemoryError)

EXR_REMEDY = "EXR files need the package OpenEXR: pip install 'pano-mvs[exr]'"


def has_exr() -> bool:
    """Return whether EXR files can be written and read."""
    return importlib.util.find_spec("OpenEXR") is not None


def write_exr(path: Path, channels: dict[str, NDArray[np.float32]]) -> None:
    """Write channels of one size as a scan-line EXR file, 32-bit float, with lossless ZIP compression."""
    if not has_exr():
        raise UsageError(EXR_REMEDY)
    import OpenEXR

    shapes = {array.shape for array in channels.values()}
    if len(shapes) != 1 or any(array.dtype != np.float32 or array.ndim != 2 for array in channels.values()):
        raise UsageError(f"channels of an EXR file are (H, W) float32 of one size, got {sorted(shapes)}")
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    arrays = {name: np.ascontiguousarray(array) for name, array in channels.items()}
    OpenEXR.File(header, arrays).write(str(path))


def read_exr(path: Path, data: bytes | None = None) -> dict[str, NDArray[np.float32]]:
    """Return the channels, name to (H, W) float32, of an EXR file, of whose contents `data` is a copy if given.

    Raises:
        UsageError: if OpenEXR is not installed.
        InputError: if the file cannot be read, or its header states more pixels than the limit.
    """
    if not has_exr():
        raise UsageError(EXR_REMEDY)
    import OpenEXR

    try:
        with _named(path, data) as name:
            with OpenEXR.File(name, header_only=True) as file:
                (left, top), (right, bottom) = file.header()["dataWindow"]
            width, height = int(right) - int(left) + 1, int(bottom) - int(top) + 1
            if width * height > MAX_PIXELS:
                raise ValueError(f"its header states {width}×{height} px, more than the limit of {MAX_PIXELS}")
            with OpenEXR.File(name, separate_channels=True) as file, np.errstate(over="ignore", invalid="ignore"):
                return {name: np.array(channel.pixels, np.float32) for name, channel in file.channels().items()}
    except _DAMAGE as error:
        raise InputError(
            f"{path}: not a readable EXR file ({str(error) or type(error).__name__}). Write it again"
        ) from error


@contextmanager
def _named(path: Path, data: bytes | None) -> Iterator[str]:
    """Return the name of a file with the contents, as OpenEXR reads nothing else."""
    if data is None:
        yield str(path)
        return
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "copy.exr"
        copy.write_bytes(data)
        yield str(copy)
