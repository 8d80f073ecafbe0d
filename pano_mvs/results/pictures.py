"""Images embedded in a page: which are chosen, and JPEG files of limited size as data URIs."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.file_names import file_inside

_QUALITIES = (82, 70, 55, 40)

Item = TypeVar("Item")


@dataclass(frozen=True)
class Picture:
    """One picture of the page."""

    uri: str  # `data:image/jpeg;base64,…`
    size_hw: tuple[int, int]
    key: str = ""  # by which a later page can reuse it; "" if it cannot


def picture(image: NDArray[np.uint8], *, width: int, most_bytes: int, key: str = "") -> Picture:
    """Return an image as JPEG, reducing its quality and then its size until it fits into `most_bytes`.

    Args:
        image: (H, W, 3) uint8 RGB.
        width: in pixels, at most.
        most_bytes: of the JPEG, before base64 encoding.
    """
    shown = resized(image, width)
    while True:
        bgr = cv2.cvtColor(shown, cv2.COLOR_RGB2BGR)
        for quality in _QUALITIES:
            data = bytes(cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])[1])
            if len(data) <= most_bytes or (min(shown.shape[:2]) <= 32 and quality == _QUALITIES[-1]):
                size_hw = int(shown.shape[0]), int(shown.shape[1])
                return Picture(f"data:image/jpeg;base64,{base64.b64encode(data).decode('ascii')}", size_hw, key)
        shown = resized(shown, shown.shape[1] * 3 // 4)


def evenly_spaced(items: Sequence[Item], most: int) -> list[Item]:
    """Return at most `most` items, evenly spaced, with the first and the last.

    >>> evenly_spaced("abcde", 3)
    ['a', 'c', 'e']
    """
    places = np.linspace(0, len(items) - 1, min(len(items), most)) if items else ()
    return [items[round(place)] for place in places]


def resized(image: NDArray[np.uint8], width: int) -> NDArray[np.uint8]:
    """Return an image of at most a width."""
    if image.shape[1] <= width:
        return image
    size = width, max(1, round(image.shape[0] * width / image.shape[1]))
    smaller: NDArray[np.uint8] = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return smaller


def preview_panels(out_dir: Path, relative: str, *, small: bool = False) -> tuple[NDArray[np.uint8], ...]:
    """Return the panorama and the range map of a preview, (H, W, 3) RGB each; () for other files.

    Args:
        out_dir: the output folder, outside of which nothing is read.
        relative: the preview's path below it.
        small: decode at an eighth of the size, which is faster.
    """
    path = file_inside(out_dir, relative)
    if path is None:
        return ()
    data = np.fromfile(path, np.uint8)
    image = cv2.imdecode(data, cv2.IMREAD_REDUCED_COLOR_8 if small else cv2.IMREAD_COLOR) if len(data) else None
    if image is None or image.shape[0] < image.shape[1] or image.shape[1] < 2:
        return ()
    rgb: NDArray[np.uint8] = cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
    height = rgb.shape[1] // 2
    # They are separated by a white line; the scale is below.
    start = height if small else height + 4
    return rgb[:height], rgb[start : start + height]
