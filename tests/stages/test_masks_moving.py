"""The stage masks.moving: images keep their masks, and get those of what moves."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.engine.stages.context import Context
from pano_mvs.geometry import Rigid3
from pano_mvs.scene import FilePart, Panorama, Pose, RangeMap
from pano_mvs.scene.image_file import write_png
from pano_mvs.stages.masks import MovingParams, moving
from pano_mvs.testing.room import default_room, render
from tests.synthetic.persons import draw_people, person

SIZE_HW = (128, 256)
CENTERS = {"a.png": (0.0, 0.0, 0.0), "b.png": (0.7, 0.05, 0.3), "c.png": (-0.5, -0.05, 0.6), "d.png": (0.1, 0.0, -0.7)}


class Capture:
    """Four views of a room; a black figure crouches below the first camera."""

    def __init__(self, folder: Path) -> None:
        self.images: dict[str, Panorama] = {}
        self.ranges: dict[str, RangeMap] = {}
        self.poses: dict[str, Pose] = {}
        self.people: NDArray[np.bool_] = np.zeros(SIZE_HW, np.bool_)
        room = default_room(0, "weak")
        for name, center in CENTERS.items():
            pose = Rigid3.from_center(np.eye(3), np.array(center))
            picture, ranges = render(room, pose, SIZE_HW, supersample=1)
            if name == "a.png":
                operator = person("crouching", "black", at_xz=(0.1, 0.15), ground_y=1.3, heading=0.7)
                drawn = draw_people(picture, ranges, pose, people=[operator], shadows=False)
                picture, self.people = drawn.picture, drawn.people
            write_png(folder / name, picture)
            self.images[name] = Panorama(FilePart(folder / name), size_hw=SIZE_HW, source_size_hw=SIZE_HW)
            self.ranges[name] = RangeMap(ranges, np.where(np.isfinite(ranges), 200, 0).astype(np.uint8))
            self.poses[name] = Pose(pose)

    def masked(self, name: str, folder: Path, **settings: bool) -> NDArray[np.bool_]:
        context = Context(np.random.default_rng(0), folder, 1)
        params = MovingParams(**settings)
        near = [other for other in dict.fromkeys((name, *CENTERS)) if other in self.ranges and other in self.poses]
        images, ranges, poses = ([of[other] for other in near] for of in (self.images, self.ranges, self.poses))
        found = moving(self.images[name], images, ranges, poses, params, context)  # type: ignore[arg-type]
        return ~found.load_mask()


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    return Capture(tmp_path_factory.mktemp("moving"))


def test_the_operator_is_masked_in_the_view_that_shows_them(capture: Capture, tmp_path: Path) -> None:
    assert capture.masked("a.png", tmp_path)[capture.people].mean() > 0.9
    assert not capture.masked("b.png", tmp_path).any()


def test_it_can_be_switched_off(capture: Capture, tmp_path: Path) -> None:
    assert not capture.masked("a.png", tmp_path, enabled=False).any()


def test_earlier_masks_remain(capture: Capture, tmp_path: Path) -> None:
    valid = np.ones(SIZE_HW, np.bool_)
    valid[:10, :20] = False
    before = capture.images["a.png"]
    capture.images["a.png"] = before.with_mask(valid, tmp_path)
    masked = capture.masked("a.png", tmp_path)
    capture.images["a.png"] = before
    assert masked[:10, :20].all()
    assert masked[capture.people].mean() > 0.9


def test_images_without_pose_or_neighbours_stay_as_they_are(capture: Capture, tmp_path: Path) -> None:
    poses = dict(capture.poses)
    del capture.poses["a.png"]
    assert not capture.masked("a.png", tmp_path).any()
    capture.poses = {name: replace(pose, group=idx) for idx, (name, pose) in enumerate(poses.items())}
    assert not capture.masked("a.png", tmp_path).any()
    capture.poses = poses
