"""The README's picture: the cloud of a room, a panorama of it and its range map.

    pano-mvs run quality --images ROOM --out room
    python docs/_pictures/hero_picture.py room

ROOM: nine panoramas of 1024×512 of “The Grey & White Room” (Wig42, CC BY 3.0), as in docs/benchmarks.md. The cloud is
drawn in world coordinates, so another room needs another EYE, FOCUS and CUT.
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
import pyvista as pv
from numpy.typing import NDArray
from quickstart_pictures import IMAGES

from pano_mvs.io.ply import open_ply_points

WIDTH, HEIGHT, STRIP, GAP = 1280, 560, 460, 30
EYE, FOCUS, VIEW_ANGLE = (3.3, -5.2, -6.2), (0.72, 0.45, 0.2), 35.0
CEILING_Y, CUT_Z = -1.25, -1.25
BACKGROUND = "#f3f5f6"
_SUPERSAMPLING = 3

Picture = NDArray[np.uint8]


def room_picture(path: Path, size_wh: tuple[int, int]) -> Picture:
    """Return the cloud from outside, BGR, without the ceiling and the wall beside the viewer."""
    cloud = pv.read(path)
    file = open_ply_points(path)  # whose header states the rotation from the world
    points, colors = file.in_world(np.asarray(cloud.points)), np.asarray(cloud.point_data["RGB"])
    normals = file.in_world(np.asarray(cloud.point_data["Normals"]))
    faces_us = np.einsum("ij,ij->i", np.asarray(EYE) - points, normals) > 0
    extent = np.abs(points - np.median(points, axis=0)).max(axis=1)
    keep = faces_us & (points[:, 1] > CEILING_Y) & (points[:, 2] > CUT_Z) & (extent < 4.5)
    shown = pv.PolyData(points[keep])
    shown["rgb"] = colors[keep]
    large = (size_wh[0] * _SUPERSAMPLING, size_wh[1] * _SUPERSAMPLING)
    plotter = pv.Plotter(off_screen=True, window_size=large)
    plotter.set_background(BACKGROUND)
    plotter.add_mesh(shown, scalars="rgb", rgb=True, point_size=6, lighting=False)
    plotter.camera.position, plotter.camera.focal_point, plotter.camera.up = EYE, FOCUS, (0, -1, 0)
    plotter.camera.view_angle = VIEW_ANGLE
    drawn = np.asarray(plotter.screenshot(None, return_img=True))[..., 2::-1]
    return np.asarray(cv2.resize(drawn, size_wh, interpolation=cv2.INTER_AREA), np.uint8)


def hero(out: Path) -> Picture:
    """Return the whole picture: a panorama and its ranges beside the cloud, BGR."""
    preview = cv2.imread(str(out / "preview" / "000.jpg"))
    assert preview is not None
    height = preview.shape[1] // 2
    panorama, ranges = preview[:height], preview[height + 4 : 2 * height]
    pictures = [cv2.resize(part, (STRIP, STRIP // 2), interpolation=cv2.INTER_AREA) for part in (panorama, ranges)]
    gap, top = GAP, (HEIGHT - STRIP - GAP) // 2
    paper = np.empty((HEIGHT, WIDTH, 3), np.uint8)
    paper[:] = tuple(int(BACKGROUND[start : start + 2], 16) for start in (5, 3, 1))
    paper[:, STRIP + gap :] = room_picture(out / "cloud.ply", (WIDTH - STRIP - gap, HEIGHT))
    for number, part in enumerate(pictures):
        first = top + number * (part.shape[0] + gap)
        paper[first : first + part.shape[0], gap : gap + STRIP] = part
    return paper


if __name__ == "__main__":
    cv2.imwrite(str(IMAGES / "hero.jpg"), hero(Path(sys.argv[1])), [cv2.IMWRITE_JPEG_QUALITY, 82])
