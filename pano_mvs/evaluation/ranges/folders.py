"""Range maps of many pictures in files of anybody: folders of TIFF, EXR, PNG, NPY and NPZ files, or one NPZ."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path, PurePosixPath
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import InputError
from pano_mvs.core.paths import below, is_file, is_folder
from pano_mvs.io.images.captures import PICTURE_SUFFIXES
from pano_mvs.io.images.exr import read_exr
from pano_mvs.io.ranges.files import read_confidence_png
from pano_mvs.io.ranges.npy import keys_of_npz, read_npy, read_npz
from pano_mvs.scene.image_files.decoding import decode_picture

RANGE_SUFFIXES = (".tiff", ".tif", ".exr", ".npy", ".npz", ".png")
"""What files of ranges are called; of two for one picture the earlier is taken."""

_PICTURES = frozenset({*RANGE_SUFFIXES, *PICTURE_SUFFIXES, ".heic"})
# Channels of an EXR file that may be meant, where it holds several.
_EXR_CHANNELS = ("range", "depth", "distance", "Z", "Depth.Z", "V", "Y", "R")


@dataclass(frozen=True)
class RangeFile:
    """Where the range map of one picture lies.

    Attributes:
        path: the file.
        key: of the array in it, where it holds several; else "".
        unit: what a 1 in the file stands for, in the unit in which `read` gives it.
        confidence_path: an 8-bit PNG beside it, or None.
    """

    path: Path
    key: str = ""
    unit: float = 1.0
    confidence_path: Path | None = None

    def read(self) -> NDArray[np.float32]:
        """Return the range map (H, W) float32, NaN where the file holds none: zero, negative, infinite or NaN.

        Raises:
            InputError: if the file cannot be read or holds no such map.
        """
        array = _READERS[self.path.suffix.lower()](self.path, self.key)
        if array.ndim == 3 and array.shape[-1] == 1:
            array = array[..., 0]
        if array.ndim != 2 or not array.size or array.dtype.kind not in "fiu" or array.dtype.itemsize < 2:
            raise InputError(f"{self.path}: holds {array.shape} {array.dtype}, not a map of ranges (height, width) in "
                             "floats or 16-bit steps. Write ranges as float TIFF, EXR or NPY, or as 16-bit PNG "
                             "with --unit")  # fmt: skip
        with np.errstate(over="ignore", invalid="ignore"):  # what float32 cannot hold becomes infinite, and so unknown
            ranges = array.astype(np.float32) * np.float32(self.unit)
        return np.where(np.isfinite(ranges) & (ranges > 0), ranges, np.float32(np.nan))

    def read_confidence(self) -> NDArray[np.uint8] | None:
        """Return the confidence (H, W) uint8 of its pixels, or None if there is none.

        Raises:
            InputError: if the file cannot be read.
        """
        return None if self.confidence_path is None else read_confidence_png(self.confidence_path)


def find_ranges(path: Path, *, unit: float = 1.0) -> dict[str, RangeFile]:
    """Return the range maps in a folder or an NPZ file, by the picture's name without extension, in order.

    A folder with `range/` in it is taken as the output of a run, with its `confidence/`. In any other, all files below
    it whose names end in one of `RANGE_SUFFIXES` are taken, each for the picture of the same path; a `depth.npz` alone
    stands for its arrays.

    Args:
        path: the folder, or an .npz file with one array for each picture.
        unit: what a 1 in the files stands for.

    Raises:
        InputError: if there is nothing, or an archive is damaged.
    """
    if is_file(path) and path.suffix.lower() == ".npz":
        return _in_archive(path, unit)
    if not is_folder(path):
        raise InputError(
            f"{path}: no such folder or .npz file. Give the output folder of a run, or a folder of range maps"
        )
    folder = path / "range" if is_folder(path / "range") else path
    files = [file for file in below(folder) if file.suffix.lower() in RANGE_SUFFIXES and not file.name.startswith(".")]
    if [file.name for file in files if file.suffix == ".npz"] == ["depth.npz"]:
        return _in_archive(next(file for file in files if file.suffix == ".npz"), unit)
    found: dict[str, RangeFile] = {}
    for file in sorted(files, key=lambda file: (RANGE_SUFFIXES.index(file.suffix.lower()), file)):
        name = file.relative_to(folder).with_suffix("").as_posix()
        confidence = path / "confidence" / f"{name}.png"
        of_run = folder != path and is_file(confidence)
        found.setdefault(name, RangeFile(file, unit=unit, confidence_path=confidence if of_run else None))
    if not found:
        raise InputError(f"{folder}: no range maps here. They may be {', '.join(RANGE_SUFFIXES)}")
    return dict(sorted(found.items()))


def match_pictures(names: Iterable[str], available: Iterable[str]) -> dict[str, str]:
    """Return, for each picture's name, that of the same picture among others; names may lack folders or extensions.

    Two names can be those of one picture if their last parts are the same but for a picture's extension and for case.
    Where that fits several, those that share more folders, and then the extension, belong together; what is still open
    is left out.

    Args:
        names: say, "a/001".
        available: say, "images/a/001.jpg".
    """
    groups: dict[str, tuple[list[str], list[str]]] = {}
    for side, all_names in enumerate((names, available)):
        for name in all_names:
            groups.setdefault(_parts(name)[-1].casefold(), ([], []))[side].append(name)
    matched: dict[str, str] = {}
    for ours, theirs in groups.values():
        if len(ours) == len(theirs) == 1:
            matched[ours[0]] = theirs[0]
        elif ours and theirs:
            of_ours = {name: _closest(name, theirs) for name in ours}
            of_theirs = {name: _closest(name, ours) for name in theirs}
            matched |= {name: other for name, other in of_ours.items() if other and of_theirs[other] == name}
    return matched


def without_extension(name: str) -> str:
    """Return a picture's name without a picture's extension, with forward slashes; other endings stay."""
    plain = name.replace("\\", "/")
    stem, dot, ending = plain.rpartition(".")
    return stem if dot and f".{ending.casefold()}" in _PICTURES and not stem.endswith("/") and stem else plain


def _parts(name: str) -> tuple[str, ...]:
    return tuple(part for part in PurePosixPath(without_extension(name)).parts if part != ".") or ("",)


def _closest(name: str, others: Sequence[str]) -> str:
    """Return that of some names of the same last part that is closest to a name; "" if none is closer than the rest."""
    ranked = sorted(others, key=lambda other: _closeness(name, other), reverse=True)
    tied = len(ranked) > 1 and _closeness(name, ranked[0]) == _closeness(name, ranked[1])
    return "" if tied else ranked[0]


def _closeness(name: str, other: str) -> tuple[int, bool]:
    """Return how many parts two names have in common at their end, and whether the whole last part is one of them."""
    pairs = zip(reversed(_parts(name)), reversed(_parts(other)), strict=False)
    common = sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], pairs))
    return common, PurePosixPath(name).name == PurePosixPath(other).name


def _in_archive(path: Path, unit: float) -> dict[str, RangeFile]:
    keys = keys_of_npz(path)
    if not keys:
        raise InputError(f"{path}: holds no arrays. Give a file with one range map for each picture")
    return {key: RangeFile(path, key, unit) for key in keys}


def _read_picture(path: Path, _key: str) -> NDArray[Any]:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}). Check that it exists and may be read") from error
    array = decode_picture(data, path, cv2.IMREAD_UNCHANGED)
    if array is None:
        raise InputError(f"{path}: not a picture that can be decoded ({len(data)} bytes). Write it again")
    return np.asarray(array)


def _read_npy(path: Path, _key: str) -> NDArray[Any]:
    return read_npy(path)


def _read_npz(path: Path, key: str) -> NDArray[Any]:
    """Return the array under a key, or the one that there is."""
    if not key:
        inside = list(_in_archive(path, 1.0))
        key = next((name for name in ("range", "depth") if name in inside), inside[0])
        if len(inside) > 1 and key not in ("range", "depth"):
            raise InputError(f"{path}: holds {len(inside)} arrays ({', '.join(inside[:3])} …), none of them called "
                             "'range'. Name one so, or give this file itself as the folder")  # fmt: skip
    return read_npz(path, key)


def _read_exr(path: Path, _key: str) -> NDArray[Any]:
    channels = read_exr(path)
    name = next((name for name in (*_EXR_CHANNELS, *channels) if name in channels), None)
    if name is None:
        raise InputError(f"{path}: an EXR file without channels. Write it again")
    return channels[name]


_READERS: dict[str, Callable[[Path, str], NDArray[Any]]] = {
    ".tiff": _read_picture,
    ".tif": _read_picture,
    ".png": _read_picture,
    ".exr": _read_exr,
    ".npy": _read_npy,
    ".npz": _read_npz,
}
