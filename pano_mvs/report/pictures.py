"""The previews of the views, small enough to travel within the page."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

_MOST = 24
_WIDTH = 1024
_QUALITY = 80


@dataclass(frozen=True)
class Preview:
    """One view as the page shows it.

    Attributes:
        name: of the image.
        data: base64 of a JPEG, or "" where there is no preview.
        size_hw: (height, width) of that JPEG.
        completeness: share of pixels with a range, or None.
        consistent: share of pixels on which other views agree, or None.
    """

    name: str
    data: str
    size_hw: tuple[int, int]
    completeness: float | None
    consistent: float | None


@dataclass(frozen=True)
class Previews:
    """The views that the page shows, and how many there are.

    Attributes:
        shown: at most 24, in the order of the capture.
        total: number of views.
    """

    shown: tuple[Preview, ...]
    total: int


def previews(out_dir: Path, views: Sequence[Mapping[str, Any]]) -> Previews:
    """Return the views to show; of many, the eight least complete and others evenly apart."""
    chosen = range(len(views))
    if len(views) > _MOST:
        by_completeness = sorted(chosen, key=lambda idx: (views[idx].get("completeness") or 0.0, idx))
        worst = by_completeness[: _MOST // 3]
        rest = by_completeness[_MOST // 3 :]
        evenly = [sorted(rest)[round(at)] for at in np.linspace(0, len(rest) - 1, _MOST - len(worst))]
        return Previews(tuple(_preview(out_dir, views[idx]) for idx in sorted({*worst, *evenly})), len(views))
    return Previews(tuple(_preview(out_dir, views[idx]) for idx in chosen), len(views))


def _preview(out_dir: Path, view: Mapping[str, Any]) -> Preview:
    data, size_hw = _embedded(out_dir, str(view.get("preview") or ""))
    return Preview(str(view.get("name", "")), data, size_hw, view.get("completeness"), view.get("consistent"))


def _embedded(out_dir: Path, relative: str) -> tuple[str, tuple[int, int]]:
    """Return a picture below the output folder as base64 JPEG of at most 1024 px width, "" if there is none."""
    path = (out_dir / relative).resolve()
    if not relative or not path.is_relative_to(out_dir.resolve()) or not path.is_file():
        return "", (0, 0)
    image = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_COLOR) if path.stat().st_size else None
    if image is None:
        return "", (0, 0)
    height, width = image.shape[:2]
    if width > _WIDTH:
        height, width = round(height * _WIDTH / width), _WIDTH
        image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1]
    return base64.b64encode(bytes(data)).decode("ascii"), (height, width)
