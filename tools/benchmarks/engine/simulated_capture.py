"""A capture of any size whose stages compute next to nothing, with the records of the real ones.

Small pictures on a street, 1,000 in each folder; features of each, pairs of each with the eight that follow, a
geometry of each pair, poses, range maps that read four neighbours, a check that reads them again, a preview file of
each view and one cloud: 13 units for each picture.
"""

from __future__ import annotations

import os
import time
from pathlib import Path

import cv2
import numpy as np

UNITS_PER_PICTURE = 13
_PER_FOLDER = 1000
_SIZE_HW = (8, 16)

PLUGIN = '''
"""Stages that compute next to nothing."""
from pathlib import Path

import numpy as np

from pano_mvs.api import (All, Context, Each, Features, FilePart, Files, Names, Near, One, Pairs, Panorama, Params,
                          PointCloud, Pose, Poses, RangeMap, Rigid3, SourceItem, SourcePath, TwoView, Views, source,
                          stage)

KEYPOINTS = 8
SIZE_HW = (8, 16)


class FolderParams(Params):
    path: SourcePath


class PairParams(Params):
    followers: int = 8


class Salt(Params):
    salt: int = 0


def listed(params):
    root = Path(params.path)
    return [SourceItem(path.relative_to(root).as_posix(), {"image": path}) for path in sorted(root.rglob("*.png"))]


@source("simulated.images", list_items=listed)
def images(item: SourceItem, params: FolderParams) -> Panorama:
    return Panorama(FilePart(item.files["image"], external=True), SIZE_HW, SIZE_HW)


@stage("simulated.features")
def features(image: Each[Panorama], params: Salt, ctx: Context) -> Features:
    rays = ctx.rng.normal(size=(KEYPOINTS, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    ctx.metric("keypoints", KEYPOINTS)
    return Features(rays, ctx.rng.random((KEYPOINTS, 8)).astype(np.float32), np.full(KEYPOINTS, 0.05, np.float32),
                    ctx.rng.random(KEYPOINTS).astype(np.float32), np.zeros((KEYPOINTS, 3), np.uint8), "l2", SIZE_HW)


@stage("simulated.pairs")
def pairs(names: Names[Panorama], params: PairParams) -> Pairs:
    n = list(names)
    return Pairs(tuple((a, b) for i, a in enumerate(n) for b in n[i + 1:i + 1 + params.followers]))


@stage("simulated.geometry")
def geometry(ends: Near[Features], params: Salt, ctx: Context) -> TwoView:
    same = np.arange(KEYPOINTS, dtype=np.int32)
    inliers = int(ctx.rng.integers(20, 400))
    ctx.metric("inliers", inliers)
    ctx.metric("candidates", inliers + 50)
    ctx.metric("residual_deg", 0.03 * ctx.rng.random())
    direction = ctx.rng.normal(size=3)
    return TwoView(np.stack([same, same], axis=-1), np.eye(3), direction / np.linalg.norm(direction),
                   ctx.rng.random(KEYPOINTS).astype(np.float32) * 1e-3, "general", "", KEYPOINTS, 10.0, 0.02, 0.05)


@stage("simulated.poses")
def poses(views: All[TwoView], images: All[Panorama], ctx: Context) -> Poses:
    linked = {name for pair in views for name in pair}
    names = [name for name in images if name in linked]
    idx = np.arange(len(names))
    places = np.array([int(Path(name).stem[:6]) for name in names])  # one more picture moves no other
    centers = np.stack([places % 500, np.zeros(len(names)), places // 500], axis=1).astype(float)
    count = len(names) * KEYPOINTS
    point_idx = np.arange(count, dtype=np.int32) // 2
    image_idx = np.repeat(idx, KEYPOINTS).astype(np.int32)
    rays = ctx.rng.normal(size=(count, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    points = centers[image_idx[::2]] + rays[::2]
    return Poses(tuple(names), np.tile(np.eye(3), (len(names), 1, 1)), -centers, points,
                 np.zeros((len(points), 3), np.uint8), np.zeros(len(points), np.float32), point_idx, image_idx, rays,
                 {name: "no verified pair" for name in images if name not in linked})


@stage("simulated.views")
def views(poses: One[Poses]) -> Views:
    n = list(poses.names)
    return Views({a: tuple(b for b in n[max(0, i - 2):i + 3] if b != a) for i, a in enumerate(n)})


@stage("simulated.sweep")
def sweep(own: Each[Panorama], pose: Each[Pose], near: Near[Panorama], near_poses: Near[Pose], params: Salt,
          ctx: Context) -> RangeMap:
    ctx.metric("completeness", 1.0)
    return RangeMap(ctx.rng.uniform(1, 9, SIZE_HW).astype(np.float32), np.full(SIZE_HW, 100, np.uint8))


@stage("simulated.check")
def check(own: Each[RangeMap], near: Near[RangeMap], ctx: Context) -> RangeMap:
    ctx.metric("completeness", 1.0)
    ctx.metric("consistent", float(ctx.rng.random()))
    for name, value in {"compared": 0.9, "agreed": 0.8, "seen_through": 0.05, "hidden": 0.05}.items():
        ctx.metric(name, value)
    return RangeMap(own.range, np.full(SIZE_HW, 200, np.uint8))


@stage("simulated.previews")
def previews(own: Each[RangeMap], ctx: Context) -> Files:
    path = ctx.scratch / "a.npy"
    np.save(path, own.range)
    return Files({"preview/{item}.npy": path})


@stage("simulated.cloud")
def cloud(ranges: All[RangeMap], ctx: Context) -> PointCloud:
    depth = np.array([view.range[0, 0] for view in ranges.values()])
    points = np.stack([np.arange(len(depth)), depth, depth], axis=1).astype(np.float32)
    ctx.metric("points", len(points))
    return PointCloud(points, np.tile(np.float32([0, 0, 1]), (len(points), 1)), np.zeros((len(points), 3), np.uint8),
                      np.full(len(points), 2, np.uint8))
'''

WORKFLOW = """\
pano_mvs: 1
name: simulated
plugins: [simulated_plugin.py]
stages:
  images:   {use: simulated.images, path: capture}
  features: {use: simulated.features}
  pairs:    {use: simulated.pairs, followers: 8}
  matches:  {use: simulated.geometry}
  poses:    {use: simulated.poses}
  views:    {use: simulated.views}
  depth:    {use: simulated.sweep}
  checked:  {use: simulated.check}
  previews: {use: simulated.previews}
  cloud:    {use: simulated.cloud}
"""


def write_simulated(folder: Path, count: int) -> Path:
    """Write a workflow, its plugin and the pictures into a folder; return the workflow's file."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "simulated_plugin.py").write_text(PLUGIN)
    (folder / "wf.yaml").write_text(WORKFLOW)
    for number in range(count):
        write_picture(folder, number)
    return folder / "wf.yaml"


def write_picture(folder: Path, number: int, *, version: int = 0) -> Path:
    """Write one picture, with a time of change in the past, as younger files are hashed again each time."""
    path = folder / "capture" / f"{number // _PER_FOLDER:03d}" / f"{number:06d}.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.random.default_rng([number, version]).integers(0, 256, (*_SIZE_HW, 3), np.uint8)
    path.write_bytes(cv2.imencode(".png", pixels)[1].tobytes())
    past = time.time() - 60 + version
    os.utime(path, (past, past))
    return path
