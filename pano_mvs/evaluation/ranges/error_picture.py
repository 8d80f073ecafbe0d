"""Pictures of where a range map is wrong: the panorama, the estimate, the truth, and the signed error."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.io.images.preview import color_mapped, range_limits, scale_ticks

_WIDTH, _GAP, _CAPTION, _BAR = 1024, 8, 34, 20
_PAPER, _INK, _GREY = (255, 255, 255), (60, 60, 60), (128, 128, 128)
_MISSING = (25, 25, 25)
_QUALITY = 92
# From too near over right to too far; apart for colour-blind eyes as well. Lightness tells how much, hue which way.
_SIGNED = np.array([(16, 44, 110), (50, 116, 190), (158, 202, 232), (245, 245, 242), (246, 190, 130), (210, 92, 40),
                    (116, 18, 18)], np.float64)  # fmt: skip


def write_error_picture(
    path: Path,
    estimated: NDArray[np.floating],
    truth: NDArray[np.floating],
    *,
    image: NDArray[np.uint8] | None = None,
    counted: NDArray[np.bool_] | None = None,
    limit: float = 0.1,
    unit: str = "",
) -> None:
    """Write a JPEG: panorama and signed error above, estimated and true range below, each with its scale.

    The error is estimate / truth − 1: blue where the estimate is too near, white where it is right, red where it is too
    far; black where there is no estimate, grey where nothing is counted.

    Args:
        path: the file to write; its folder is made.
        estimated: (H, W) ranges in the truth's unit, NaN where there is none.
        truth: (H, W) true ranges, NaN where not known.
        image: (h, w, 3) uint8 RGB, the panorama; None leaves its place empty.
        counted: (H, W), False where an error does not count; None: wherever the truth is known.
        limit: the error at the ends of the scale; larger ones have the colour of the end.
        unit: of the ranges, for the captions.
    """
    counted = np.isfinite(truth) if counted is None else counted & np.isfinite(truth)
    lengths = f", {unit}" if unit else ""
    near, far = range_limits(np.where(np.isfinite(truth), truth, estimated).astype(np.float32))
    error = signed_error(estimated, truth)
    empty = np.full((_WIDTH // 2, _WIDTH, 3), 240, np.uint8)
    shown = empty if image is None else cv2.resize(image, (_WIDTH, _WIDTH // 2), interpolation=cv2.INTER_AREA)
    missing = "" if image is not None else ": not given (--images)"
    top = _beside(
        _panel(f"panorama{missing}", np.asarray(shown, np.uint8), None),
        _panel(
            "signed error, estimate / truth - 1",
            _fitted(error_colored(error, limit, counted=counted)),
            _error_bar(limit),
        ),
    )
    bottom = _beside(
        *(
            _panel(f"{what} range{lengths}", _fitted(color_mapped(ranges, near, far)), _range_bar(near, far))
            for what, ranges in (("estimated", estimated.astype(np.float32)), ("true", truth.astype(np.float32)))
        )
    )
    bgr = cv2.cvtColor(np.vstack([top, bottom]), cv2.COLOR_RGB2BGR)
    path.parent.mkdir(parents=True, exist_ok=True)
    # Colours at full resolution: at half of it they bleed over the edges that errors have.
    options = [cv2.IMWRITE_JPEG_QUALITY, _QUALITY,
               cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]  # fmt: skip
    path.write_bytes(bytes(cv2.imencode(".jpg", bgr, options)[1]))


def signed_error(estimated: NDArray[np.floating], truth: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return estimate / truth − 1, (H, W): negative where the estimate is too near, NaN where either is not known."""
    with np.errstate(divide="ignore", invalid="ignore"):
        error = estimated.astype(np.float64) / truth - 1
    return np.where(np.isfinite(error), error, np.nan)


def error_colored(
    error: NDArray[np.float64], limit: float, *, counted: NDArray[np.bool_] | None = None
) -> NDArray[np.uint8]:
    """Return signed errors as colours, (..., 3) RGB: black where NaN, grey where not counted.

    Args:
        error: (...,) from −limit, blue, over 0, white, to limit, red.
        limit: where the scale ends.
        counted: (...,), False is grey; None counts all.
    """
    place = (np.clip(np.nan_to_num(error / limit), -1, 1) + 1) / 2 * (len(_SIGNED) - 1)
    at = np.minimum(place.astype(np.intp), len(_SIGNED) - 2)
    share = (place - at)[..., None]
    colors: NDArray[np.uint8] = np.rint((1 - share) * _SIGNED[at] + share * _SIGNED[at + 1]).astype(np.uint8)
    colors[np.isnan(error)] = _MISSING
    if counted is not None:
        colors[~counted] = _GREY
    return colors


def _fitted(colors: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a picture at the panel's size; colours of a larger one are averaged, those of a smaller one repeated."""
    how = cv2.INTER_AREA if colors.shape[1] > _WIDTH else cv2.INTER_NEAREST
    return np.asarray(cv2.resize(colors, (_WIDTH, _WIDTH // 2), interpolation=how), np.uint8)


def _beside(left: NDArray[np.uint8], right: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.hstack([left, np.full((left.shape[0], _GAP, 3), 255, np.uint8), right])


def _panel(caption: str, picture: NDArray[np.uint8], bar: NDArray[np.uint8] | None) -> NDArray[np.uint8]:
    """Return a picture under its caption and above its scale."""
    head = np.full((_CAPTION, _WIDTH, 3), _PAPER, np.uint8)
    _write(head, caption, 8, _CAPTION - 10)
    foot = np.full((_BAR + 40, _WIDTH, 3), _PAPER, np.uint8) if bar is None else bar
    return np.vstack([head, picture, foot])


def _range_bar(near: float, far: float) -> NDArray[np.uint8]:
    places = (near * (far / near) ** np.linspace(0, 1, 640)).astype(np.float32)
    ticks = {f"{value:g}": float(np.log(value / near) / np.log(far / near)) for value in scale_ticks(near, far)}
    return _bar(color_mapped(places[None], near, far), ticks, {"no range": _GREY})


def _error_bar(limit: float) -> NDArray[np.uint8]:
    places = np.linspace(-limit, limit, 640)[None]
    ticks = {f"{100 * limit * share:+.3g} %" if share else "0": (share + 1) / 2 for share in (-1, -0.5, 0, 0.5, 1)}
    return _bar(error_colored(places, limit), ticks, {"no range": _MISSING, "no truth": _GREY})


def _bar(
    colors: NDArray[np.uint8], ticks: dict[str, float], others: dict[str, tuple[int, int, int]]
) -> NDArray[np.uint8]:
    """Return a strip with a scale of colours, (1, N, 3), numbers at shares of its length, and single colours."""
    strip = np.full((_BAR + 40, _WIDTH, 3), _PAPER, np.uint8)
    left, length = 48, colors.shape[1]
    strip[6 : 6 + _BAR, left : left + length] = colors
    for text, share in ticks.items():
        x = left + round(share * (length - 1))
        cv2.line(strip, (x, 6 + _BAR), (x, 11 + _BAR), _INK, 1)
        _write(strip, text, x - cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.5, 1)[0][0] // 2, 26 + _BAR)
    for idx, (text, color) in enumerate(others.items()):
        x = left + length + 50 + 130 * idx
        cv2.rectangle(strip, (x, 6), (x + _BAR, 6 + _BAR), color, cv2.FILLED)
        _write(strip, text, x + _BAR + 8, _BAR)
    return strip


def _write(strip: NDArray[np.uint8], text: str, x: int, y: int) -> None:
    plain = text.replace("−", "-").encode("ascii", "replace").decode()
    cv2.putText(strip, plain, (x, y), cv2.FONT_HERSHEY_SIMPLEX, 0.5, _INK, 1, cv2.LINE_AA)
