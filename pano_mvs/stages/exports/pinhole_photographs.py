"""Photographs without distortion, for programs that only read pinhole cameras."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pano_mvs.algorithms.photograph_undistortion import undistorted_photograph
from pano_mvs.api import Context, FilePart
from pano_mvs.io.colmap.image_copies import write_picture
from pano_mvs.scene.image_files.image_file import decode_image
from pano_mvs.scene.photographs import Photographs


def pinhole_photographs(photographs: Photographs, ctx: Context) -> Photographs:
    """Return photographs whose pictures have no distortion and are JPEGs; `.jpg` is added to their names.

    The pictures have no EXIF, so that no program turns them: the poses are those of the pictures as stored.
    """
    folder = ctx.scratch / "pinhole"
    folder.mkdir()
    pictures, focals_px = [], []
    for idx, file in enumerate(photographs.pictures):
        picture, focal_px = undistorted_photograph(
            decode_image(file.path, file.read_bytes()),
            focal_px=float(photographs.focals_px[idx]),
            radial=float(photographs.radials[idx]),
        )
        path = folder / f"{idx}.jpg"
        write_picture(path, picture)
        pictures.append(FilePart(path))
        focals_px.append(focal_px)
    return replace(
        photographs,
        names=tuple(f"{name}.jpg" for name in photographs.names),
        focals_px=np.array(focals_px),
        radials=np.zeros(len(photographs)),
        pictures=tuple(pictures),
    )
