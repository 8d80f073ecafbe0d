"""The layers of one face of a splat bundle, for docs/exports.md.

    pano-mvs run splat --images CLASSROOM --out classroom
    python docs/_pictures/splat_pictures.py classroom/splat_bundle

CLASSROOM: nine panoramas of the rendered classroom, as in docs/benchmarks.md.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from quickstart_pictures import IMAGES

from pano_mvs.io.ranges import read_normals

SIZE, GAP = 300, 8
PANORAMA, FACE = "000", "front"

Picture = NDArray[np.uint8]


def layers(bundle: Path) -> list[Picture]:
    """Return image, depth, normals and confidence of one face, BGR."""
    manifest: dict[str, Any] = json.loads((bundle / "manifest.json").read_text(encoding="utf-8"))
    views = [view for view in manifest["views"] if view["variant"] == "faces"]
    (view,) = [view for view in views if view["panorama"].startswith(PANORAMA) and f".{FACE}." in view["image"]]
    image, steps, confidence = (
        np.asarray(cv2.imread(str(bundle / view[layer]), cv2.IMREAD_UNCHANGED))
        for layer in ("image", "depth", "confidence")
    )
    known = steps > 0
    near, far = np.quantile(steps[known], (0.02, 0.98))
    shade = np.clip((1 / np.maximum(steps, 1) - 1 / far) / (1 / near - 1 / far), 0, 1)
    depth = cv2.applyColorMap(np.rint(255 * shade).astype(np.uint8), cv2.COLORMAP_TURBO)
    depth[~known] = 128
    normals = np.nan_to_num((read_normals(bundle / view["normal"]) * (1, -1, -1) + 1) / 2, nan=0.5)
    sure = np.where(confidence >= 128, confidence, confidence // 2)
    return [image, np.asarray(depth), np.rint(255 * normals[..., ::-1]).astype(np.uint8), cv2.merge([sure] * 3)]


if __name__ == "__main__":
    tiles = [cv2.resize(layer, (SIZE, SIZE), interpolation=cv2.INTER_AREA) for layer in layers(Path(sys.argv[1]))]
    space = np.full((SIZE, GAP, 3), 255, np.uint8)
    row = np.hstack([part for tile in tiles for part in (tile, space)][:-1])
    cv2.imwrite(str(IMAGES / "splat_layers.jpg"), row, [cv2.IMWRITE_JPEG_QUALITY, 80])
