"""The ranges of a camera as a panorama in colours, with what no other view confirms marked as in previews."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import InputError
from pano_mvs.io.images.preview import color_mapped, mark_unconfirmed, range_limits, unconfirmed_classes
from pano_mvs.io.ranges.files import read_confidence_png, read_range_tiff
from pano_mvs.viewer.shown_scene import ShownCamera
from pano_mvs.viewer.sizes import length_text

# At most this wide, so that stripes are as wide as in previews relative to what they mark.
_WIDTH = 2048
_MEANINGS = {"weak": "pale: not confirmed by other views", "filled": "striped: filled in, not seen"}


def range_panorama(camera: ShownCamera, unit: str) -> tuple[NDArray[np.uint8] | None, str]:
    """Return the ranges of a camera as colours, (H, W, 3) RGB, and their legend.

    Weak ranges are pale and filled ones striped (`mark_unconfirmed`); pixels without a range are grey. Without readable
    ranges, the picture is None and the legend is the reason.

    Args:
        camera: with its files.
        unit: of lengths.
    """
    if camera.range_file is None:
        return None, "no ranges of this camera: the workflow has no export.ranges, or the run did not reach it"
    try:
        ranges = _small(read_range_tiff(camera.range_file))
        confidence = None if camera.confidence_file is None else _small(read_confidence_png(camera.confidence_file))
    except InputError as error:
        return None, str(error)
    near, far = range_limits(ranges)
    colors = color_mapped(ranges, near, far)
    parts = [f"ranges: red {length_text(near, unit)} to blue {length_text(far, unit)}"]
    if confidence is not None and confidence.shape == ranges.shape:
        colors = mark_unconfirmed(colors, confidence)
        parts += [_MEANINGS[name] for name in unconfirmed_classes(confidence)]
    if not np.isfinite(ranges).all():
        parts.append("grey: no range")
    return colors, "\n".join(parts)


def _small(values: NDArray[Any]) -> NDArray[Any]:
    """Return a map at most `_WIDTH` wide, of whole pixels."""
    if values.shape[1] <= _WIDTH:
        return values
    size = _WIDTH, max(1, round(values.shape[0] * _WIDTH / values.shape[1]))
    return np.asarray(cv2.resize(values, size, interpolation=cv2.INTER_NEAREST))
