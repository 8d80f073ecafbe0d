"""Pictures of the documentation, from a run of the quickstart and the pictures that the program itself makes of it.

    pano-mvs run quickstart
    pano-mvs inspect quickstart 000.png 620 330 --plot inspect.png
    python docs/_pictures/quickstart_pictures.py out/quickstart inspect.png

The picture of the report is one of a browser's window of 1200×1000 pixels.
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
import pyvista as pv
from numpy.typing import NDArray

from pano_mvs.io.clouds.ply_reader import open_ply_points

ROOT = Path(__file__).parents[2]
IMAGES = ROOT / "docs" / "images"
WIDTH = 1200
EYE, FOCUS, VIEW_ANGLE = (4.6, -5.4, -4.6), (-0.15, 0.35, 0.3), 42.0
CEILING_Y = -1.2

Picture = NDArray[np.uint8]


def cloud_picture(path: Path) -> Picture:
    """Return the cloud from outside, (H, W, 3) BGR, without what is turned away (the near walls) and the ceiling."""
    cloud = pv.read(path)
    file = open_ply_points(path)  # whose header states the rotation from the world
    points, colors = file.in_world(np.asarray(cloud.points)), np.asarray(cloud.point_data["RGB"])
    normals = file.in_world(np.asarray(cloud.point_data["Normals"]))
    faces_us = np.einsum("ij,ij->i", np.asarray(EYE) - points, normals) > 0
    keep = faces_us & ((points[:, 1] > CEILING_Y) | (np.abs(normals[:, 1]) < 0.3))
    shown = pv.PolyData(points[keep])
    shown["rgb"] = colors[keep]
    plotter = pv.Plotter(off_screen=True, window_size=(2 * WIDTH, 1300))
    plotter.set_background("#e3e8ea")
    plotter.add_mesh(shown, scalars="rgb", rgb=True, point_size=5, lighting=False)
    plotter.camera.position, plotter.camera.focal_point, plotter.camera.up = EYE, FOCUS, (0, -1, 0)
    plotter.camera.view_angle = VIEW_ANGLE
    large = np.asarray(plotter.screenshot(None, return_img=True))
    return scaled(cv2.cvtColor(large, cv2.COLOR_RGB2BGR))


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


def beside(preview: Picture, cloud: Picture) -> Picture:
    """Return the README's picture: a panorama above its ranges, the cloud beside them."""
    left = cv2.resize(preview, (800, round(preview.shape[0] * 800 / preview.shape[1])), interpolation=cv2.INTER_AREA)
    width = round(left.shape[0] * 1.05)
    whole = cv2.resize(cloud, None, fx=left.shape[0] / cloud.shape[0], fy=left.shape[0] / cloud.shape[0])
    start = (whole.shape[1] - width) // 2
    return np.hstack([left, np.full((left.shape[0], 10, 3), 255, np.uint8), whole[:, start : start + width]])


if __name__ == "__main__":
    out, inspect = map(Path, sys.argv[1:])
    preview, cloud = cv2.imread(str(out / "preview" / "000.jpg")), cloud_picture(out / "cloud.ply")
    write("quickstart_preview.jpg", scaled(preview))
    write("quickstart_confidence.jpg", confidence_picture(out / "confidence" / "000.png"))
    write("inspect.jpg", cv2.imread(str(inspect)))
    write("quickstart.jpg", beside(preview, cloud))
