"""Error images of range maps: the panorama, the estimate, the ground truth, and the signed error."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import Picture
from pano_mvs.core.errors import UsageError
from pano_mvs.core.file_names import file_inside, path_inside
from pano_mvs.evaluation.drawing import INK, WIDTH, put_text, strip, write_stack
from pano_mvs.evaluation.ranges.evaluate import DepthEvaluation
from pano_mvs.evaluation.ranges.pairs import RangePairs
from pano_mvs.io.images.captures import PICTURE_SUFFIXES, describe_picture, list_pictures
from pano_mvs.io.images.names import pair_image_names
from pano_mvs.io.images.preview import color_mapped, range_limits, scale_ticks
from pano_mvs.scene import FilePart, Panorama

_HEIGHT, _GAP, _CAPTION, _BAR, _FOOT = WIDTH // 2, 8, 34, 20, 60
_SCALE_LEFT, _SCALE_LENGTH = 48, 640
_GREY, _MISSING = (128, 128, 128), (25, 25, 25)
# From too near over correct to too far; distinguishable for colour-blind readers. Lightness shows the size of an error,
# hue its sign.
_SIGNED = np.array(
    [
        (16, 44, 110),
        (50, 116, 190),
        (158, 202, 232),
        (245, 245, 242),
        (246, 190, 130),
        (210, 92, 40),
        (116, 18, 18),
    ],
    np.float64,
)


def write_depth_pictures(
    folder: Path, evaluation: DepthEvaluation, *, images: Path | None = None, limit: float = 0.1
) -> None:
    """Write a picture of the errors of each view, `<image name>.jpg` (see `write_error_picture`)."""
    if not 0 < limit < float("inf"):
        raise UsageError(f"the error limit must be a positive number, got {limit}")
    panoramas = _panoramas(images, evaluation.pairs)
    for name in evaluation.views:
        maps = evaluation.read_maps(name)
        image = _load(panoramas[name]) if name in panoramas else None
        path = path_inside(folder, f"{name}.jpg")
        write_error_picture(path, maps.estimated, maps.truth, image=image, counted=maps.counted, limit=limit)


def write_error_picture(
    path: Path,
    estimated: NDArray[np.floating],
    truth: NDArray[np.floating],
    *,
    image: Picture | None = None,
    counted: NDArray[np.bool_] | None = None,
    limit: float = 0.1,
) -> None:
    """Write a JPEG with panorama and signed error above, estimated and true range below, each with its scale.

    The error is estimate / truth − 1: blue where the estimate is too near, white where it is correct, red where it is
    too far; black where there is no estimate, grey where no error is counted.

    Args:
        path: the file to write; its folder is made.
        estimated: (H, W) ranges in the truth's unit, NaN where there is none.
        truth: (H, W) true ranges, NaN where unknown.
        image: (h, w, 3) uint8 RGB, the panorama; None leaves its place empty.
        counted: (H, W), False where an error does not count; None: counts wherever the truth is known.
        limit: the error at the ends of the scale; larger ones have the colour of the end.
    """
    counted = np.isfinite(truth) if counted is None else counted & np.isfinite(truth)
    near, far = range_limits(np.where(np.isfinite(truth), truth, estimated).astype(np.float32))
    error = error_colored(signed_error(estimated, truth), limit, counted=counted)
    empty = np.full((_HEIGHT, WIDTH, 3), 240, np.uint8)
    shown = empty if image is None else cv2.resize(image, (WIDTH, _HEIGHT), interpolation=cv2.INTER_AREA)
    panorama = "panorama" if image is not None else "panorama: not given (--images)"
    top = (
        [strip(_CAPTION, panorama), np.asarray(shown, np.uint8), strip(_FOOT)],
        [strip(_CAPTION, "signed error, estimate / truth - 1"), _fitted(error), _error_bar(limit)],
    )
    bottom = [
        [
            strip(_CAPTION, f"{what} range"),
            _fitted(color_mapped(ranges.astype(np.float32), near, far)),
            _range_bar(near, far),
        ]
        for what, ranges in (("estimated", estimated), ("true", truth))
    ]
    gap = np.full((_CAPTION + _HEIGHT + _FOOT, _GAP, 3), 255, np.uint8)
    rows = [np.hstack([np.vstack(left), gap, np.vstack(right)]) for left, right in (top, bottom)]
    write_stack(path, rows)


def signed_error(estimated: NDArray[np.floating], truth: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return estimate / truth − 1, (H, W): negative where the estimate is too near, NaN where either is unknown."""
    with np.errstate(divide="ignore", invalid="ignore"):
        error = estimated.astype(np.float64) / truth - 1
    return np.where(np.isfinite(error), error, np.nan)


def error_colored(error: NDArray[np.float64], limit: float, *, counted: NDArray[np.bool_] | None = None) -> Picture:
    """Return signed errors as colours, (..., 3) RGB: black where NaN, grey where not counted."""
    place = (np.clip(np.nan_to_num(error / limit), -1, 1) + 1) / 2 * (len(_SIGNED) - 1)
    at = np.minimum(place.astype(np.intp), len(_SIGNED) - 2)
    share = (place - at)[..., None]
    colors: Picture = np.rint((1 - share) * _SIGNED[at] + share * _SIGNED[at + 1]).astype(np.uint8)
    colors[np.isnan(error)] = _MISSING
    if counted is not None:
        colors[~counted] = _GREY
    return colors


def _panoramas(images: Path | None, pairs: RangePairs) -> Mapping[str, Path]:
    """Return the panorama of each view that has one."""
    if images is not None:
        files = {path.relative_to(images).as_posix(): path for path in list_pictures(images)}
        return {name: files[other] for name, other in pair_image_names(pairs.truths, files).items()}
    if pairs.truth_path is None:
        return {}
    places = {
        name: [file_inside(folder, other, through_links=True) for folder in (pairs.truth_path, pairs.truth_path.parent)]
        for name, other in pairs.true_names.items()
    }
    found = {name: next(filter(None, paths), None) for name, paths in places.items()}
    return {name: path for name, path in found.items() if path and path.suffix.lower() in PICTURE_SUFFIXES}


def _load(path: Path) -> Picture:
    info = describe_picture(path)
    return Panorama(FilePart(path, external=True), info.size_hw, info.size_hw, crop_ltwh=info.crop_ltwh).load()


def _fitted(colors: Picture) -> Picture:
    """Return a picture at the panel's size: larger ones averaged, smaller ones with repeated pixels."""
    how = cv2.INTER_AREA if colors.shape[1] > WIDTH else cv2.INTER_NEAREST
    return np.asarray(cv2.resize(colors, (WIDTH, _HEIGHT), interpolation=how), np.uint8)


def _range_bar(near: float, far: float) -> Picture:
    places = (near * (far / near) ** np.linspace(0, 1, _SCALE_LENGTH)).astype(np.float32)
    ticks = {f"{value:g}": float(np.log(value / near) / np.log(far / near)) for value in scale_ticks(near, far)}
    return _bar(color_mapped(places[None], near, far), ticks, {"no range": _GREY})


def _error_bar(limit: float) -> Picture:
    places = np.linspace(-limit, limit, _SCALE_LENGTH)[None]
    ticks = {f"{100 * limit * share:+.3g} %" if share else "0": (share + 1) / 2 for share in (-1, -0.5, 0, 0.5, 1)}
    return _bar(error_colored(places, limit), ticks, {"no range": _MISSING, "no truth": _GREY})


def _bar(colors: Picture, ticks: Mapping[str, float], others: Mapping[str, tuple[int, int, int]]) -> Picture:
    """Return a strip with a scale of colours, (1, N, 3), numbers at shares of its length, and single colours."""
    bar = strip(_FOOT)
    bottom, length = 6 + _BAR, colors.shape[1]
    bar[6:bottom, _SCALE_LEFT : _SCALE_LEFT + length] = colors
    for text, share in ticks.items():
        x = _SCALE_LEFT + round(share * (length - 1))
        cv2.line(bar, (x, bottom), (x, bottom + 5), INK, 1)
        put_text(bar, text, (x, bottom + 20), centered=True)
    for idx, (text, color) in enumerate(others.items()):
        x = _SCALE_LEFT + length + 50 + 130 * idx
        cv2.rectangle(bar, (x, 6), (x + _BAR, bottom), color, cv2.FILLED)
        put_text(bar, text, (x + _BAR + 8, _BAR))
    return bar
