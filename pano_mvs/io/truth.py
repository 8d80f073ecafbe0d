"""Ground truth of a capture: a folder with poses.json and depth.npz."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import InputError, UsageError
from pano_mvs.core.paths import below, exists, is_file, is_folder
from pano_mvs.geometry import Rigid3
from pano_mvs.io.images.names import match_image_names
from pano_mvs.io.poses.files import read_groups, read_poses
from pano_mvs.io.poses.json_files import PosedView, read_posed_views
from pano_mvs.io.ranges import keys_of_npz, read_confidence_png, read_npy, read_npz
from pano_mvs.scene import FilePart, Poses, RangeMap
from pano_mvs.scene.exr import read_exr
from pano_mvs.scene.image_file import decode_picture
from pano_mvs.scene.pose_groups import split_groups


@dataclass(frozen=True)
class TruthView:
    """Ground truth of one image."""

    name: str  # the image's name in the truth
    cam_from_world: Rigid3  # its true pose
    range_file: RangeFile | None  # its true range map, or None
    sha256: str | None  # hex digest of the image file, or None; distinguishes different images of the same name

    def belongs_to(self, image: FilePart) -> bool:
        """Return whether an image file has the bytes that the truth states, if it states any."""
        return self.sha256 is None or image.sha256() == self.sha256


@dataclass(frozen=True)
class Truth:
    """Ground truth of a capture; range maps are read on demand."""

    folder: Path
    views: Mapping[str, TruthView]
    metric: bool

    @property
    def poses(self) -> dict[str, Rigid3]:
        """The true cam_from_world of each image."""
        return {name: view.cam_from_world for name, view in self.views.items()}

    def match(self, names: Sequence[str]) -> dict[str, TruthView]:
        """Return the views of a capture's images, by the capture's names (folders may differ)."""
        return {name: self.views[known] for name, known in match_image_names(names, self.views).items()}

    def range_map(self, view: TruthView) -> NDArray[np.float32] | None:
        """Return the true range (H, W) float32 of a view, NaN where there is no surface; None without a range map."""
        return None if view.range_file is None else view.range_file.read()


def read_truth(folder: Path) -> Truth:
    """Return the ground truth in a folder with poses.json and, optionally, depth.npz.

    The array of a view in depth.npz is named after the image's path, with or without extension, else after the end of
    that path, down to its stem, else after the view's id with three digits. Views without an array and arrays without a
    view are ignored.

    Raises:
        InputError: if poses.json is missing or malformed, depth.npz is damaged, or an array might belong to several
            images.
    """
    posed, metric = read_posed_views(folder / "poses.json")
    path = folder / "depth.npz"
    keys = _claimed_keys(path, posed, frozenset(keys_of_npz(path) if exists(path) else ()))
    files = {name: RangeFile(path, key, what=f"the range map of {name}") for name, key in keys.items()}
    views = {view.name: TruthView(view.name, view.cam_from_world, files.get(view.name), view.sha256) for view in posed}
    return Truth(folder, views, metric)


def find_true_ranges(truth: RangeMaps, *, unit: float = 1.0) -> dict[str, StoredRange]:
    """Return the true range maps by image name.

    Raises:
        InputError: if there are no range maps, or a file is damaged.
    """
    if isinstance(truth, Mapping) or not (is_file(truth / "poses.json") and is_file(truth / "depth.npz")):
        return find_ranges(truth, unit=unit)
    files = {view.name: view.range_file for view in read_truth(truth).views.values()}
    found: dict[str, StoredRange] = {name: replace(file, unit=unit) for name, file in files.items() if file}
    if not found:
        raise InputError(f"{truth / 'depth.npz'}: contains no array named after an image of poses.json, or its id")
    return found


def _claimed_keys(path: Path, views: Sequence[PosedView], keys: frozenset[str]) -> dict[str, str]:
    """Return the array of each view that has one, by the view's name."""
    whole = {view.name: (view.name.rsplit(".", 1)[0], view.name) for view in views}
    claimed = {name: key for name, tried in whole.items() if (key := _first(tried, keys)) is not None}
    owners = {key: name for name, key in claimed.items()}
    free = keys - owners.keys()
    for view in views:
        key = None if view.name in claimed else _first(_short_keys(view), free)
        if key is None:
            continue
        if key in owners:
            raise InputError(
                f"{path}: the array {key} might be that of {owners[key]} or of {view.name}. Name the arrays after the "
                f"images with their folders, such as {whole[view.name][0]}"
            )
        owners[key], claimed[view.name] = view.name, key
    return claimed


def _first(tried: Sequence[str], keys: frozenset[str]) -> str | None:
    return next((key for key in tried if key in keys), None)


def _short_keys(view: PosedView) -> list[str]:
    """Return the possible names of a view's array besides its whole name: the longest first, its number last."""
    parts = view.name.split("/")
    ends = ["/".join(parts[start:]) for start in range(1, len(parts))]
    numbered = [] if view.number is None else [f"{view.number:03d}"]
    return [key for end in ends for key in (end.rsplit(".", 1)[0], end)] + numbered


RANGE_SUFFIXES = (".tiff", ".tif", ".exr", ".npy", ".npz", ".png")
"""Extensions of range map files. If an image has several, the first of these extensions wins."""

# Channels of an EXR file that may hold the ranges, most likely first.
_EXR_CHANNELS = ("range", "depth", "distance", "Z", "Depth.Z", "V", "Y", "R")


@dataclass(frozen=True)
class RangeFile:
    """The range map of one image in a file."""

    path: Path
    key: str = ""  # name of the array in an NPZ file; "" for the only array, or the one named range or depth
    unit: float = 1.0  # factor from the file's numbers to the unit that `read` returns
    confidence_path: Path | None = None  # an 8-bit PNG with the confidence, or None
    what: str = ""  # the map's name in error messages; by default the key

    def __str__(self) -> str:
        return str(self.path)

    def read(self) -> NDArray[np.float32]:
        """Return the range map (H, W) float32; zero, negative and infinite ranges become NaN."""
        array = self._array()
        if array.ndim == 3 and array.shape[-1] == 1:
            array = array[..., 0]
        if array.ndim != 2 or not array.size or array.dtype.kind not in "fiu" or array.dtype.itemsize < 2:
            name = f"{self.path}: {self.key}" if self.key else f"{self.path}:"
            raise InputError(
                f"{name} holds {array.shape} {array.dtype}, not a map of ranges (height, width) in floats or 16-bit "
                "steps. Write ranges as float TIFF, EXR or NPY, or as 16-bit PNG, and give its unit"
            )
        return _positive_or_nan(array, self.unit)

    def read_confidence(self) -> NDArray[np.uint8] | None:
        """Return the confidence (H, W) uint8, or None if there is none."""
        return None if self.confidence_path is None else read_confidence_png(self.confidence_path)

    def _array(self) -> NDArray[Any]:
        suffix = self.path.suffix.lower()
        if suffix == ".npy":
            return read_npy(self.path)
        if suffix == ".npz":
            return read_npz(self.path, self.key or _only_key(self.path), what=self.what)
        if suffix == ".exr":
            channels = read_exr(self.path)
            name = next((name for name in (*_EXR_CHANNELS, *channels) if name in channels), None)
            if name is None:
                raise InputError(f"{self.path}: an EXR file without channels. Write it again")
            return channels[name]
        data = FilePart(self.path).read_bytes()
        array = decode_picture(data, self.path, cv2.IMREAD_UNCHANGED)
        if array is None:
            raise InputError(f"{self.path}: not an image that can be decoded ({len(data)} bytes). Write it again")
        return np.asarray(array)


@dataclass(frozen=True, eq=False)
class RangeArray:
    """A range map in memory, with the methods of a `RangeFile`."""

    name: str
    array: NDArray[np.floating]
    unit: float = 1.0
    confidence: NDArray[np.uint8] | None = None

    def __str__(self) -> str:
        return f"the array {self.name}"

    def read(self) -> NDArray[np.float32]:
        """Return the range map (H, W) float32; zero, negative and infinite ranges become NaN."""
        if self.array.ndim != 2:
            raise UsageError(f"{self} has the shape {self.array.shape}, expected (height, width)")
        return _positive_or_nan(self.array, self.unit)

    def read_confidence(self) -> NDArray[np.uint8] | None:
        """Return the confidence (H, W) uint8, or None if there is none."""
        return self.confidence


RangeMaps = Path | Mapping[str, "RangeMap | NDArray[np.floating]"]
"""Range maps as a path (see `find_ranges`) or in memory, by image name."""
StoredRange = RangeFile | RangeArray


def find_ranges(source: RangeMaps, *, unit: float = 1.0) -> dict[str, StoredRange]:
    """Return the range maps of a folder or an NPZ file in order, by image name without extension.

    A folder with a subfolder `range` counts as the output of a run, with its `confidence`. In any other folder, all
    files below it with one of the `RANGE_SUFFIXES` are taken; a single `depth.npz` stands for its arrays.

    Raises:
        InputError: if there are no range maps, or an archive is damaged.
    """
    if isinstance(source, Mapping):
        return {name: _in_memory(name, given, unit) for name, given in source.items()}
    if is_file(source) and source.suffix.lower() == ".npz":
        return _in_archive(source, unit)
    if not is_folder(source):
        raise InputError(
            f"{source}: no such folder or .npz file. Give the output folder of a run, or a folder of range maps"
        )
    folder = source / "range" if is_folder(source / "range") else source
    files = [file for file in below(folder) if file.suffix.lower() in RANGE_SUFFIXES and not file.name.startswith(".")]
    archives = [file for file in files if file.suffix == ".npz"]
    if [file.name for file in archives] == ["depth.npz"]:
        return _in_archive(archives[0], unit)
    found: dict[str, StoredRange] = {}
    for file in sorted(files, key=lambda file: (RANGE_SUFFIXES.index(file.suffix.lower()), file)):
        name = file.relative_to(folder).with_suffix("").as_posix()
        confidence = source / "confidence" / f"{name}.png"
        of_run = folder != source and is_file(confidence)
        found.setdefault(name, RangeFile(file, unit=unit, confidence_path=confidence if of_run else None))
    if not found:
        raise InputError(f"{folder}: no range maps here. They may be {', '.join(RANGE_SUFFIXES)}")
    return dict(sorted(found.items()))


def _in_memory(name: str, given: RangeMap | NDArray[np.floating], unit: float) -> RangeArray:
    if isinstance(given, RangeMap):
        return RangeArray(name, given.range, unit, given.confidence)
    return RangeArray(name, given, unit)


def _in_archive(path: Path, unit: float) -> dict[str, StoredRange]:
    keys = keys_of_npz(path)
    if not keys:
        raise InputError(f"{path}: contains no arrays. Use a file with one range map per image")
    return {key: RangeFile(path, key, unit) for key in keys}


def _only_key(path: Path) -> str:
    """Return the name of an archive's only array, or of the one that is named range or depth."""
    inside = list(_in_archive(path, 1.0))
    key = next((name for name in ("range", "depth") if name in inside), inside[0])
    if len(inside) > 1 and key not in ("range", "depth"):
        raise InputError(
            f"{path}: holds {len(inside)} arrays ({', '.join(inside[:3])} …), none of them named 'range'. Rename one, "
            "or give this file itself instead of its folder"
        )
    return key


def _positive_or_nan(array: NDArray[Any], unit: float) -> NDArray[np.float32]:
    with np.errstate(over="ignore", invalid="ignore"):  # what float32 cannot hold becomes infinite, and so NaN
        ranges = array.astype(np.float32) * np.float32(unit)
    return np.where(np.isfinite(ranges) & (ranges > 0), ranges, np.float32(np.nan))


Cameras = Path | Poses | Mapping[str, Rigid3]
"""Poses in any form that `read_poses` reads, as a record, or as cam_from_world by image name."""


def camera_groups(source: Cameras) -> list[Mapping[str, Rigid3]]:
    """Return the cam_from_world by image name of each group of cameras, the largest group first.

    Raises:
        InputError: if a file cannot be read or holds no poses.
    """
    if isinstance(source, Poses):
        return [group.cameras for group in split_groups(source)]
    return [source] if isinstance(source, Mapping) else [group.cameras for group in read_groups(source)]


def read_cameras(source: Cameras) -> tuple[Mapping[str, Rigid3], bool]:
    """Return cam_from_world by image name, of the largest group alone, and whether lengths are known to be metres."""
    if isinstance(source, Path):
        poses = read_poses(source)
        return poses.cameras, poses.metric
    return camera_groups(source)[0], isinstance(source, Poses) and source.metric


def length_unit(*, metric: bool) -> str:
    """Return the unit of lengths for display."""
    return "m" if metric else "units of the truth"


Source = TypeVar("Source")


def as_path(source: Source | str) -> Source | Path:
    """Return a text as a path, and anything else as it is."""
    return Path(source) if isinstance(source, str) else source


def source_name(source: object) -> str:
    """Return the name of an input for display: its path, or its type if it is in memory."""
    return str(source) if isinstance(source, Path) else f"{type(source).__name__} in memory"
