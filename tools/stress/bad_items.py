"""A capture of many tiny panoramas, some of them bad in ten ways, and a workflow that takes them to clouds and files.

Ten cameras stand in each of many rooms, which are far from one another; the poses are known. What is bad is found when
a picture is read or in the stage behind, so that nothing depends on a bad item but itself.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pano_mvs.geometry import Rigid3
from pano_mvs.scene.image_file import write_png
from pano_mvs.testing.room import capture_poses, default_room, render

FULL_VARIABLE = "PANO_MVS_TEST_FULL_DISK"
"""Names a file; as long as it is there, nothing that is written finds room."""

WAYS = ("empty", "text", "cut", "flipped", "square", "small", "raises", "exits", "crashes", "hangs")
TIMEOUT_S = 5
_SIZE_HW = (32, 64)
_CAMERAS = 10
_PER_FOLDER = 1000
_ROOM_APART = 1000.0

PLUGIN = '''
"""Passes panoramas on, except those whose file names say otherwise; plays a full disk."""
import errno
import os
import signal
import tempfile
import time

from pano_mvs.api import Each, Panorama, stage

_made = tempfile.mkstemp


def _make(*arguments, **settings):
    if os.path.exists(os.environ.get("PANO_MVS_TEST_FULL_DISK", "")):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    return _made(*arguments, **settings)


if "PANO_MVS_TEST_FULL_DISK" in os.environ:
    tempfile.mkstemp = _make


@stage("load.vetted")
def vetted(image: Each[Panorama]) -> Panorama:
    """Pass a panorama on."""
    way = image.image.path.stem.partition("-")[2]
    if way == "raises":
        raise ValueError("this one is unlucky")
    if way == "exits":
        os._exit(0)
    if way == "crashes":
        os.kill(os.getpid(), signal.SIGSEGV)
    if way == "hangs":
        time.sleep(3600)
    return image
'''

WORKFLOW = f"""\
pano_mvs: 1
name: load
plugins: [load_plugin.py]
stages:
  images:   {{use: source.folder, path: images}}
  vetted:   {{use: load.vetted, timeout_s: {TIMEOUT_S}}}
  poses:    {{use: poses.from_model, path: poses.json}}
  views:    {{use: views.nearest, sources: 2}}
  depth:    {{use: depth.sweep, planes: 16}}
  checked:  {{use: filters.consistency}}
  cloud:    {{use: fusion.vote}}
  ply:      {{use: export.ply}}
  ranges:   {{use: export.ranges}}
"""


@dataclass(frozen=True)
class Capture:
    """A capture on the disk.

    Attributes:
        workflow: its file.
        clean: the workflow of the same capture without what is bad.
        bad: names of the bad items and in which way they are.
        count: number of items, the bad ones included.
    """

    workflow: Path
    clean: Path
    bad: dict[str, str]
    count: int


def write_capture(folder: Path, *, count: int, bad: int, seed: int = 0) -> Capture:
    """Write a capture in which so many panoramas, drawn at random, are bad, and the same one without them."""
    rng = np.random.default_rng(seed)
    ways = dict(zip(rng.choice(count, bad, replace=False).tolist(), WAYS * (1 + bad // len(WAYS)), strict=False))
    poses = capture_poses(_CAMERAS, spread=1.0)
    workflows = [_write_workflow(folder / name) for name in ("all", "clean")]
    names, views = {}, []
    for number in range(count):
        way = ways.get(number, "")
        name = f"{number // _PER_FOLDER:03d}/{number:06d}{way and '-' + way}.png"
        room, camera = divmod(number, _CAMERAS)
        center = poses[camera].center + np.array([_ROOM_APART * room, 0.0, 0.0])
        views.append(_view(name, Rigid3(poses[camera].rotation, -poses[camera].rotation @ center)))
        picture, _ = render(default_room(room), poses[camera], _SIZE_HW, supersample=1)  # copies are left out
        for workflow in workflows if not way else workflows[:1]:
            path = workflow.parent / "images" / name
            path.parent.mkdir(parents=True, exist_ok=True)
            write_png(path, picture)
            _spoil(path, way)
        if way:
            names[name] = way
    for workflow in workflows:
        size = {"width": _SIZE_HW[1], "height": _SIZE_HW[0], "metric": True}
        (workflow.parent / "poses.json").write_text(json.dumps(size | {"views": views}))
    return Capture(workflows[0], workflows[1], names, count)


def _write_workflow(folder: Path) -> Path:
    folder.mkdir(parents=True)
    (folder / "load_plugin.py").write_text(PLUGIN)
    (folder / "wf.yaml").write_text(WORKFLOW)
    return folder / "wf.yaml"


def _view(name: str, pose: Rigid3) -> dict[str, object]:
    return {"image": name, "R": pose.rotation.tolist(), "t": pose.translation.tolist()}


def _spoil(path: Path, way: str) -> None:
    """Make a picture bad in one of the ways that concern its file."""
    data = path.read_bytes()
    match way:
        case "empty":
            path.write_bytes(b"")
        case "text":
            path.write_bytes(b"<html>404 Not Found</html>\n" * 40)
        case "cut":
            path.write_bytes(data[: len(data) // 2])
        case "flipped":
            middle = len(data) // 2
            path.write_bytes(
                data[:middle] + bytes(255 - byte for byte in data[middle : middle + 16]) + data[middle + 16 :]
            )
        case "square":
            write_png(path, np.full((_SIZE_HW[0], _SIZE_HW[0], 3), 128, np.uint8))
        case "small":
            write_png(path, np.full((4, 8, 3), 128, np.uint8))
