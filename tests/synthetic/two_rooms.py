"""The values that stages take of two rooms that nothing connects."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from pano_mvs.algorithms.poses.frame.gauge import moved_poses
from pano_mvs.engine.stages.context import Context
from pano_mvs.engine.stages.registry import Registry
from pano_mvs.geometry import Similarity3, rotation_from_rotvec
from pano_mvs.scene import Files, Panorama, PointCloud, Pose, Poses, RangeMap
from pano_mvs.scene.pose_groups import join_groups, with_cameras
from pano_mvs.scene.surfaces import SurfaceSamples
from pano_mvs.stages.fusion import vote
from pano_mvs.testing.tiny_capture import TinyCapture

FusionParams = Registry.installed().stages["fusion.vote"].params_type

LARGE = ("000.png", "001.png", "003.png")
# The smaller room is the same capture's, under other names, in a world that is turned, moved and half as large.
SMALL = {"b0.png": "000.png", "b1.png": "002.png"}
ORDER = ("b0.png", "000.png", "001.png", "b1.png", "003.png")
_MOVED = Similarity3(0.5, rotation_from_rotvec([0.1, 1.0, -0.2]), np.array([3.0, 1.0, -2.0]))

Item = TypeVar("Item")


class Rooms:
    """The values that stages take, of both rooms."""

    def __init__(self, tiny: TinyCapture) -> None:
        whole = tiny.whole(Poses)
        large, small = (_with(whole, names) for names in (LARGE, tuple(SMALL.values())))
        small = replace(moved_poses(small, _MOVED), names=tuple(SMALL), frame="the small room's", scale="its own")
        self.poses = join_groups([small, large], order=ORDER)
        self.images = self._of(tiny.each(Panorama))
        self.ranges = self._of(tiny.each(RangeMap))
        self.samples = self._of(tiny.each(SurfaceSamples))
        for name in SMALL:
            own = self.ranges[name]
            self.ranges[name] = replace(own, range=(0.5 * own.range).astype(np.float32))
            self.samples[name] = replace(
                self.samples[name], ranges=(0.5 * self.samples[name].ranges).astype(np.float32)
            )
        self.pose_items: Mapping[str, Pose] = self.poses.explode()

    @staticmethod
    def _of(items: Mapping[str, Item]) -> dict[str, Item]:
        return {name: items[SMALL.get(name, name)] for name in ORDER}


def _with(poses: Poses, names: tuple[str, ...]) -> Poses:
    return with_cameras(poses, np.array([name in names for name in poses.names]))


def context(folder: Path) -> Context:
    """Return the context of a stage that writes into a folder, which is made."""
    folder.mkdir()
    return Context(np.random.default_rng(0), folder)


def fused(rooms: Rooms, names: tuple[str, ...] = ORDER, **settings: Any) -> PointCloud:
    """Return the cloud of some images."""
    chosen = {name: rooms.ranges[name] for name in names}
    poses = {name: Pose(rooms.pose_items[name].cam_from_world, rooms.pose_items[name].group) for name in names}
    if set(names) == set(SMALL):
        poses = {name: Pose(pose.cam_from_world) for name, pose in poses.items()}
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        ctx = Context(np.random.default_rng(0), Path(folder))
        return vote(ranges=chosen, poses=poses, images=rooms.images, params=FusionParams(**settings), ctx=ctx)


def placed(files: Files, folder: Path) -> Path:
    """Copy files to their places in an output folder, and return it."""
    for target, path in files.files.items():
        (folder / target).parent.mkdir(parents=True, exist_ok=True)
        (folder / target).write_bytes(path.read_bytes())
    return folder
