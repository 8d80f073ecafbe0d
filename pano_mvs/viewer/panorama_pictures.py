"""Images for the spheres of cameras, at the size at which they are shown."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import InputError
from pano_mvs.io.images.captures import describe_picture
from pano_mvs.scene.image_files.image_file import decode_image
from pano_mvs.viewer.shown_scene import ShownCamera

SMALL_WIDTH, LARGE_WIDTH = 512, 4096
# Shown without an image: a uniform ball, lighter at the top, which shows the up direction.
_SKY, _GROUND = (150, 160, 175), (90, 95, 105)


def sphere_picture(camera: ShownCamera, width: int) -> NDArray[np.uint8]:
    """Return a camera's panorama, (H, W, 3) RGB, at most `width` wide; for small sizes, from the preview.

    A damaged or missing image is replaced by a uniform one, so that the rest can be viewed.
    """
    files = (camera.preview, camera.picture) if width <= SMALL_WIDTH else (camera.picture, camera.preview)
    for path in files:
        if path is None:
            continue
        try:
            picture = _panorama_in(path, preview=path == camera.preview)
        except InputError:
            continue
        return _at_most(picture, width)
    rows = np.linspace(_SKY, _GROUND, 64)[:, None]
    return np.ascontiguousarray(np.broadcast_to(rows, (64, 128, 3)).astype(np.uint8))


def _panorama_in(path: Path, *, preview: bool) -> NDArray[np.uint8]:
    picture = decode_image(path)
    if preview:
        return picture[: picture.shape[1] // 2]
    info = describe_picture(path)
    if info.crop_ltwh is None:
        return picture
    left, top, width, height = info.crop_ltwh
    sphere = np.zeros((*info.size_hw, 3), np.uint8)
    sphere[top : top + height, left : left + width] = picture
    return sphere


def _at_most(picture: NDArray[np.uint8], width: int) -> NDArray[np.uint8]:
    if picture.shape[1] <= width:
        return np.ascontiguousarray(picture)
    size = width, max(1, round(picture.shape[0] * width / picture.shape[1]))
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)
