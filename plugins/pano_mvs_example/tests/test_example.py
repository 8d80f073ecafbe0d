"""The example's stages keep the contract of all stages, and do what they are for."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pano_mvs.api import Context, PointCloud, Rigid3
from pano_mvs.testing.conformance import ContractTest, stage_contract_tests
from pano_mvs.testing.room import Room, render
from pano_mvs.testing.surfaces import Cuboid, Quad

from pano_mvs_example import sky, xyz
from pano_mvs_example.sky_mask import SkyParams, find_sky
from pano_mvs_example.xyz_file import XyzParams

SIZE_HW = (128, 256)


@pytest.mark.parametrize("contract_test", [*stage_contract_tests(sky), *stage_contract_tests(xyz)], ids=str)
def test_keeps_the_contract(contract_test: ContractTest) -> None:
    contract_test.check()


@pytest.mark.parametrize("seed", [1, 2])
def test_the_sky_is_found_and_little_else(seed: int) -> None:
    brick = ((0.62, 0.36, 0.27), (0.50, 0.40, 0.33))
    ground = Quad((-30.0, 1.6, -30.0), (60.0, 0.0, 0.0), (0.0, 0.0, 60.0), brick)
    yard = (
        ground,
        Cuboid((-9.0, -2.0, 6.0), (9.0, 1.6, 7.0), brick),
        Cuboid((-8.0, -3.5, -9.0), (2.0, 1.6, -5.0), brick),
    )
    room = Room(yard, "outdoor", seed, sky=((0.36, 0.55, 0.86), (0.80, 0.86, 0.92)))
    picture, ranges = render(room, Rigid3.identity(), SIZE_HW)
    truth = np.isnan(ranges)
    found = find_sky(picture, np.ones(SIZE_HW, np.bool_), SkyParams(margin_px=0))
    assert (found & truth).sum() / truth.sum() > 0.9
    assert (found & ~truth).sum() / (~truth).sum() < 0.02


def test_a_sky_on_the_seam_is_joined_over_it() -> None:
    """A pillar in the middle parts the sky for whoever does not know that the sphere goes round."""
    picture = np.zeros((32, 64, 3), np.uint8)
    picture[:16] = (120, 170, 230)
    picture[0, :24] = picture[0, 40:] = 0  # the way to the zenith is in the middle …
    picture[:16, 20:24] = picture[1:16, 44:48] = 0  # … between two pillars, the left one whole
    picture[10:12, 44:48] = (120, 170, 230)  # … the right one with a gap
    params = SkyParams(max_contrast=255, margin_px=0)
    everywhere = np.ones((32, 64), np.bool_)
    found = find_sky(picture, everywhere, params)
    assert found[8, 30]
    assert found[8, 60]
    assert found[8, 5]
    for columns in (7, 21, 42):
        rolled = find_sky(np.roll(picture, columns, axis=1), everywhere, params)
        np.testing.assert_array_equal(rolled, np.roll(found, columns, axis=1))


def test_points_are_written_a_line_each(tmp_path: Path) -> None:
    points = np.array([[1, 2.5, -3], [4, 5, 6]], np.float32)
    colors = np.array([[1, 2, 3], [250, 0, 9]], np.uint8)
    cloud = PointCloud(points, np.zeros_like(points), colors, np.array([1, 3], np.uint8))
    parts = xyz(cloud, XyzParams(min_views=1), Context(np.random.default_rng(0), tmp_path))
    text = parts.files["cloud.xyz"].read_text()
    assert text == "1.0000 2.5000 -3.0000 1 2 3\n4.0000 5.0000 6.0000 250 0 9\n"
    fewer = xyz(cloud, XyzParams(min_views=2, digits=1), Context(np.random.default_rng(0), tmp_path))
    assert fewer.files["cloud.xyz"].read_text() == "4.0 5.0 6.0 250 0 9\n"
