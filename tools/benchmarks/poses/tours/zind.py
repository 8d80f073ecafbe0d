"""Write a tour of ZInD with its drawn truth.

TOUR is a folder of the Zillow Indoor Dataset, such as sample_tour/000 of github.com/zillow/zind, whose licence permits
measuring, not passing on. OUT gets images/ (links) and truth.json, as `tools.benchmarks.poses.tours.measure` reads
them. Positions and headings were drawn by hand on a floor plan; ZInD's plans are mirrored.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np


def write_tour(tour: Path, out: Path) -> None:
    """Write the images and the truth of a tour."""
    known = json.loads((tour / "zind_data.json").read_text(encoding="utf-8"))
    truth = {}
    (out / "images").mkdir(parents=True, exist_ok=True)
    for floor, rooms in known["merger"].items():
        metres = known["scale_meters_per_coordinate"][floor]
        for room, parts in rooms.items():
            for panorama in (one for part in parts.values() for one in part.values()):
                x, y = np.array(panorama["floor_plan_transformation"]["translation"]) * (metres or 1.0)
                picture = tour / panorama["image_path"]
                truth[picture.name] = {
                    "position_m": [-x, y, 3.0 * panorama["floor_number"]],
                    "yaw_deg": panorama["floor_plan_transformation"]["rotation"],
                    "room": room,
                }
                link = out / "images" / picture.name
                if not link.exists():
                    link.symlink_to(picture.resolve())
    (out / "truth.json").write_text(json.dumps(truth, indent=1), encoding="utf-8")


def main() -> None:
    """Write the tour that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tour", type=Path)
    parser.add_argument("out", type=Path)
    given = parser.parse_args()
    write_tour(given.tour, given.out)
