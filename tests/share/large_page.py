"""A page with many large panoramas, all of them the same small tile."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pano_mvs.share.encoding import encode_jpeg
from pano_mvs.share.page_folder import PageFolder
from pano_mvs.share.scene_parts import RANGES_HW


def large_page(folder: Path, *, panoramas: int, levels: int, present: Sequence[int]) -> Path:
    """Write the page and return its path; of four levels, the largest is 8192 pixels wide.

    The tiles have few pixels, but their number and names are those of real ones.

    Args:
        folder: a new folder.
        panoramas: their number.
        levels: of each panorama.
        present: the panoramas whose tiles are written; those of the others are missing.
    """
    page = PageFolder(folder)
    tile = encode_jpeg(np.full((8, 8, 3), 120, np.uint8), 80)
    cameras = []
    for idx in range(panoramas):
        for level in range(levels if idx in present else 0):
            for row in range(max(1, 1 << level >> 1)):
                for column in range(1 << level):
                    page.put(f"panorama/{idx}/{level}-{column}-{row}", tile)
        center = [float(idx % 20), 0.0, float(idx // 20)]
        camera = {"name": f"{idx:03}.jpg", "center": center, "page_from_cam": np.diag([1.0, -1.0, -1.0]).tolist()}
        tiles = {"levels": levels, "width": 1024 << levels >> 1}
        cameras.append({**camera, **tiles, "ranges": None, "sigmas": None, "room": ""})
    scene = {"title": "Many", "unit": "m", "cameras": cameras, "ranges": list(RANGES_HW), "nodes": [], "bounds": []}
    page.put("scene", {**scene, "outline": [], "sigmas": [1, 2], "coverage": False, "mesh": None, "maps": []})
    page.finish("Many", max_single_file_bytes=0)
    return folder / "index.html"
