"""A picture of where a cloud and the true surface lie apart."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import UsageError

_WIDTH, _MARGIN = 1024, 28
_PAPER, _INK, _NOT_COUNTED = (255, 255, 255), (40, 40, 40), (205, 205, 205)
# From right to wrong, apart for colour-blind eyes as well.
_NEAREST, _FARTHEST = np.array([38, 130, 142]), np.array([240, 190, 60])
_BEYOND = (190, 30, 45)


def write_cloud_picture(
    path: Path,
    maps: Mapping[str, NDArray[np.float32]],
    points_in_world: NDArray[np.float32],
    distances: NDArray[np.float32],
    *,
    limits: Sequence[float],
) -> None:
    """Write a PNG: for each view how far its surface is from the cloud, and the cloud from above by its own distance.

    Colours are those of `distance_colors`.

    Args:
        path: the file to write.
        maps: view name to distances (H, W) of its surface; NaN where nothing was to be found.
        points_in_world: (N, 3) the cloud; y is down.
        distances: (N,) from the true surface.
        limits: tolerances in rising order.

    Raises:
        UsageError: if there is no limit.
    """
    if not limits:
        raise UsageError("give at least one limit to colour distances by")
    parts = [distance_legend(limits)]
    for name, panorama in maps.items():
        step = _smallest_step(np.nonzero(~np.isnan(panorama))[0])
        shown = distance_colors(panorama[step // 2 :: step, step // 2 :: step], limits)
        parts += [caption(f"{name}: true surface, by its distance from the cloud"), _scaled(shown)]
    parts += [caption("cloud from above, by its distance from the true surface"),
              _top_view(points_in_world, distances, limits)]  # fmt: skip
    encoded, data = cv2.imencode(".png", cv2.cvtColor(np.vstack(parts), cv2.COLOR_RGB2BGR))
    assert encoded
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(bytes(data))


def _smallest_step(rows: NDArray[np.int64]) -> int:
    """Return every how many rows there are samples."""
    used = np.unique(rows)
    return int(np.diff(used).min()) if len(used) > 1 else 1


def distance_colors(distances: NDArray[np.float32], limits: Sequence[float]) -> NDArray[np.uint8]:
    """Return the colour, (..., 3) uint8 RGB, of each distance (...,).

    That of the smallest limit that it keeps, dark to light, and red beyond the last; grey where NaN.
    """
    shares = np.linspace(0, 1, len(limits))[:, None]
    table = np.vstack([(1 - shares) * _NEAREST + shares * _FARTHEST, _BEYOND]).astype(np.uint8)
    colors = table[np.searchsorted(np.asarray(limits, np.float32), distances.clip(0, np.float32(3e38)))
                   .clip(0, len(limits))]  # fmt: skip
    colors[np.isnan(distances)] = _NOT_COUNTED
    return np.asarray(colors)


def _top_view(
    points: NDArray[np.float32], distances: NDArray[np.float32], limits: Sequence[float]
) -> NDArray[np.uint8]:
    """Return the cloud seen from above, the worst point of each pixel in front, without the outermost 1 %."""
    flat = points[:, [0, 2]].astype(np.float64)
    if not len(flat):
        return np.full((_MARGIN, _WIDTH, 3), _PAPER, np.uint8)
    low, high = np.quantile(flat, [0.005, 0.995], axis=0)
    scale = (_WIDTH - 1) / max(float((high - low).max()), 1e-9)
    size = np.ceil((high - low) * scale).astype(int) + 1
    pixel = np.rint((flat - low) * scale).astype(int)
    inside = ((pixel >= 0) & (pixel < size)).all(axis=1)
    order = np.flatnonzero(inside)[np.argsort(distances[inside], kind="stable")]
    view = np.full((size[1], _WIDTH, 3), _PAPER, np.uint8)
    # z is ahead: it goes up in the picture.
    view[size[1] - 1 - pixel[order, 1], pixel[order, 0]] = distance_colors(distances[order], limits)
    return view


def _scaled(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    size = _WIDTH, round(_WIDTH * image.shape[0] / image.shape[1])
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_NEAREST), np.uint8)


def caption(text: str) -> NDArray[np.uint8]:
    """Return a strip (h, 1024, 3) RGB with a line of text."""
    strip = np.full((_MARGIN, _WIDTH, 3), _PAPER, np.uint8)
    cv2.putText(strip, text, (8, _MARGIN - 9), cv2.FONT_HERSHEY_SIMPLEX, 0.5, _INK, 1, cv2.LINE_AA)
    return strip


def distance_legend(limits: Sequence[float]) -> NDArray[np.uint8]:
    """Return a strip (h, 1024, 3) RGB with the colours of `distance_colors` and the distances for which they stand."""
    strip = np.full((_MARGIN, _WIDTH, 3), _PAPER, np.uint8)
    entries = [(limit, f"up to {limit:g}") for limit in limits] + [(np.inf, "farther"), (np.nan, "not counted")]
    for idx, (distance, text) in enumerate(entries):
        left = 8 + idx * (_WIDTH - 8) // len(entries)
        strip[6 : _MARGIN - 6, left : left + 20] = distance_colors(np.array([distance], np.float32), limits)[0]
        cv2.putText(strip, text, (left + 26, _MARGIN - 9), cv2.FONT_HERSHEY_SIMPLEX, 0.5, _INK, 1, cv2.LINE_AA)
    return strip
