"""Floors, walls and ceilings of rendered houses with true poses.

Each DIR is a house that `poses.tours.houses` wrote, named as there. The dense stages of a workflow are run on its
panoramas with the true poses, and all views are compared with the true ranges, before `depth.structure` and after it:

* floor, walls, ceiling: share of the solid angle of these surfaces within 5 % of the truth, and within 1 %;
* all: the same of everything that has a surface;
* confirmed: share of all that is confirmed, and of it, within 5 %.

What windows, mirrors and the tripod show (over 67° below the horizon) is left out.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.geometry import Rigid3, pixel_solid_angle, ray_grid
from pano_mvs.scene import FilePart, Panorama, RangeMap
from pano_mvs.scene.range_map import CONSISTENT_CONFIDENCE
from tests.stored import read_picture
from tools.benchmarks.captures import Capture
from tools.benchmarks.dense_chain import DenseChain
from tools.benchmarks.poses.tours.houses import HOUSES
from tools.benchmarks.poses.tours.materials import MIRROR, PANE, PLASTER, SCREEN
from tools.benchmarks.poses.tours.plan import build
from tools.benchmarks.poses.tours.rendering import first_surfaces, unlit
from tools.benchmarks.table import print_table

FLOOR, WALL, CEILING, OTHER, LEFT_OUT = range(5)
KINDS = {"floor": FLOOR, "walls": WALL, "ceiling": CEILING}
# Capture worlds have y down, houses z up.
_Y_DOWN = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
_TRIPOD_RAD = np.radians(67.0)
_FLOOR_HALF_HEIGHT = 0.01

Kinds = NDArray[np.int64]


@dataclass(frozen=True)
class House:
    """A rendered house: its capture, and what each pixel of each view shows."""

    capture: Capture
    kinds: dict[str, Kinds]


def read_house(folder: Path, *, width: int) -> House:
    """Return the capture of a rendered house with the true ranges, and what each pixel shows."""
    name, size = folder.resolve().name, (width // 2, width)
    seed = int(name.rpartition("_")[2])
    boxes, cameras = build(HOUSES[name], seed=seed)
    house = unlit(boxes, seed=seed)
    panoramas, poses, ranges, kinds = {}, {}, {}, {}
    for idx, camera in enumerate(cameras):
        file = f"{idx:03d}.jpg"
        path = folder / "images" / file
        height, own_width = read_picture(path).shape[:2]
        panoramas[file] = Panorama(FilePart(path), size, (height, own_width))
        poses[file] = Rigid3.from_center(camera.pose.rotation @ _Y_DOWN.T, _Y_DOWN @ camera.pose.center)
        true, box, face = first_surfaces(house, camera.pose, size)
        material = np.where(box < 0, PANE, boxes.kinds[box, 0])
        shown = np.full(size, OTHER)
        shown[(material == PLASTER) & (face < 4)] = WALL
        shown[(material == PLASTER) & (face == 4)] = CEILING
        shown[(face == 5) & np.isclose(boxes.frames[box, 5], _FLOOR_HALF_HEIGHT)] = FLOOR
        shown[np.isin(material, (PANE, MIRROR, SCREEN)) | _shows_tripod(size, poses[file])] = LEFT_OUT
        ranges[file], kinds[file] = np.where(shown == LEFT_OUT, np.nan, true).astype(np.float32), shown
    return House(Capture(name, panoramas, poses, ranges), kinds)


def _shows_tripod(size_hw: tuple[int, int], pose: Rigid3) -> NDArray[np.bool_]:
    return np.asarray(ray_grid(size_hw) @ pose.rotation[:, 1] > np.sin(_TRIPOD_RAD))


def shares(range_map: RangeMap, truth: NDArray[np.float32], kinds: Kinds) -> dict[str, tuple[float, float]]:
    """Return the solid angle of each figure and of what it is a share of."""
    area = np.broadcast_to(pixel_solid_angle(truth.shape)[:, None], truth.shape)
    known = kinds != LEFT_OUT
    with np.errstate(invalid="ignore"):
        error = np.nan_to_num(np.abs(range_map.range / truth - 1), nan=np.inf)
    confirmed = range_map.confidence >= CONSISTENT_CONFIDENCE[0]
    parts = {name: kinds == kind for name, kind in KINDS.items()} | {"all": known}
    found = {}
    for name, part in parts.items():
        for percent in (5, 1):
            found[f"{name} {percent} %"] = part & (error < percent / 100), part
    found["confirmed"] = confirmed & known, known
    found["it 5 %"] = confirmed & known & (error < 0.05), confirmed & known
    return {name: (float(area[which].sum()), float(area[of].sum())) for name, (which, of) in found.items()}


def total(rows: Sequence[dict[str, tuple[float, float]]]) -> dict[str, float]:
    """Return the figures of all views together, in percent."""
    sums = {name: np.sum([row[name] for row in rows], axis=0) for name in rows[0]}
    return {name: float(100 * part / max(whole, 1e-12)) for name, (part, whole) in sums.items()}


def main() -> None:
    """Measure the houses that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("houses", nargs="+", type=Path, metavar="DIR")
    parser.add_argument("--workflow", default="quality")
    parser.add_argument("--set", action="append", default=[], metavar="STAGE.PARAM=VALUE")
    parser.add_argument("--width", type=int, default=512)
    given = parser.parse_args()
    cv2.setNumThreads(1)
    chain = DenseChain(given.workflow, overrides=given.set)
    rows = []
    for folder in given.houses:
        house = read_house(folder, width=given.width)
        maps = list(chain.run(house.capture).range_maps.items())[-2:]
        for stage, items in maps:
            figures = total([shares(items[name], house.capture.ranges[name], house.kinds[name]) for name in items])
            rows.append((house.capture.name, stage, *(f"{value:.1f}" for value in figures.values())))
    print_table(["house", "after", *figures], rows)
