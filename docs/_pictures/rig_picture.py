"""The picture of docs/rigs.md: the seam of two lenses at two stitching distances, beside the room itself.

python docs/_pictures/rig_picture.py
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from quickstart_pictures import IMAGES

from pano_mvs.algorithms.stitching import stitch_lenses
from pano_mvs.geometry import Rigid3, rotation_from_rotvec
from pano_mvs.testing.room import render
from tests.synthetic.fisheye_rig import example_rig, render_rig
from tests.synthetic.scenes import poles

SIZE_HW = (640, 1280)
ROWS, COLUMNS = slice(220, 380), slice(890, 1030)  # around the seam on the right
ENLARGED = 3


def main() -> None:
    """Write the picture."""
    room = poles(turned=False).room
    pose = Rigid3.from_center(rotation_from_rotvec(np.array([0.0, 0.35, 0.0])), (0.1, -0.1, 0.0))
    rig = example_rig(size_px=760, offset_m=0.06)
    pictures = render_rig(room, rig, pose, supersample=2)
    shown = [render(room, pose, SIZE_HW)[0]]
    for distance in (np.inf, 2.0):
        shown.append(stitch_lenses(pictures, replace(rig, stitch_distance_m=distance), size_hw=SIZE_HW)[0])
    crops = [
        cv2.resize(picture[ROWS, COLUMNS], None, fx=ENLARGED, fy=ENLARGED, interpolation=cv2.INTER_CUBIC)
        for picture in shown
    ]
    gap = np.full((len(crops[0]), 8, 3), 255, np.uint8)
    parts = [part for crop in crops for part in (crop, gap)][:-1]
    joined = cv2.cvtColor(np.concatenate(parts, axis=1), cv2.COLOR_RGB2BGR)
    cv2.imwrite(str(IMAGES / "rig_seam.jpg"), joined, [cv2.IMWRITE_JPEG_QUALITY, 88])


if __name__ == "__main__":
    main()
