"""Real tours against their links.

Each DIR is a virtual tour: cube tiles, and data.js of Marzipano or a JSON file of Pannellum, in which whoever made the
tour marked in each scene where others lie. Such links are true to some 10°; through doors they mark the door instead,
so that they may be 30° off. Where a workflow puts both scenes of a link into one group, the direction of the other
camera is compared with the link. The table shows the links within 20° and beyond 45°, and how many of the latter no
doubt about one of their cameras explains.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import numpy as np

import pano_mvs
from pano_mvs.io.images.tour_configurations import javascript_object
from pano_mvs.io.images.tours import list_scenes
from pano_mvs.scene import Poses
from pano_mvs.scene.pose_groups import split_groups

HEADER = (
    "| tour | scenes | placed | groups | doubted | links inside groups | within 20° | beyond 45° | not doubted |\n"
    + "|---" * 9
    + "|"
)
_RIGHT_DEG, _WRONG_DEG = 20.0, 45.0


class Offset(NamedTuple):
    """By how many degrees a link and the direction of the camera differ, and whether one of its cameras is doubted."""

    scene: str
    target: str
    off_deg: float
    doubted: bool


def read_links(tour: Path) -> tuple[int, dict[tuple[str, str], float]]:
    """Return the number of scenes, and the azimuth in radians, to the right, of each link by (scene, target)."""
    scenes = list_scenes(tour, [])
    parts = {part: scene.name for scene in scenes for path in scene.tiles.values() for part in path.parts[:-1]}
    for file in sorted((*tour.rglob("data.js"), *tour.rglob("*.json"))):
        stated = list(_stated_links(file.read_text(encoding="utf-8")))
        named = {key: parts[folder] for key, folder, _ in stated if folder in parts}
        if named:
            return len(scenes), {
                (named[key], named[target]): azimuth
                for key, _, links in stated
                for target, azimuth in links.items()
                if {key, target} <= named.keys()
            }
    raise SystemExit(f"{tour}: no data.js of a Marzipano tour and no JSON file of a Pannellum tour with tiles in it")


def _stated_links(text: str) -> Iterator[tuple[str, str, dict[str, float]]]:
    """Yield for each scene that a configuration states its key, the folder of its tiles, and the azimuths of links."""
    if found := re.search(r"APP_DATA\s*=\s*(?=\{)", text):
        for scene in javascript_object(text[found.end() :])["scenes"]:
            links = {link["target"]: float(link["yaw"]) for link in scene["linkHotspots"]}
            yield scene["id"], scene["id"], links
    elif '"scenes"' in text and '"multiRes"' in text:
        for key, scene in json.loads(text)["scenes"].items():
            folder = PurePosixPath(scene["multiRes"]["path"].partition("%")[0]).name
            links = {spot["sceneId"]: float(np.deg2rad(spot["yaw"])) for spot in scene["hotSpots"] if "sceneId" in spot}
            yield key, folder, links


def offsets(group: Poses, links: dict[tuple[str, str], float]) -> list[Offset]:
    """Return how far the links between cameras of a group are off."""
    idx_of = {Path(name).stem: idx for idx, name in enumerate(group.names)}
    doubted = {Path(name).stem for name in group.doubts}
    found = []
    for (scene, target), azimuth in links.items():
        if scene in idx_of and target in idx_of:
            one, other = idx_of[scene], idx_of[target]
            ray = group.rotations[one] @ (group.centers[other] - group.centers[one])
            off = np.angle(np.exp(1j * (np.arctan2(ray[0], ray[2]) - azimuth)), deg=True)
            found.append(Offset(scene, target, abs(float(off)), bool({scene, target} & doubted)))
    return found


def main(tours: list[Path], *, out: Path, workflow: str = "quality", until: str = "levelled") -> None:
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
        wrong = [offset for offset in found if offset.off_deg > _WRONG_DEG]
        sizes = sorted((len(group.names) for group in groups), reverse=True)
        cells = (
            *(tour.name, scenes, sum(sizes), " + ".join(map(str, sizes)), sum(len(group.doubts) for group in groups)),
            *(len(found), sum(offset.off_deg <= _RIGHT_DEG for offset in found)),
            *(len(wrong), sum(not offset.doubted for offset in wrong)),
        )
        print("| " + " | ".join(map(str, cells)) + " |", flush=True)
        for offset in wrong:
            print(f"  {offset.scene} → {offset.target}: {offset.off_deg:.0f}°", file=sys.stderr)
