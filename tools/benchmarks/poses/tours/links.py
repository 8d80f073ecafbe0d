"""Real tours against their links.

Each DIR is a virtual tour with a configuration, in which whoever made the tour marked in each scene where others lie.
Such links are true to some 10°; through doors they mark the door instead, so that they may be 30° off. Where a workflow
puts both scenes of a link into one group, the direction of the other camera is compared with the link. The table shows
the links within 20° and beyond 45°, and how many of the latter no doubt about one of their cameras explains; then how
many scenes `house.links` puts into one house, and the share of all links that are within 30° there.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pano_mvs_tours.tour_folders import list_scenes

import pano_mvs
from pano_mvs.geometry import Rigid3
from pano_mvs.io.house_file import HOUSE_FILE, read_house
from pano_mvs.scene import House, PlacedBy, Poses
from pano_mvs.scene.pose_groups import split_groups

HEADER = (
    "| tour | scenes | placed | groups | doubted | links inside groups | within 20° | beyond 45° | not doubted | "
    "in one house | links within 30° |\n" + "|---" * 11 + "|"
)
_RIGHT_DEG, _ROUGH_DEG, _WRONG_DEG = 20.0, 30.0, 45.0


class Offset(NamedTuple):
    """By how many degrees a link and the direction of the camera differ, and whether one of its cameras is doubted."""

    scene: str
    target: str
    off_deg: float
    doubted: bool


def read_links(tour: Path) -> tuple[int, dict[tuple[str, str], float]]:
    """Return the number of scenes, and the azimuth in radians, to the right, of each link by (scene, target)."""
    scenes = list_scenes(tour, [])
    links = {
        (scene.name, link.name): float(np.deg2rad(link.direction_deg[0]))
        for scene in scenes
        for link in scene.links
        if link.direction_deg is not None
    }
    if not links:
        raise SystemExit(f"{tour}: no links with directions in a configuration of Marzipano, Pannellum or krpano")
    return len(scenes), links


def offsets(group: Poses, links: Mapping[tuple[str, str], float]) -> list[Offset]:
    """Return how far the links between cameras of a group are off."""
    return _offsets(group.cameras, links, {Path(name).stem for name in group.doubts})


def house_offsets(house: House, links: Mapping[tuple[str, str], float]) -> list[Offset]:
    """Return how far the links between the scenes of one house are off."""
    inside = [idx for idx, by in enumerate(house.placed_by) if by != PlacedBy.NOTHING]
    return _offsets({house.names[idx]: house.cam_from_house(idx) for idx in inside}, links, set())


def _offsets(cameras: Mapping[str, Rigid3], links: Mapping[tuple[str, str], float], doubted: set[str]) -> list[Offset]:
    own = {Path(name).stem: pose for name, pose in cameras.items()}
    found = []
    for (scene, target), azimuth in links.items():
        if scene in own and target in own:
            ray = own[scene].rotation @ (own[target].center - own[scene].center)
            off = np.angle(np.exp(1j * (np.arctan2(ray[0], ray[2]) - azimuth)), deg=True)
            found.append(Offset(scene, target, abs(float(off)), bool({scene, target} & doubted)))
    return found


def main(tours: list[Path], *, out: Path, workflow: str = "quality", until: str = "house_file") -> None:
    """Place each tour with a workflow and compare its links; results and caches stay in `out`."""
    print(HEADER, flush=True)
    for tour in tours:
        scenes, links = read_links(tour)
        place, cache = out / tour.name / "run", out / tour.name / "cache"
        command = [sys.executable, "-m", "pano_mvs", "run", workflow, "--images", str(tour), "--until", until]
        command += ["--set", "images.use=source.tour"]
        done = subprocess.run([*command, "--out", str(place), "--cache", str(cache)], capture_output=True, text=True)
        poses = pano_mvs.load(place, cache=cache).poses if done.returncode in (0, 3) else None  # 3: some are left out
        groups = [] if poses is None else list(split_groups(poses))
        found = [offset for group in groups for offset in offsets(group, links)]
        house = read_house(place / HOUSE_FILE) if (place / HOUSE_FILE).is_file() else None
        rough = house_offsets(house, links) if house is not None else found
        within = sum(offset.off_deg <= _ROUGH_DEG for offset in rough)
        in_house = sum(by != PlacedBy.NOTHING for by in house.placed_by) if house is not None else 0
        wrong = [offset for offset in found if offset.off_deg > _WRONG_DEG]
        sizes = sorted((len(group.names) for group in groups), reverse=True)
        cells = (
            *(tour.name, scenes, sum(sizes), " + ".join(map(str, sizes)), sum(len(group.doubts) for group in groups)),
            *(len(found), sum(offset.off_deg <= _RIGHT_DEG for offset in found)),
            *(len(wrong), sum(not offset.doubted for offset in wrong)),
            *(in_house or max(sizes, default=0), f"{within} of {len(links)}"),
        )
        print("| " + " | ".join(map(str, cells)) + " |", flush=True)
        for offset in wrong:
            print(f"  {offset.scene} → {offset.target}: {offset.off_deg:.0f}°", file=sys.stderr)
