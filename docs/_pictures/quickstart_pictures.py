"""Pictures of the documentation, from a run of the quickstart and the pictures that the program itself makes of it.

    pano-mvs run quickstart
    pano-mvs inspect quickstart 000.png 620 330 --plot inspect.png
    python docs/_pictures/quickstart_pictures.py out/quickstart inspect.png

`report_pictures.py` makes those of the report.
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

ROOT = Path(__file__).parents[2]
IMAGES = ROOT / "docs" / "images"
WIDTH = 1200

Picture = NDArray[np.uint8]


def confidence_picture(path: Path) -> Picture:
    """Return a confidence map in colours, (H, W, 3) BGR: consistent teal, seen but weak yellow, filled red."""
    confidence = cv2.imread(str(path), cv2.IMREAD_UNCHANGED).astype(np.float64)[..., None]
    teal, pale = np.array([116.0, 107, 15]), np.array([214.0, 222, 170])
    share = np.clip((confidence - 128) / 127, 0, 1)
    picture = np.where(confidence >= 128, pale + share * (teal - pale), np.array([90.0, 200, 245]))
    picture = np.where(confidence < 64, np.array([60.0, 70, 200]), picture)
    picture = np.where(confidence == 0, 128.0, picture)
    return scaled(np.rint(picture).astype(np.uint8))


def scaled(picture: Picture) -> Picture:
    """Return a picture at the width of the site."""
    height = round(picture.shape[0] * WIDTH / picture.shape[1])
    smaller: Picture = cv2.resize(picture, (WIDTH, height), interpolation=cv2.INTER_AREA)
    return smaller


def write(name: str, picture: Picture) -> None:
    """Write a picture of the documentation."""
    cv2.imwrite(str(IMAGES / name), picture, [cv2.IMWRITE_JPEG_QUALITY, 72])


if __name__ == "__main__":
    out, inspect = map(Path, sys.argv[1:])
    write("quickstart_preview.jpg", scaled(cv2.imread(str(out / "preview" / "000.jpg"))))
    write("quickstart_confidence.jpg", confidence_picture(out / "confidence" / "000.png"))
    write("inspect.jpg", cv2.imread(str(inspect)))
