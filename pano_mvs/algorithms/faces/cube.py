"""Join the six faces of a cube into a panorama."""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import InputError
from pano_mvs.geometry import ray_grid

# For each face, its axes to the right, down and forward in the camera frame. As in tours and sky boxes, the lower
# edge of the upper face, and the upper edge of the lower one, lie at the face in front.
CUBE: Mapping[str, tuple[tuple[int, int, int], tuple[int, int, int], tuple[int, int, int]]] = {
    "f": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "r": ((0, 0, -1), (0, 1, 0), (1, 0, 0)),
    "b": ((-1, 0, 0), (0, 1, 0), (0, 0, -1)),
    "l": ((0, 0, 1), (0, 1, 0), (-1, 0, 0)),
    "u": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "d": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
}


def panorama_from_cube(faces: Mapping[str, NDArray[np.uint8]], width: int) -> NDArray[np.uint8]:
    """Return a panorama (width / 2, width, 3) from the faces f, r, b, l, u and d of a cube, (S, S, 3) each.

    Raises:
        InputError: if the faces are not squares of one size.
    """
    side = faces["f"].shape[0]
    if any(face.shape != (side, side, 3) for face in faces.values()):
        sizes = ", ".join(f"{name} {face.shape[1]}×{face.shape[0]}" for name, face in faces.items())
        raise InputError(f"the faces of the cube are not squares of one size ({sizes} px). Export the tour again")
    rays = ray_grid((width // 2, width)).astype(np.float32)
    picture = np.zeros((width // 2, width, 3), np.uint8)
    of_face = np.stack([rays @ np.array(axes[2], np.float32) for axes in CUBE.values()]).argmax(axis=0)
    for number, (name, (right, down, forward)) in enumerate(CUBE.items()):
        inside = of_face == number
        ahead = rays[inside] @ np.array(forward, np.float32)
        x, y = ((rays[inside] @ np.array(axis, np.float32) / ahead + 1) * (side / 2) - 0.5 for axis in (right, down))
        # OpenCV takes fewer than 2^15 rows. The outermost half pixel of a face repeats its border.
        parts = [np.array_split(part[:, None], len(x) // 30_000 + 1) for part in (x, y)]
        sampled = [
            cv2.remap(faces[name], at_x, at_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            for at_x, at_y in zip(*parts, strict=True)
        ]
        picture[inside] = np.concatenate(sampled)[:, 0]
    return picture
