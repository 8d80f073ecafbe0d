"""Points of an image of a splat bundle, from its depth and its camera."""

import json
from pathlib import Path

import cv2
import numpy as np

folder = Path("lobby/splat_bundle")
manifest = json.loads((folder / "manifest.json").read_text())
view = next(view for view in manifest["views"] if view["variant"] == "faces")
camera, pose = view["camera"], np.array(view["cam_from_world"])
steps = np.asarray(cv2.imread(str(folder / view["depth"]), cv2.IMREAD_UNCHANGED))
depth = steps * manifest["layers"]["depth"]["unit"]  # z-depth in scene units
row, column = np.nonzero(steps)  # 0 is unknown
x = (column + 0.5 - camera["cx"]) / camera["fx"]
y = (row + 0.5 - camera["cy"]) / camera["fy"]
in_camera = np.stack([x, y, np.ones_like(x)], axis=-1) * depth[row, column, None]
in_world = (in_camera - pose[:, 3]) @ pose[:, :3]  # (N, 3)
