"""Estimated and true range maps of the same images, at the size and in the unit of the truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import InputError, UsageError
from pano_mvs.core.text import shortened_list
from pano_mvs.geometry import pad_panorama
from pano_mvs.io.images.names import find_mask, pair_image_names, require_masks
from pano_mvs.io.truth import RangeMaps, StoredRange, find_ranges, find_true_ranges, source_name
from pano_mvs.scene.masking import Scalar, decode_mask, nearest_pixels, placed_mask


@dataclass(frozen=True, eq=False)
class ViewMaps:
    """The maps of one view, all of the truth's size."""

    estimated: NDArray[np.float32]  # (H, W) float32 in scene units, NaN where there is no estimate
    truth: NDArray[np.float32]  # (H, W) float32 true range, NaN where unknown
    confidence: NDArray[np.uint8] | None  # (H, W) uint8, or None
    counted: NDArray[np.bool_] | None  # (H, W), False excludes a pixel; None counts all
    size_hw: tuple[int, int]  # (height, width) of the estimate before resampling


@dataclass(frozen=True)
class ViewMasks:
    """Masks that exclude pixels (where they are 0) from the scores."""

    # a folder with a mask per image, `<image name>.png` or `<name without extension>.png`, or None
    folder: Path | None = None
    common: Path | None = None  # one mask for all images, or None

    def missing(self, names: Sequence[str]) -> tuple[str, ...]:
        """Return the views without a mask in the folder; none without a folder."""
        return () if self.folder is None else tuple(name for name in names if find_mask(self.folder, name) is None)

    def read(self, name: str, size_hw: tuple[int, int]) -> NDArray[np.bool_] | None:
        """Return the pixels (H, W) of a view that count, None for all."""
        own = None if self.folder is None else find_mask(self.folder, name)
        sphere = (0, 0, size_hw[1], size_hw[0])
        counted = [
            placed_mask(decode_mask(path), size_hw, of=sphere, whole_hw=size_hw)
            for path in (self.common, own)
            if path is not None
        ]
        return np.asarray(np.logical_and.reduce(counted)) if counted else None


@dataclass(frozen=True)
class RangePairs:
    """Range maps and their ground truth."""

    estimates: Mapping[str, StoredRange]
    truths: Mapping[str, StoredRange]
    true_names: Mapping[str, str]
    masks: ViewMasks
    truth_path: Path | None = None
    without_truth: tuple[str, ...] = ()
    without_estimate: tuple[str, ...] = ()

    def read(self, name: str) -> ViewMaps:
        """Return the maps of one view at the truth's size.

        Raises:
            InputError: if a file cannot be read, or the maps are not of one aspect ratio.
        """
        file, true_file = self.estimates[name], self.truths[name]
        truth, found, confidence = true_file.read(), file.read(), file.read_confidence()
        size_hw = truth.shape[0], truth.shape[1]
        try:
            estimated = resized_range(found, size_hw)
            confidence = None if confidence is None else resized_labels(confidence, size_hw)
            counted = self.masks.read(name, size_hw)
        except UsageError as error:
            raise InputError(f"{file} against {true_file}: {error}") from error
        return ViewMaps(estimated, truth, confidence, counted, (found.shape[0], found.shape[1]))


def pair_ranges(source: RangeMaps, truth: RangeMaps, *, unit: float, truth_unit: float, masks: ViewMasks) -> RangePairs:
    """Return estimated and true range maps, paired by image name.

    Raises:
        InputError: if either side has no range maps, they have no image in common, or no mask is of any of them.
    """
    estimates, truths = find_ranges(source, unit=unit), find_true_ranges(truth, unit=truth_unit)
    matched = pair_image_names(estimates, truths)
    if not matched:
        raise InputError(
            f"{source_name(source)} and {source_name(truth)} have no image in common: the first has "
            f"{shortened_list(estimates)}, the other {shortened_list(truths)}. Range maps are paired by their paths "
            "without extension"
        )
    names = {name: matched[name] for name in estimates if name in matched}
    if masks.folder is not None:
        require_masks(masks.folder, list(names))
    return RangePairs(
        {name: estimates[name] for name in names},
        {name: truths[other] for name, other in names.items()},
        names,
        masks,
        truth if isinstance(truth, Path) else None,
        tuple(name for name in estimates if name not in names),
        tuple(name for name in truths if name not in set(names.values())),
    )


# Largest relative difference of four neighbouring ranges on one surface.
_ONE_SURFACE = 0.1


def resized_range(ranges: NDArray[np.float32], size_hw: tuple[int, int]) -> NDArray[np.float32]:
    """Return a range map at the pixel centres of another size.

    If the four pixels around a place lie on one surface (all have a range, within 10 % of each other), 1 / range is
    interpolated bilinearly: on a plane it is nearly linear. Elsewhere, at edges of objects and holes, the pixel that
    contains the place is used, so that no range between two surfaces arises and no hole shrinks.

    Args:
        ranges: (H, W) float32 of a full sphere, NaN invalid, even W.
        size_hw: (height, width) of the result, of the same aspect ratio.

    Returns:
        (height, width) float32; the map itself if it has that size.
    """
    if ranges.shape == size_hw:
        return ranges
    nearest = resized_labels(ranges, size_hw)
    y, x = ((np.arange(new) + 0.5) * old / new + 0.5 for new, old in zip(size_hw, ranges.shape, strict=True))
    row, column = np.floor(y).astype(np.intp), np.floor(x).astype(np.intp)
    down, right = (y - row)[:, None], (x - column)[None, :]
    padded = pad_panorama(ranges.astype(np.float64), 1)
    corners = [padded[np.ix_(row + below, column + beside)] for below in (0, 1) for beside in (0, 1)]
    near, far = np.minimum.reduce(corners), np.maximum.reduce(corners)  # NaN where any of the four is
    shares = [(1 - down) * (1 - right), (1 - down) * right, down * (1 - right), down * right]
    one_surface = far <= near * (1 + _ONE_SURFACE)
    inverse = sum(share / np.where(one_surface, corner, 1.0) for share, corner in zip(shares, corners, strict=True))
    return np.where(one_surface, 1 / inverse, nearest).astype(np.float32)


def resized_labels(labels: NDArray[Scalar], size_hw: tuple[int, int]) -> NDArray[Scalar]:
    """Return a map of labels at the pixel centres of another size: the pixel that contains each centre."""
    height, width = labels.shape
    if height * size_hw[1] != width * size_hw[0]:
        raise UsageError(
            f"a map of {width}×{height} px cannot be compared with one of {size_hw[1]}×{size_hw[0]}: "
            "both must be full panoramas, twice as wide as high"
        )
    return nearest_pixels(labels, size_hw)
