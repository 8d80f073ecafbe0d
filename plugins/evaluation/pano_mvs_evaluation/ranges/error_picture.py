"""Error images of range maps: the panorama, the estimate, the ground truth, and the signed error."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import Picture
from pano_mvs.core.errors import UsageError
from pano_mvs.core.file_names import file_inside, path_inside
from pano_mvs.io.images.captures import PICTURE_SUFFIXES, list_pictures, panorama_in
from pano_mvs.io.images.names import pair_image_names
from pano_mvs.io.images.preview import color_mapped, range_limits, scale_ticks
from pano_mvs_evaluation.drawing import WIDTH, drawn_figure
from pano_mvs_evaluation.ranges.evaluate import DepthEvaluation
from pano_mvs_evaluation.ranges.pairs import RangePairs

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable

_BAR: Any = {"orientation": "horizontal", "aspect": 50, "pad": 0.01}
# From too near over correct to too far; distinguishable for colour-blind readers. Lightness shows the size of an error,
# hue its sign.
_SIGNED = ("#102c6e", "#3274be", "#9ecae8", "#f5f5f2", "#f6be82", "#d25c28", "#741212")


def write_depth_pictures(
    folder: Path, evaluation: DepthEvaluation, *, images: Path | None = None, limit: float = 0.1
) -> None:
    """Write a picture of the errors of each view, `<image name>.jpg` (see `write_error_picture`)."""
    if not 0 < limit < float("inf"):
        raise UsageError(f"the error limit must be a positive number, got {limit}")
    panoramas = _panoramas(images, evaluation.pairs)
    for name in evaluation.views:
        maps = evaluation.read_maps(name)
        image = panorama_in(panoramas[name]).load() if name in panoramas else None
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
        estimated: (H, W) ranges in the truth's unit, NaN where there is none.
        truth: (H, W) true ranges, NaN where unknown.
        image: (h, w, 3) uint8 RGB, the panorama; None leaves its place empty.
        counted: (H, W), False where an error does not count; None: counts wherever the truth is known.
        limit: the error at the ends of the scale; larger ones have the colour of the end.
    """
    from matplotlib.patches import Patch

    counted = np.isfinite(truth) if counted is None else counted & np.isfinite(truth)
    near, far = range_limits(np.where(np.isfinite(truth), truth, estimated).astype(np.float32))
    colors = range_colors(near, far)
    patches = [Patch(color="#191919", label="no range"), Patch(color="#808080", label="no truth")]
    with drawn_figure(path, (2 * WIDTH, 1200)) as figure:
        figure.set_layout_engine(None)  # takes longer than drawing
        (panorama, errors), *below = figure.subplots(2, 2)
        figure.subplots_adjust(0.02, 0.03, 0.98, 0.96, wspace=0.05, hspace=0.1)
        empty = np.full((1, 2, 3), 240, np.uint8)
        _show(
            panorama, empty if image is None else image, f"panorama{': not given (--images)' if image is None else ''}"
        )
        shown = error_colored(signed_error(estimated, truth), limit, counted=counted)
        _show(errors, shown, "signed error, estimate / truth - 1")
        errors.legend(handles=patches, loc="lower right", bbox_to_anchor=(1, 1), ncols=2, frameon=False)
        figure.colorbar(signed_colors(limit), ax=errors, format=lambda error, _: f"{100 * error:+.3g} %", **_BAR)
        for axes, ranges, what in zip(below[0], (estimated, truth), ("estimated", "true"), strict=True):
            _show(axes, color_mapped(ranges.astype(np.float32), near, far), f"{what} range")
            bar = figure.colorbar(colors, ax=axes, ticks=scale_ticks(near, far), format="{x:g}", **_BAR)
            bar.minorticks_off()


def _show(axes: Axes, picture: Picture, title: str) -> None:
    """Show a picture: larger ones averaged, smaller ones with repeated pixels."""
    how = cv2.INTER_AREA if picture.shape[1] > WIDTH else cv2.INTER_NEAREST
    axes.imshow(cv2.resize(picture, (WIDTH, WIDTH // 2), interpolation=how), interpolation="nearest")
    axes.set_title(title)
    axes.set_axis_off()


def signed_error(estimated: NDArray[np.floating], truth: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return estimate / truth − 1, (H, W): negative where the estimate is too near, NaN where either is unknown."""
    with np.errstate(divide="ignore", invalid="ignore"):
        error = estimated.astype(np.float64) / truth - 1
    return np.where(np.isfinite(error), error, np.nan)


def signed_colors(limit: float) -> ScalarMappable:
    """Return the colours of signed errors, for errors up to ± the limit; NaN is black."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LinearSegmentedColormap, Normalize

    colors = LinearSegmentedColormap.from_list("signed", _SIGNED, N=1024)
    return ScalarMappable(Normalize(-limit, limit), colors.with_extremes(bad="#191919"))


def range_colors(near: float, far: float) -> ScalarMappable:
    """Return the colours of ranges as `color_mapped` gives them."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import ListedColormap, LogNorm

    colors = color_mapped(np.geomspace(near, far, 256, dtype=np.float32)[None], near, far)[0]
    return ScalarMappable(LogNorm(near, far), ListedColormap(colors / 255))


def error_colored(error: NDArray[np.float64], limit: float, *, counted: NDArray[np.bool_] | None = None) -> Picture:
    """Return signed errors as colours, (..., 3) RGB: black where NaN, grey where not counted."""
    colors = np.asarray(signed_colors(limit).to_rgba(np.ma.masked_invalid(error), bytes=True)[..., :3], np.uint8)
    if counted is not None:
        colors[~counted] = 128
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
