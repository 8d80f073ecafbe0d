"""Ground truth beside a capture: poses.json and depth.npz."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import InputError
from pano_mvs.core.paths import exists, is_file
from pano_mvs.evaluation.ranges.folders import RangeFile, find_ranges
from pano_mvs.geometry import Rigid3
from pano_mvs.io.images.names import match_image_names
from pano_mvs.io.poses.json_files import PosedView, read_posed_views
from pano_mvs.io.ranges.npy import keys_of_npz, read_npz


@dataclass(frozen=True)
class TruthView:
    """What is known of one picture.

    Attributes:
        name: the picture's name, as the truth has it.
        cam_from_world: its true pose.
        range_key: the name of its range map in depth.npz, or None where there is none.
        sha256: of the picture's bytes in hex, or None: tells a picture of the same name from the right one.
    """

    name: str
    cam_from_world: Rigid3
    range_key: str | None
    sha256: str | None


@dataclass(frozen=True)
class Truth:
    """Ground truth of a capture; ranges are read when they are asked for.

    Attributes:
        folder: where it lies.
        views: image name to what is known of it; names are those of poses.json.
        metric: whether lengths are metres.
    """

    folder: Path
    views: Mapping[str, TruthView]
    metric: bool

    @property
    def poses(self) -> dict[str, Rigid3]:
        """The true cam_from_world of each image."""
        return {name: view.cam_from_world for name, view in self.views.items()}

    def match(self, names: list[str]) -> dict[str, TruthView]:
        """Return the views that belong to images of a capture, by the capture's names (folders may differ)."""
        return {name: self.views[known] for name, known in match_image_names(names, self.views).items()}

    def range_map(self, view: TruthView) -> NDArray[np.float32] | None:
        """Return the true range (H, W) float32 of a view, NaN where there is no surface, or None if not known.

        Raises:
            InputError: if the file is damaged.
        """
        if view.range_key is None:
            return None
        path = self.folder / "depth.npz"
        array = read_npz(path, view.range_key, what=f"the range map of {view.name}")
        if array.ndim != 2 or array.dtype.kind not in "fiu":
            raise InputError(f"{path}: {view.range_key} has shape {array.shape} of {array.dtype}, expected numbers "
                             "(H, W)")  # fmt: skip
        with np.errstate(over="ignore", invalid="ignore"):  # what float32 cannot hold becomes infinite, and so unknown
            array = array.astype(np.float32)
        return np.where(np.isfinite(array) & (array > 0), array, np.float32(np.nan))


def read_truth(folder: Path) -> Truth:
    """Return the ground truth in a folder: poses.json, and depth.npz if it is there.

    A view's range map is looked up in depth.npz by its picture's path, with and without extension, then by the end of
    that path down to its stem, then by its id with three digits. Views without a range map, and range maps without a
    view, do no harm.

    Raises:
        InputError: if poses.json is missing or malformed, or depth.npz is damaged, or one of its arrays might be that
            of several pictures.
    """
    posed, metric = read_posed_views(folder / "poses.json")
    keys = _range_keys(folder / "depth.npz")
    claimed = _claimed_keys(folder / "depth.npz", posed, keys)
    views = {
        view.name: TruthView(view.name, view.cam_from_world, claimed.get(view.name), view.sha256) for view in posed
    }
    return Truth(folder, views, metric)


def find_true_ranges(path: Path, *, unit: float = 1.0) -> dict[str, RangeFile]:
    """Return the true range maps in a folder or file, by the picture's name.

    Args:
        path: a folder with poses.json and depth.npz as of `read_truth`, or anything that `find_ranges` takes: a folder
            of range maps, the output of a run, an .npz file with one array for each picture.
        unit: what a 1 in the files stands for.

    Raises:
        InputError: if there are none, or a file is damaged.
    """
    if not (is_file(path / "poses.json") and is_file(path / "depth.npz")):
        return find_ranges(path, unit=unit)
    views = read_truth(path).views.values()
    found = {view.name: RangeFile(path / "depth.npz", view.range_key, unit) for view in views if view.range_key}
    if not found:
        raise InputError(f"{path / 'depth.npz'}: holds no array called like a picture of poses.json, or like its id")
    return found


def _range_keys(path: Path) -> frozenset[str]:
    """Return the names of the arrays in an .npz file; none if there is no such file."""
    return frozenset(keys_of_npz(path)) if exists(path) else frozenset()


def _claimed_keys(path: Path, views: Sequence[PosedView], keys: frozenset[str]) -> dict[str, str]:
    """Return the array of each view that has one, by the view's name.

    Raises:
        InputError: if one array might be that of several views.
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
            raise InputError(f"{path}: the array {key} might be that of {owners[key]} or of {view.name}. Call the "
                             f"arrays like the pictures with their folders, such as {whole[view.name][0]}")  # fmt: skip
        owners[key], claimed[view.name] = view.name, key
    return claimed


def _first(tried: Sequence[str], keys: frozenset[str]) -> str | None:
    return next((key for key in tried if key in keys), None)


def _short_keys(view: PosedView) -> list[str]:
    """Return what the array of a view may be called besides its whole name, the longest first, at last its number."""
    parts = view.name.split("/")
    ends = ["/".join(parts[start:]) for start in range(1, len(parts))]
    numbered = [] if view.number is None else [f"{view.number:03d}"]
    return [key for end in ends for key in (end.rsplit(".", 1)[0], end)] + numbered
