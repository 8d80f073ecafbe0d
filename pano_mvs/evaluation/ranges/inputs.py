"""What `evaluate depth` compares: two sets of range maps, and what is known beside them."""

from __future__ import annotations

import glob
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import InputError, UsageError
from pano_mvs.core.paths import children, is_file, is_folder
from pano_mvs.evaluation.poses.errors import align_centers
from pano_mvs.evaluation.ranges.folders import RangeFile, find_ranges, match_pictures, without_extension
from pano_mvs.evaluation.truth import find_true_ranges
from pano_mvs.geometry import Rigid3
from pano_mvs.io.images.captures import PICTURE_SUFFIXES, describe_picture, list_pictures
from pano_mvs.io.poses.files import read_groups, read_poses
from pano_mvs.scene import FilePart, Panorama
from pano_mvs.scene.masking import decode_mask, placed_mask


@dataclass(frozen=True)
class DepthInputs:
    """Range maps and their truth, by the names of the estimates.

    Attributes:
        estimates: name to range map.
        truths: name to true range map, of the names that have both.
        true_names: name to what the truth calls it.
        without_truth: estimates that have none.
        without_estimate: names that the truth knows and nobody estimated.
    """

    estimates: Mapping[str, RangeFile]
    truths: Mapping[str, RangeFile]
    true_names: Mapping[str, str] = field(default_factory=dict)
    without_truth: tuple[str, ...] = ()
    without_estimate: tuple[str, ...] = ()


@dataclass(frozen=True)
class FoundScale:
    """What the estimates are multiplied by to have the truth's unit.

    Attributes:
        value: the factor; with several groups of poses, that of the largest one.
        reason: where it comes from.
        others: image of another group to that group's factor; NaN where it cannot be known.
    """

    value: float
    reason: str
    others: Mapping[str, float] = field(default_factory=dict)

    def of_views(self, names: Iterable[str]) -> dict[str, float]:
        """Return the factor of each view; views without one are left out."""
        listed = list(names)
        groups = match_pictures(listed, self.others)
        factors = {name: self.others[groups[name]] if name in groups else self.value for name in listed}
        return {name: factor for name, factor in factors.items() if np.isfinite(factor)}


def find_inputs(source: Path, truth: Path, *, unit: float, truth_unit: float) -> DepthInputs:
    """Return the range maps of two folders or files, paired by the pictures' names.

    Raises:
        InputError: if either holds none, or no picture is in both.
    """
    estimates, truths = find_ranges(source, unit=unit), find_true_ranges(truth, unit=truth_unit)
    names = match_pictures(estimates, truths)
    if not names:
        raise InputError(f"{source} and {truth} have no picture in common: the one has {_some(estimates)}, the other "
                         f"{_some(truths)}. Range maps are paired by their paths without extension")  # fmt: skip
    ours = {name: names[name] for name in estimates if name in names}
    return DepthInputs(
        estimates,
        {name: truths[true_name] for name, true_name in ours.items()},
        ours,
        tuple(name for name in estimates if name not in ours),
        tuple(name for name in truths if name not in set(ours.values())),
    )


def find_scale(source: Path, truth: Path, given: str, poses: Path | None, true_poses: Path | None) -> FoundScale:
    """Return the factor from the estimates' unit to the truth's, from the cameras' centres unless it is given.

    Args:
        source: whose range maps are estimates; its poses are used if it holds any.
        truth: likewise of the truth.
        given: a number, or "auto".
        poses: the estimated poses, in any form that `read_poses` takes; None: those in `source`.
        true_poses: likewise of the truth.

    Raises:
        UsageError: if a number is no positive one, or poses that were given determine no scale.
        InputError: if poses that were given cannot be read.
    """
    if given != "auto":
        return FoundScale(_positive(given), "as given")
    named = poses is not None or true_poses is not None
    try:
        estimated, true = _poses(poses or source), _poses(true_poses or truth)
    except InputError as error:
        if named:
            raise
        return FoundScale(1.0, f"no poses on both sides, so both are taken to have one unit ({error})")
    names = match_pictures(estimated, true)
    try:
        aligned = align_centers(estimated, {name: true[other] for name, other in names.items()})
    except UsageError as error:
        if named:
            raise
        return FoundScale(1.0, f"the poses determine no scale, so both are taken to have one unit ({error})")
    reason = f"from the centres of {len(names)} cameras, never from the ranges"
    others: dict[str, float] = {}
    for number, group in enumerate(read_groups(source)[1:] if poses is None else [], start=1):
        cameras = {name: group.cam_from_world(idx) for idx, name in enumerate(group.names)}
        ours = match_pictures(cameras, true)
        try:
            factor = align_centers(cameras, {name: true[other] for name, other in ours.items()}).scale
            reason += f"; those of group {number}, which has a unit of its own, × {factor:.6g}"
        except UsageError as error:
            factor = float("nan")
            reason += f"; the {len(cameras)} of group {number} are not judged: {error}"
        others |= dict.fromkeys(cameras, factor)
    return FoundScale(aligned.scale, reason, others)


def mask_reader(
    masks: Path | None, mask: Path | None, names: Iterable[str]
) -> Callable[[str, tuple[int, int]], NDArray[np.bool_] | None]:
    """Return what gives, for a name and (height, width), the pixels that count, or None for all.

    Args:
        masks: a folder of masks by picture, `<image name>.png` or `<name without extension>.png`; 0 is left out.
        mask: one more for all pictures.
        names: of the views that are judged.

    Raises:
        InputError: if the folder is none, or holds no mask of any view.
    """
    if masks is not None and not is_folder(masks):
        raise InputError(f"{masks}: masks must be a folder. Give one mask for all pictures as --mask")
    names = list(names)
    if masks is not None and not any(_mask_of(masks, name) for name in names):
        raise InputError(f"{masks}: no mask in it belongs to a view. That of {names[0]} must be called like the "
                         f"picture with .png behind, or {without_extension(names[0])}.png")  # fmt: skip

    def read(name: str, size_hw: tuple[int, int]) -> NDArray[np.bool_] | None:
        paths = [mask] if mask is not None else []
        if masks is not None and (own := _mask_of(masks, name)) is not None:
            paths.append(own)
        sphere = (0, 0, size_hw[1], size_hw[0])
        counted = [placed_mask(decode_mask(path), size_hw, of=sphere, whole_hw=size_hw) for path in paths]
        return np.asarray(np.logical_and.reduce(counted)) if counted else None

    return read


def views_without_mask(masks: Path | None, names: Iterable[str]) -> tuple[str, ...]:
    """Return the views that have no mask in a folder of masks, none if there is no such folder."""
    return () if masks is None else tuple(name for name in names if _mask_of(masks, name) is None)


def picture_reader(images: Path | None, truth: Path, inputs: DepthInputs) -> Callable[[str], NDArray[np.uint8] | None]:
    """Return what gives a name's panorama, (H, W, 3) RGB, or None where it is not known.

    Args:
        images: the folder of the capture; None: where the truth's poses.json says that they are.
        truth: the truth's folder.
        inputs: whose pictures.
    """
    if images is not None:
        files = {path.relative_to(images).as_posix(): path for path in list_pictures(images)}
        paths = {name: files[other] for name, other in match_pictures(inputs.truths, files).items()}
    else:
        places = {name: (truth / other, truth.parent / other) for name, other in inputs.true_names.items()}
        found = {name: next((path for path in pair if is_file(path)), None) for name, pair in places.items()}
        paths = {name: path for name, path in found.items() if path is not None}
        paths = {name: path for name, path in paths.items() if path.suffix.lower() in PICTURE_SUFFIXES}

    def read(name: str) -> NDArray[np.uint8] | None:
        if name not in paths:
            return None
        info = describe_picture(paths[name])
        file = FilePart(paths[name], external=True)
        return Panorama(file, info.size_hw, info.size_hw, crop_ltwh=info.crop_ltwh).load()

    return read


def _mask_of(masks: Path, name: str) -> Path | None:
    """Return the mask of a picture: COLMAP's name of it, the picture's with .png behind, before the bare one."""
    plain = without_extension(name)
    own = [f"{name}.png"] if name != plain else []
    place, stem = (masks / plain).parent, PurePosixPath(plain).name
    beside = (path for path in children(place, f"{glob.escape(stem)}.*.png")
              if without_extension(path.stem) == stem)  # fmt: skip
    tried = [*(masks / path for path in own), *beside, masks / f"{plain}.png"]
    return next((path for path in tried if is_file(path)), None)


def _poses(path: Path) -> dict[str, Rigid3]:
    poses = read_poses(path)
    return {name: poses.cam_from_world(idx) for idx, name in enumerate(poses.names)}


def _positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not 0 < value < float("inf"):
        raise UsageError(f"'{text}' is no scale: give a positive number, or auto to find it from the cameras' centres")
    return value


def _some(names: Mapping[str, RangeFile]) -> str:
    shown = ", ".join(list(names)[:3])
    return shown + (f" … ({len(names)} in all)" if len(names) > 3 else "")
