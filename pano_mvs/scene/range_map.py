"""The range of every pixel of one panorama."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from pano_mvs.scene.record import Axis, Parts, Record, require, require_array

MIRROR_CONFIDENCE = 1
WINDOW_CONFIDENCE = 2
FILLED_CONFIDENCE = 3, 63
WEAK_CONFIDENCE = 64, 127
CONSISTENT_CONFIDENCE = 128, 255


@dataclass(frozen=True, eq=False)
class RangeMap(Record):
    """The range of every pixel of a reference view.

    Attributes:
        range: (H, W) float32 distance along the ray in scene units; NaN is invalid.
        confidence: (H, W) uint8: 0 invalid, 1 the pane of a mirror, 2 that of a window, 3–63 filled (interpolated, not
            seen), 64–127 seen but weak, 128–255 consistent with other views.
        normals_in_cam: (H, W, 3) float16 unit normals of the surfaces in the camera frame, towards the camera; NaN
            where unknown. None if they were not computed.
        uncertainty: (H, W) float16 standard deviation of the range relative to it; NaN where unknown, ignored where the
            range is invalid. None if it was not computed.
        sky: (H, W) bool, where the view shows the sky, which has no range. Later stages give it none. None if it was
            not looked for.
    """

    axis: ClassVar[Axis | None] = Axis.VIEW
    kind_version: ClassVar[int] = 2

    range: NDArray[np.float32]
    confidence: NDArray[np.uint8]
    normals_in_cam: NDArray[np.float16] | None = None
    uncertainty: NDArray[np.float16] | None = None
    sky: NDArray[np.bool_] | None = None

    @property
    def valid(self) -> NDArray[np.bool_]:
        """The pixels that have a range, (H, W)."""
        return np.isfinite(self.range)

    def to_parts(self) -> Parts:
        """Return the record as named arrays; without a sky as before there was one."""
        parts = dict(super().to_parts())
        meta = parts["meta"]
        assert isinstance(meta, dict)
        parts["meta"] = {name: value for name, value in meta.items() if name != "sky"}
        return parts

    def check(self) -> None:
        """Raise ContractError unless ranges are positive or NaN, and confidence is 0 exactly where they are NaN."""
        array = require_array(self, "range", dtype=np.float32, shape=(None, None), finite=False)
        confidence = require_array(self, "confidence", dtype=np.uint8, shape=array.shape)
        valid = np.isfinite(array)
        require(bool(np.all(array[valid] > 0)), self, "a range is zero or negative; invalid is NaN")
        require(not np.isinf(array).any(), self, "a range is infinite; invalid is NaN")
        require(
            bool(np.array_equal(confidence > 0, valid)), self, "confidence must be 0 exactly where the range is NaN"
        )
        if self.normals_in_cam is not None:
            normals = require_array(self, "normals_in_cam", dtype=np.float16, shape=(*array.shape, 3), finite=False)
            x, y, z = np.moveaxis(normals, -1, 0).astype(np.float32)  # `norm` over a short last axis is slow
            length = np.sqrt(x * x + y * y + z * z)
            require(not np.any(np.abs(length - 1) > 0.01), self, "a normal is not of unit length; unknown is NaN")
        if self.uncertainty is not None:
            uncertainty = require_array(self, "uncertainty", dtype=np.float16, shape=array.shape, finite=False)
            known = uncertainty[~np.isnan(uncertainty)]
            positive = bool(np.all((known > 0) & (known < np.inf)))
            require(positive, self, "an uncertainty is not positive or infinite; unknown is NaN")
        if self.sky is not None:
            sky = require_array(self, "sky", dtype=np.bool_, shape=array.shape)
            require(not bool((sky & valid).any()), self, "a pixel of the sky has a range")


def confidence_name(confidence: int) -> str:
    """Return what a confidence means: "no range", "mirror", "window", "filled", "seen but weak" or "consistent"."""
    limits = (
        (0, "no range"),
        (MIRROR_CONFIDENCE, "mirror"),
        (WINDOW_CONFIDENCE, "window"),
        (FILLED_CONFIDENCE[1], "filled"),
        (WEAK_CONFIDENCE[1], "seen but weak"),
    )
    return next((name for most, name in limits if confidence <= most), "consistent")
