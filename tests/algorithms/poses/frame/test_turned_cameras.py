"""The vertical of cameras that were turned in any way, on the panoramas of the sample."""

from __future__ import annotations

from functools import cache, partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.poses.frame.upside_down import ups_of_picture
from pano_mvs.algorithms.poses.frame.vertical import find_vertical
from pano_mvs.algorithms.poses.frame.vertical_lines import Picture, find_segments, orthogonal_directions
from pano_mvs.geometry import Rigid3, angle_between, ray_grid, rotate_panorama
from pano_mvs.scene.image_file import decode_image
from tests.algorithms.poses.frame.test_vertical import with_points
from tests.algorithms.poses.synthetic_capture import random_rotation

UP = np.array([0.0, -1.0, 0.0])
IMAGES = Path(__file__).parents[4] / "workflows" / "samples" / "classroom" / "images"


@cache
def turned(seed: int) -> dict[str, tuple[NDArray[np.float64], NDArray[np.uint8]]]:
    """Each panorama of the sample, whose cameras are level, turned at random, with new_from_old."""
    rng = np.random.default_rng(seed)
    capture = {}
    for path in sorted(IMAGES.glob("*.png")):
        rotation = random_rotation(rng)
        picture = cv2.resize(decode_image(path), (1024, 512), interpolation=cv2.INTER_AREA)
        capture[path.name] = rotation, rotate_panorama(picture, rotation)
    return capture


@pytest.mark.slow
def test_a_turned_panorama_has_its_zenith_among_the_likely_ones() -> None:
    for name, (rotation, picture) in turned(0).items():
        ups = ups_of_picture(picture, np.ones(picture.shape[:2], np.bool_))
        off = np.rad2deg(angle_between(np.array(ups), rotation @ UP))
        assert off.min() < 2, name
        assert len(ups) <= 4, name


def test_without_lines_the_own_up_direction_counts() -> None:
    plain = np.full((128, 256, 3), 120, np.uint8)
    valid = np.ones(plain.shape[:2], np.bool_)
    assert orthogonal_directions(find_segments({"": lambda: (plain, valid)}, {"": np.eye(3)})) is None
    np.testing.assert_array_equal(ups_of_picture(plain, valid), [UP])


@pytest.mark.slow
def test_a_capture_of_turned_cameras_has_a_vertical() -> None:
    """The points are those that the first panorama sees, and the world is turned as well."""
    capture = turned(0)
    world = random_rotation(np.random.default_rng(9))
    ranges = np.load(IMAGES.parent / "truth" / "depth.npz")["000"][::8, ::8]
    points = (ray_grid(ranges.shape) * ranges[..., None])[np.isfinite(ranges)]
    cameras = [Rigid3(rotation @ world.T, np.zeros(3)) for rotation, _ in capture.values()]
    poses = with_points(cameras, points @ world.T)
    pictures: dict[str, Picture] = {
        name: partial(lambda one: (one, np.ones(one.shape[:2], np.bool_)), picture)
        for name, (_, picture) in zip(poses.names, capture.values(), strict=True)
    }
    vertical = find_vertical(poses, pictures=pictures)
    assert vertical, vertical.reason
    assert np.rad2deg(angle_between(vertical.up_in_world, world @ UP)) < 0.5
    assert "turned in all directions" in vertical.evidence
    assert not find_vertical(poses)


def test_a_masked_cap_does_not_decide_which_way_is_up() -> None:
    """A logo below the tripod, brighter than any ceiling."""
    picture = cv2.resize(decode_image(IMAGES / "000.png"), (512, 256), interpolation=cv2.INTER_AREA)
    below = (np.arange(256) + 0.5) / 256 * 180 > 90 + 54
    picture = np.where(below[:, None, None], np.uint8(255), picture)
    ups = ups_of_picture(picture, np.broadcast_to(~below[:, None], picture.shape[:2]))
    assert ups[0] @ UP > 0.99
