"""Drawing helpers for error images: strips of text, and image files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from pano_mvs.core.arrays import Picture

WIDTH = 1024
INK = (60, 60, 60)
_MARGIN_PX = 8
_JPEG = [cv2.IMWRITE_JPEG_QUALITY, 92, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]


def strip(height: int, text: str = "") -> Picture:
    """Return a white strip (height, 1024, 3) RGB with a line of text at its left."""
    picture = np.full((height, WIDTH, 3), 255, np.uint8)
    if text:
        put_text(picture, text, (_MARGIN_PX, height - 10))
    return picture


def put_text(picture: Picture, text: str, x_y: tuple[int, int], *, centered: bool = False) -> None:
    """Write text into a picture; what is not ASCII becomes "?"."""
    plain = text.replace("−", "-").encode("ascii", "replace").decode()
    x, y = x_y
    if centered:
        x -= cv2.getTextSize(plain, cv2.FONT_HERSHEY_SIMPLEX, 0.5, 1)[0][0] // 2
    cv2.putText(picture, plain, (x, y), cv2.FONT_HERSHEY_SIMPLEX, 0.5, INK, 1, cv2.LINE_AA)


def write_stack(path: Path, parts: Sequence[Picture]) -> None:
    """Write pictures of one width, stacked vertically, as JPEG or PNG by the file's extension; make its folder."""
    picture = cv2.cvtColor(np.vstack(parts), cv2.COLOR_RGB2BGR)
    suffix = path.suffix.lower()
    # JPEG colours at full resolution: at half of it they bleed over the sharp edges of errors.
    encoded, data = cv2.imencode(suffix, picture, _JPEG if suffix == ".jpg" else [])
    assert encoded
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(bytes(data))
