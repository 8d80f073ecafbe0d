"""How a stereo picture or video shows both eyes, by its metadata or by what it shows."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import InputError
from pano_mvs.scene.stereo import StereoLayout, is_stereo, layout_by_shape

_XMP = re.compile(rb"GSpherical:StereoMode\s*(?:>|=\s*[\"'])\s*(mono|left-right|top-bottom)")
_BOX = re.compile(rb"st3d\0{4}([\0-\2])", re.DOTALL)
_LAYOUTS: dict[bytes, StereoLayout] = {
    b"mono": "none",
    b"top-bottom": "top_bottom",
    b"left-right": "left_right",
    b"\0": "none",
    b"\1": "top_bottom",
    b"\2": "left_right",
}


def stereo_layout(
    path: Path, size_hw: tuple[int, int], metadata: bytes, *, picture: Callable[[], NDArray[np.uint8] | None]
) -> StereoLayout:
    """Return how a picture, or a frame of a video, shows both eyes; "none" if it shows one.

    The metadata count: Google's spherical video, version 1 (`GSpherical:StereoMode` in XMP) or 2 (the box `st3d`).
    Without them, a square picture, or one four times as wide as high, is stereo if its halves are nearly equal.

    Args:
        path: the file, for messages.
        size_hw: (height, width) of the picture.
        metadata: the bytes in which they are searched.
        picture: returns the picture, (H, W, 3); called only if it is needed.

    Raises:
        InputError: if both eyes are beside each other in a picture twice as wide as high, as in VR180.
    """
    if match := _BOX.search(metadata) or _XMP.search(metadata):
        stated = _LAYOUTS[match[1]]
        if stated == "left_right" and size_hw[1] <= 2 * size_hw[0]:
            raise InputError(
                f"{path}: both eyes are beside each other in {size_hw[1]}×{size_hw[0]} px, as in VR180, which shows "
                "only half of the sphere and cannot be used. If each eye shows the full sphere, set stereo: left_right"
            )
        return stated
    layout = layout_by_shape(size_hw)
    shown = None if layout == "none" else picture()
    return layout if shown is not None and is_stereo(shown, layout) else "none"
