"""Preview images: a panorama above its colour-mapped range, with a scale bar."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.scene.range_map import CONSISTENT_CONFIDENCE, FILLED_CONFIDENCE, MIRROR_CONFIDENCE, WINDOW_CONFIDENCE

Mark = Literal["weak", "filled", "pane"]
MARKS: dict[Mark, str] = {
    "weak": "pale: not confirmed by other views",
    "filled": "striped: filled in, not seen",
    "pane": "chequered: a mirror or window, at its pane",
}
"""What the marks of `mark_unconfirmed` mean."""

_WIDTH = 1280
_BAR_HEIGHT, _MARGIN = 24, 16
_INVALID_GREY = 128
_PAPER, _INK = (255, 255, 255), (60, 60, 60)
_TEXT_SIZE, _TEXT_WEIGHT = 0.9, 2  # legible when the picture is shown at a third of its width


def write_preview(
    path: Path,
    image: NDArray[np.uint8],
    range_map: NDArray[np.float32],
    *,
    mask: NDArray[np.bool_] | None = None,
    confidence: NDArray[np.uint8] | None = None,
) -> None:
    """Write a JPEG of a panorama above its range map, with a scale bar that carries numbers.

    Weak ranges are pale, filled ones striped and panes chequered, with a legend; see `mark_unconfirmed`.

    Args:
        image: (H, W, 3) uint8 RGB.
        range_map: (h, w) float32 range in scene units, NaN where invalid (shown grey).
        mask: (H, W), False where the picture is to be ignored (shown grey), or None.
        confidence: (h, w) uint8 of the ranges, or None.
    """
    height = _WIDTH // 2
    if mask is not None:
        image = np.where(mask[..., None], image, np.uint8(_INVALID_GREY))
    shown = cv2.resize(image, (_WIDTH, height), interpolation=cv2.INTER_AREA)
    resized = cv2.resize(range_map, (_WIDTH, height), interpolation=cv2.INTER_NEAREST)
    near, far = range_limits(resized)
    colors, legend = color_mapped(resized, near, far), []
    if confidence is not None:
        sure = cv2.resize(confidence, (_WIDTH, height), interpolation=cv2.INTER_NEAREST)
        colors, legend = mark_unconfirmed(colors, sure), unconfirmed_classes(confidence)
    strip = np.full((_MARGIN + _BAR_HEIGHT + 46, _WIDTH, 3), _PAPER, np.uint8)
    left, right = 2 * _MARGIN, _WIDTH - 220
    positions = np.linspace(0, 1, right - left, dtype=np.float32)
    ranges = (near * (far / near) ** positions).astype(np.float32)
    bottom = _MARGIN + _BAR_HEIGHT
    strip[_MARGIN:bottom, left:right] = color_mapped(np.tile(ranges, (_BAR_HEIGHT, 1)), near, far)
    for value in scale_ticks(near, far):
        x = left + round((right - left - 1) * np.log(value / near) / np.log(far / near))
        cv2.line(strip, (x, bottom), (x, bottom + 7), _INK, 2)
        _write(strip, f"{value:g}", (x, bottom + 35), centered=True)
    box = (right + 28, _MARGIN), (right + 28 + _BAR_HEIGHT, bottom)
    cv2.rectangle(strip, *box, (_INVALID_GREY,) * 3, cv2.FILLED)
    _write(strip, "no range", (right + 64, bottom - 3), centered=False)
    stack = [shown, np.full((4, _WIDTH, 3), 255, np.uint8), colors, strip]
    if legend:
        stack.append(_legend(legend))
    bgr = cv2.cvtColor(np.vstack(stack), cv2.COLOR_RGB2BGR)
    path.write_bytes(bytes(cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, 88])[1]))


def range_limits(range_map: NDArray[np.float32]) -> tuple[float, float]:
    """Return the near and the far end of a scale that suits a range map: its 1 % and 99 % quantiles, apart."""
    valid = range_map[np.isfinite(range_map)]
    if valid.size == 0:
        return 1.0, 2.0
    near, far = (float(limit) for limit in np.quantile(valid, [0.01, 0.99]))
    middle = np.sqrt(near * far)
    return min(near, middle / 1.1), max(far, middle * 1.1)


def color_mapped(range_map: NDArray[np.float32], near: float, far: float) -> NDArray[np.uint8]:
    """Return a range map as colours, (H, W, 3) RGB: logarithmic from near (red) to far (blue), invalid grey."""
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.log(range_map / near) / np.log(far / near)
    valid = np.isfinite(range_map)
    level = np.where(valid, np.clip(1 - share, 0, 1), 0)
    # The ends of the map are nearly black: its middle 92 % keep their hue.
    colors = cv2.applyColorMap(np.rint((0.04 + 0.92 * level) * 255).astype(np.uint8), cv2.COLORMAP_TURBO)
    rgb: NDArray[np.uint8] = cv2.cvtColor(colors, cv2.COLOR_BGR2RGB)
    rgb[~valid] = _INVALID_GREY
    return rgb


def unconfirmed_classes(confidence: NDArray[np.uint8]) -> list[Mark]:
    """Return which marks `mark_unconfirmed` makes; without confirmed ranges, views were not compared: none is weak."""
    return [mark for mark, pixels in _unconfirmed(confidence).items() if pixels.any()]


def mark_unconfirmed(colors: NDArray[np.uint8], confidence: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the colours of a range map with weak ranges pale, filled ones striped and panes chequered."""
    marked = _unconfirmed(confidence)
    row, column = np.arange(confidence.shape[0])[:, None], np.arange(confidence.shape[1])
    period, thickness = 10, 4  # px
    paper = np.where(np.logical_or.reduce(list(marked.values())), 0.55, 0.0)  # the share of white in the colours
    paper[marked["filled"] & ((row + column) % period < thickness)] = 1.0
    paper[marked["pane"] & ((row // thickness + column // thickness) % 2 == 0)] = 1.0
    mixed = (1 - paper[..., None]) * colors + 255 * paper[..., None]
    return np.asarray(np.rint(mixed), np.uint8)


def _unconfirmed(confidence: NDArray[np.uint8]) -> dict[Mark, NDArray[np.bool_]]:
    """Return the pixels (H, W) of each mark."""
    low, high = FILLED_CONFIDENCE
    confirmed = confidence >= CONSISTENT_CONFIDENCE[0]
    return {
        "weak": (confidence > high) & ~confirmed & confirmed.any(),
        "filled": (confidence >= low) & (confidence <= high),
        "pane": np.isin(confidence, (MIRROR_CONFIDENCE, WINDOW_CONFIDENCE)),
    }


def _legend(classes: Sequence[Mark]) -> NDArray[np.uint8]:
    """Return a strip (h, W, 3) that explains the marks, two in a row."""
    height = _BAR_HEIGHT + _MARGIN
    strip = np.full((-(-len(classes) // 2) * height, _WIDTH, 3), _PAPER, np.uint8)
    codes = {"weak": FILLED_CONFIDENCE[1] + 1, "filled": FILLED_CONFIDENCE[0], "pane": MIRROR_CONFIDENCE}
    for idx, name in enumerate(classes):
        left, top = 2 * _MARGIN + idx % 2 * _WIDTH // 2, idx // 2 * height
        colors = color_mapped(np.full((_BAR_HEIGHT, 3 * _BAR_HEIGHT + 1), 2, np.float32), 1.0, 8.0)
        confidence = np.full(colors.shape[:2], codes[name], np.uint8)
        confidence[:, -1] = CONSISTENT_CONFIDENCE[1]  # so that weak ones are pale
        box = slice(top, top + _BAR_HEIGHT), slice(left, left + 3 * _BAR_HEIGHT)
        strip[box] = mark_unconfirmed(colors, confidence)[:, :-1]
        _write(strip, MARKS[name], (left + 3 * _BAR_HEIGHT + _MARGIN, top + _BAR_HEIGHT - 3), centered=False)
    return strip


def scale_ticks(near: float, far: float) -> list[float]:
    """Return four to ten round numbers within a scale."""
    for steps in (
        (1, 2, 5),
        (1, 1.5, 2, 3, 5, 7),
        tuple(np.arange(10, 100, 2) / 10),
        tuple(np.arange(100, 1000) / 100),
    ):
        decades = range(int(np.floor(np.log10(near))), int(np.ceil(np.log10(far))) + 1)
        ticks = [float(f"{step * 10.0**decade:.3g}") for decade in decades for step in steps]
        inside = [tick for tick in ticks if near <= tick <= far]
        if len(inside) >= 4:
            return inside[:: -(-len(inside) // 10)]
    return [near, far]


def _write(picture: NDArray[np.uint8], text: str, position_xy: tuple[int, int], *, centered: bool) -> None:
    x, y = position_xy
    if centered:
        x -= cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, _TEXT_SIZE, _TEXT_WEIGHT)[0][0] // 2
    cv2.putText(picture, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, _TEXT_SIZE, _INK, _TEXT_WEIGHT, cv2.LINE_AA)
