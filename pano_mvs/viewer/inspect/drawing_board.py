"""Lines and letters, drawn large by OpenCV and shrunk, which makes them smooth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

Color: TypeAlias = tuple[int, int, int]
Spot: TypeAlias = tuple[float, float]

_FINE = 2
_PAPER = (255, 255, 255)
_DASH = 7


@dataclass(frozen=True)
class Letters:
    """How text is written.

    Attributes:
        scale: OpenCV's; capitals are about 22 times as many pixels high.
        color: RGB.
        align: 0: the text begins at its spot, ½: it is centred there, 1: it ends there.
    """

    scale: float = 0.46
    color: Color = (45, 45, 50)
    align: float = 0.0


class DrawingBoard:
    """A white picture to draw on; spots are (x, y) in pixels of the finished picture."""

    def __init__(self, size_hw: tuple[int, int]) -> None:
        self._size_hw = size_hw
        self._canvas = np.full((_FINE * size_hw[0], _FINE * size_hw[1], 3), _PAPER, np.uint8)

    def line(self, spots: Sequence[Spot], color: Color, weight: int = 1) -> None:
        """Draw a line through spots."""
        placed = np.rint(np.array(spots) * _FINE).astype(np.int32)
        cv2.polylines(self._canvas, [placed], False, color, weight * _FINE, cv2.LINE_AA)

    def dashes(self, start: Spot, end: Spot, color: Color) -> None:
        """Draw a broken line."""
        a, b = np.array(start), np.array(end)
        count = max(2, int(np.linalg.norm(b - a) / _DASH))
        for idx in range(0, count, 2):
            first, last = (a + (b - a) * min(1.0, (idx + step) / count) for step in (0, 1))
            self.line([(first[0], first[1]), (last[0], last[1])], color)

    def dot(self, spot: Spot, color: Color, *, filled: bool) -> None:
        """Draw a dot, or a ring."""
        center = round(spot[0] * _FINE), round(spot[1] * _FINE)
        cv2.circle(self._canvas, center, 6 * _FINE, _PAPER, cv2.FILLED, cv2.LINE_AA)
        cv2.circle(self._canvas, center, 5 * _FINE, color, cv2.FILLED if filled else 2 * _FINE, cv2.LINE_AA)

    def write(self, text: str, spot: Spot, letters: Letters, *, on_paper: bool = False) -> float:
        """Write text, its base line at the spot, and return its width in pixels; OpenCV's letters are ASCII alone.

        Args:
            text: what to write; other letters become question marks.
            spot: where.
            letters: how.
            on_paper: whether to lay paper below the letters, over what is drawn there.
        """
        scale = letters.scale * _FINE
        weight = max(1, round(1.4 * scale))
        shown = text.encode("ascii", "replace").decode()
        (width, height), below = cv2.getTextSize(shown, cv2.FONT_HERSHEY_SIMPLEX, scale, weight)
        x, y = round(spot[0] * _FINE - letters.align * width), round(spot[1] * _FINE)
        if on_paper:
            corners = (x - 2 * _FINE, y - height - _FINE), (x + width + 2 * _FINE, y + below // 2)
            cv2.rectangle(self._canvas, *corners, _PAPER, cv2.FILLED)
        cv2.putText(self._canvas, shown, (x, y), cv2.FONT_HERSHEY_SIMPLEX, scale, letters.color, weight, cv2.LINE_AA)
        return float(width / _FINE)

    def picture(self) -> NDArray[np.uint8]:
        """Return what is drawn, (H, W, 3) RGB."""
        return np.asarray(cv2.resize(self._canvas, self._size_hw[::-1], interpolation=cv2.INTER_AREA), np.uint8)
