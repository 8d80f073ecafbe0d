"""Pictures for docs/masks.md: what masks.static finds, and a cap around the nadir.

    python docs/_pictures/mask_pictures.py

The images are those of the sample, with a drawn stick, hand and sleeve that move with the camera.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from quickstart_pictures import IMAGES, ROOT

from pano_mvs.algorithms.masks.areas import reduced_to_width
from pano_mvs.algorithms.masks.static_content import static_content
from tests.synthetic.rig import stick_and_hand, with_rig

SAMPLE = ROOT / "workflows" / "samples" / "classroom" / "images"
NADIR_DEG = 40.0
RED = np.array([40.0, 40.0, 225.0])
WIDTH = 640

Picture = NDArray[np.uint8]
Mask = NDArray[np.bool_]


def sample_with_stick() -> list[Picture]:
    """Return the panoramas of the sample, RGB, with what moves with the camera drawn into them."""
    pictures = [np.asarray(cv2.imread(str(path)), np.uint8)[..., ::-1] for path in sorted(SAMPLE.glob("*.png"))]
    rng = np.random.default_rng(0)
    return [with_rig(picture, stick_and_hand((512, 1024)), rng=rng) for picture in pictures]


def tinted(picture: Picture, mask: Mask) -> Picture:
    """Return a panorama, BGR, with a mask in red and its outline in white."""
    mask = cv2.resize(mask.astype(np.uint8), picture.shape[1::-1], interpolation=cv2.INTER_NEAREST) > 0
    shown = np.where(mask[..., None], 0.45 * picture[..., ::-1] + 0.55 * RED, picture[..., ::-1]).astype(np.uint8)
    outline = cv2.dilate(mask.astype(np.uint8), np.ones((5, 5), np.uint8)) > mask
    shown[outline] = 255
    return np.asarray(cv2.resize(shown, (WIDTH, WIDTH // 2), interpolation=cv2.INTER_AREA), np.uint8)


if __name__ == "__main__":
    pictures = sample_with_stick()
    valid = np.ones(pictures[0].shape[:2], np.bool_)
    found = static_content([reduced_to_width(picture, valid)[0] for picture in pictures])
    rows = np.arange(512)[:, None] + 0.5
    cap = np.broadcast_to(180 * rows / 512 > 180 - NADIR_DEG, (512, 1024))
    both = np.hstack(
        [tinted(pictures[0], found.pixels), np.full((WIDTH // 2, 12, 3), 255, np.uint8), tinted(pictures[0], cap)]
    )
    cv2.imwrite(str(Path(IMAGES) / "masks_found.jpg"), both, [cv2.IMWRITE_JPEG_QUALITY, 80])
