"""The rendered tours of the benchmark: cameras where they can stand, pictures that agree with their truth."""

from __future__ import annotations

import numpy as np
import pytest

from pano_mvs.geometry import pixel_from_ray
from tests.benchmarks.poses.tours.__main__ import HOUSES
from tests.benchmarks.poses.tours.materials import LAMP
from tests.benchmarks.poses.tours.plan import Style, build
from tests.benchmarks.poses.tours.rendering import lit, panorama


@pytest.mark.parametrize("name", HOUSES)
def test_houses_have_8_to_40_cameras_outside_all_boxes(name: str) -> None:
    boxes, cameras = build(HOUSES[name], seed=int(name[-2:]))
    assert 8 <= len(cameras) <= 40
    for camera in cameras:
        offsets = camera.pose.center - boxes.frames[:, :3]
        cosine, sine = boxes.frames[:, 6], boxes.frames[:, 7]
        along, across = cosine * offsets[:, 0] + sine * offsets[:, 1], cosine * offsets[:, 1] - sine * offsets[:, 0]
        local = np.abs(np.stack([along, across, offsets[:, 2]], axis=1))
        assert not (local < boxes.frames[:, 3:6] + 0.05).all(axis=1).any()


def test_a_house_depends_on_its_seed_alone() -> None:
    (first, _), (again, _), (other, _) = (build(Style(8.0), seed=seed) for seed in (1, 1, 2))
    assert np.array_equal(first.frames, again.frames)
    assert first.frames.shape != other.frames.shape or not np.array_equal(first.frames, other.frames)


def test_a_lamp_is_seen_where_the_pose_says() -> None:
    boxes, cameras = build(Style(8.0), seed=1)
    camera, size_hw = cameras[0], (128, 256)
    picture = panorama(lit(boxes, seed=1), camera.pose, size_hw=size_hw, rng=np.random.default_rng(0), tripod=True)
    lamps = boxes.frames[boxes.kinds[:, 0] == LAMP, :3]
    nearest = lamps[np.argmin(np.linalg.norm(lamps - camera.pose.center, axis=1))]
    x, y = pixel_from_ray(camera.pose.apply(nearest), size_hw).astype(int)
    assert picture[y, x].min() > 240
    assert picture[-1].max() < 60  # the tripod
    assert 60 < np.median(picture) < 220
