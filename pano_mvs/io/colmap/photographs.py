"""Photographs in COLMAP models: each has a camera of its own and no key points."""

from __future__ import annotations

from typing import Any

import numpy as np

from pano_mvs.scene.photographs import Photographs


def add_photographs(model: Any, photographs: Photographs, *, first_camera: int, first_image: int) -> None:
    """Add photographs to a pycolmap.Reconstruction, with SIMPLE_RADIAL cameras, or PINHOLE ones without distortion.

    Args:
        model: the model.
        photographs: in the world of the model.
        first_camera: id of the first camera; the following ones must be free.
        first_image: id of the first image; the following ones must be free.
    """
    import pycolmap

    for idx, name in enumerate(photographs.names):
        height, width = photographs.sizes_hw[idx].tolist()
        focal, radial = photographs.focals_px[idx], photographs.radials[idx]
        params = [focal, width / 2, height / 2, radial] if radial else [focal, focal, width / 2, height / 2]
        kind = "SIMPLE_RADIAL" if radial else "PINHOLE"
        camera = pycolmap.Camera(model=kind, width=width, height=height, params=params)
        camera.camera_id = first_camera + idx
        model.add_camera_with_trivial_rig(camera)
        image = pycolmap.Image(
            name=name, keypoints=np.zeros((0, 2)), camera_id=camera.camera_id, image_id=first_image + idx
        )
        rotation = pycolmap.Rotation3d(np.asarray(photographs.rotations[idx]))
        pose = pycolmap.Rigid3d(rotation, np.asarray(photographs.translations[idx]))
        model.add_image_with_trivial_frame(image, pose)
