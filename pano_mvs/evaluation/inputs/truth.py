"""Ground truth of a capture: a folder with poses.json and depth.npz."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import InputError
from pano_mvs.core.paths import exists, is_file
from pano_mvs.evaluation.inputs.range_files import RangeFile, RangeMaps, StoredRange, find_ranges
from pano_mvs.geometry import Rigid3
from pano_mvs.io.images.names import match_image_names
from pano_mvs.io.poses.json_files import PosedView, read_posed_views
from pano_mvs.io.ranges.npy import keys_of_npz
from pano_mvs.scene import FilePart


@dataclass(frozen=True)
class TruthView:
    """Ground truth of one image.

    Attributes:
        name: the image's name in the truth.
        cam_from_world: its true pose.
        range_file: its true range map, or None.
        sha256: hex digest of the image file, or None; distinguishes different images of the same name.
    """

    name: str
    cam_from_world: Rigid3
    range_file: RangeFile | None
    sha256: str | None

    def belongs_to(self, image: FilePart) -> bool:
        """Return whether an image file has the bytes that the truth states, if it states any.

        Raises:
            InputError: if the file cannot be read.
        """
        return self.sha256 is None or image.sha256() == self.sha256


@dataclass(frozen=True)
class Truth:
    """Ground truth of a capture; range maps are read on demand.

    Attributes:
        folder: the folder that holds it.
        views: image name, as in poses.json, to ground truth.
        metric: whether lengths are metres.
    """

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
        """Return the true range (H, W) float32 of a view, NaN where there is no surface; None without a range map.

        Raises:
            InputError: if the file is damaged.
        """
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

    Args:
        truth: a folder with poses.json and depth.npz (see `read_truth`), or anything that `find_ranges` accepts.
        unit: factor from the stored numbers to the wanted unit.

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
    """Return the array of each view that has one, by the view's name.

    Raises:
        InputError: if an array might belong to several views.
    """
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
