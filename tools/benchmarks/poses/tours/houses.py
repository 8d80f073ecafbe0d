"""Write rendered tours with true poses.

Each house becomes OUT/NAME/images/*.jpg and OUT/NAME/truth.json: for each file name its position (x, y, z up, metres),
the compass heading of the picture's centre, the room, and cam_from_world's rotation. Pictures that exist stay.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import cv2
import numpy as np

from tools.benchmarks.poses.tours.plan import Style, build
from tools.benchmarks.poses.tours.rendering import lit, panorama

HOUSES: dict[str, Style] = {
    "house_01": Style(8.0),
    "house_02": Style(11.0),
    "house_03": Style(9.0, empty=0.5),
    "house_04": Style(9.0, storeys=2),
    "house_05": Style(16.0, equal=True),
    "house_06": Style(14.0, tripod=False),
    "house_07": Style(12.0, spacing=2.6),
    "house_08": Style(10.0, storeys=2, spacing=2.5, empty=0.3),
    "house_09": Style(13.0, storeys=2, equal=True, spacing=3.0),
    "house_10": Style(10.0, spacing=3.0, tripod=False),
    "house_11": Style(7.0, empty=1.0),
    "house_12": Style(18.0, spacing=2.4),
}
"""The houses that are measured; each is drawn by the number in its name."""


def write_house(folder: Path, name: str, *, width: int) -> None:
    """Render the pictures of a house that a folder does not have yet."""
    seed, style = int(name.rpartition("_")[2]), HOUSES[name]
    boxes, cameras = build(style, seed=seed)
    (folder / "images").mkdir(parents=True, exist_ok=True)
    truth = {
        f"{idx:03d}.jpg": {
            "position_m": camera.pose.center.round(6).tolist(),
            "yaw_deg": camera.yaw_deg,
            "room": camera.room,
            "camera_from_world": camera.pose.rotation.tolist(),
        }
        for idx, camera in enumerate(cameras)
    }
    (folder / "truth.json").write_text(json.dumps(truth, indent=1), encoding="utf-8")
    missing = [idx for idx, file in enumerate(truth) if not (folder / "images" / file).is_file()]
    house = lit(boxes, seed=seed) if missing else None
    for idx in missing:
        assert house is not None
        rng = np.random.default_rng([seed, idx, 0x5E])
        picture = panorama(house, cameras[idx].pose, size_hw=(width // 2, width), rng=rng, tripod=style.tripod)
        part = folder / "part.jpg"
        cv2.imwrite(str(part), picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 92])
        part.rename(folder / "images" / f"{idx:03d}.jpg")


def main() -> None:
    """Write the houses that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--house", action="append", choices=list(HOUSES), help="only these; default all")
    parser.add_argument("--width", type=int, default=1024)
    given = parser.parse_args()
    for name in given.house or HOUSES:
        write_house(given.out / name, name, width=given.width)
        print(given.out / name, flush=True)
