"""Describe the pixel of a camera in a direction."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import InputError
from pano_mvs.geometry import pixel_from_ray
from pano_mvs.io.ranges.files import read_confidence_png, read_range_tiff
from pano_mvs.scene.range_map import confidence_name
from pano_mvs.viewer.shown_scene import ShownCamera
from pano_mvs.viewer.sizes import length_text


def pixel_readout(camera: ShownCamera, direction_in_world: NDArray[np.float64], unit: str) -> str:
    """Return the pixel of a camera in a direction (3,), with its range and confidence, as text.

    The pixel is that of the range map, as used by `pano-mvs inspect`; without a range map, only angles are returned.
    """
    ray = camera.cam_from_world.rotation @ direction_in_world
    azimuth, elevation = np.rad2deg([np.arctan2(ray[0], ray[2]), np.arcsin(np.clip(-ray[1], -1, 1))])
    angles = f"azimuth {azimuth:z.1f}°, elevation {elevation:z.1f}°"
    if camera.range_file is None:
        return angles
    try:
        ranges = read_range_tiff(camera.range_file)
        confidence = None if camera.confidence_file is None else read_confidence_png(camera.confidence_file)
    except InputError as error:
        return f"{angles}; {error}"
    height, width = ranges.shape
    x, y = pixel_from_ray(ray, (height, width))
    column, row = int(x) % width, min(int(y), height - 1)
    found = float(ranges[row, column])
    said = f"range {length_text(found, unit)}" if np.isfinite(found) else "no range"
    if confidence is not None and confidence.shape == ranges.shape:
        level = int(confidence[row, column])
        said += f", confidence {level} ({confidence_name(level)})"
    return f"pixel {column} {row}: {said}\n{angles}"
