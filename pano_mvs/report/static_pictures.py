"""Pictures of what moves with the cameras and is therefore masked."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.masks.areas import share_of_sphere
from pano_mvs.core.errors import InputError
from pano_mvs.report.earlier_page import EarlierPage
from pano_mvs.results.pictures import Picture, picture
from pano_mvs.results.stored_values import StoredValues
from pano_mvs.scene import Panorama
from pano_mvs.scene.static_masks import Camera, camera_of

VERSION = 1
"""Raise it when the pictures change: earlier pages' are then drawn again."""

_WIDTH = 640
_MAX_BYTES = 60_000
_MAX_CAMERAS = 6
_TINT = np.array([230.0, 40.0, 40.0])


def static_pictures(results: StoredValues, kept: EarlierPage) -> tuple[tuple[str, float, Picture], ...]:
    """Return (image, share of the sphere, picture) for each camera in which something moves with it, at most six.

    The picture is the first panorama of the camera, tinted where it is masked.
    """
    masks = results.static_masks
    shown = []
    for camera in masks.cameras[:_MAX_CAMERAS] if masks is not None else ():
        assert masks is not None
        found = _first_panorama(results, camera)
        if found is None:
            continue
        name, panorama = found
        pixels = masks.of(panorama)
        assert pixels is not None
        key = f"{results.digest('static')[:24]}.{results.digest('images', name)[:16]}.m{VERSION}"
        try:
            drawn = kept.picture(key) or _picture(panorama, pixels, key)
        except InputError as error:
            results.notes.append(str(error))
            continue
        shown.append((name, share_of_sphere(pixels), drawn))
    return tuple(shown)


def _first_panorama(results: StoredValues, camera: Camera) -> tuple[str, Panorama] | None:
    for name in results.refs.get("images", {}):
        panorama = results.panorama(name)
        if panorama is not None and camera_of(panorama) == camera:
            return name, panorama
    return None


def _picture(panorama: Panorama, pixels: NDArray[np.bool_], key: str) -> Picture:
    image = panorama.load_unmasked().astype(np.float32)
    image[pixels] = 0.5 * image[pixels] + 0.5 * _TINT
    return picture(image.astype(np.uint8), width=_WIDTH, most_bytes=_MAX_BYTES, key=key)
