"""A capture of two rooms that nothing connects, with their truth, and a workflow that knows the poses in each."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pano_mvs.geometry import Similarity3, rotation_from_rotvec
from pano_mvs.scene.image_file import write_png
from pano_mvs.testing.room import capture_poses, default_room, render
from tests.stored import write_npz

SIZE_HW = (96, 192)
LARGE, SMALL = ("a0.png", "a1.png", "a2.png"), ("b0.png", "b1.png")
# Another unit and another world than the truth's, as any solver would find.
WORLDS = {
    "a": Similarity3(0.5, rotation_from_rotvec([0.05, 0.3, 0.0]), np.array([1.0, 0.0, 2.0])),
    "b": Similarity3(2.0, rotation_from_rotvec([0.0, -1.0, 0.1]), np.array([0.0, -1.0, 0.0])),
}

SOLVER = """\
from pano_mvs.api import All, Context, InputPath, Panorama, Params, Poses, stage
from pano_mvs.io.poses.files import read_poses
from pano_mvs.scene.pose_groups import join_groups


class TwoRoomsParams(Params):
    path: InputPath


@stage("poses.two_rooms")
def two_rooms(images: All[Panorama], params: TwoRoomsParams, ctx: Context) -> Poses:
    rooms = [read_poses(params.path / f"{room}.json") for room in "ba"]
    return join_groups(rooms, order=tuple(images))
"""

WORKFLOW = """\
pano_mvs: 1
plugins: [two_rooms.py]
stages:
  images:   {use: source.folder, path: capture/images}
  features: {use: features.orb_tangent, max_keypoints: 600}
  pairs:    {use: pairs.exhaustive}
  matches:  {use: matches.brute_force}
  poses:    {use: poses.two_rooms, path: rooms}
  points:   {use: poses.triangulate}
  refined:  {use: poses.refine}
  metres:   {use: poses.scale, baseline: {from: b0.png, to: b1.png, metres: METRES}}
  views:    {use: views.nearest}
  depth:    {use: depth.sweep, planes: 32}
  checked:  {use: filters.consistency}
  cloud:    {use: fusion.vote}
  colmap:   {use: export.colmap}
  ply:      {use: export.ply}
  ranges:   {use: export.ranges}
  previews: {use: export.previews}
"""


def write_rooms(folder: Path) -> float:
    """Write the pictures and the truth of two rooms, and the poses of each in its own world; return b's baseline."""
    (folder / "capture" / "images").mkdir(parents=True)
    (folder / "capture" / "truth").mkdir()
    (folder / "rooms").mkdir()
    views: list[dict[str, Any]] = []
    depths: dict[str, NDArray[np.float32]] = {}
    ours: dict[str, list[dict[str, Any]]] = {"a": [], "b": []}
    poses = dict(
        zip(LARGE + SMALL, [*capture_poses(3, spread=0.4), *capture_poses(2, seed=3, spread=0.4)], strict=True)
    )
    for name, pose in poses.items():
        picture, depths[name[:2]] = render(default_room(seed=ord(name[0])), pose, SIZE_HW, supersample=1)
        write_png(folder / "capture" / "images" / name, picture)
        views.append({"image": name, "R": pose.rotation.tolist(), "t": pose.translation.tolist()})
        moved = WORLDS[name[0]].move_camera(pose)
        ours[name[0]].append({"image": name, "R": moved.rotation.tolist(), "t": moved.translation.tolist()})
    size = {"width": SIZE_HW[1], "height": SIZE_HW[0]}
    (folder / "capture" / "truth" / "poses.json").write_text(json.dumps({**size, "metric": True, "views": views}))
    write_npz(folder / "capture" / "truth" / "depth.npz", depths)
    for room, listed in ours.items():
        (folder / "rooms" / f"{room}.json").write_text(json.dumps({**size, "metric": False, "views": listed}))
    return float(np.linalg.norm(poses["b0.png"].center - poses["b1.png"].center))


def write_workflow(folder: Path, more: str = "") -> Path:
    """Write the pictures, the truth, the poses, and the workflow with further stages; return the workflow."""
    metres = write_rooms(folder)
    (folder / "two_rooms.py").write_text(SOLVER)
    path = folder / "two.yaml"
    path.write_text(WORKFLOW.replace("METRES", f"{metres:.6f}") + more)
    return path
