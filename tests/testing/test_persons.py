"""People that are drawn into panoramas stand in the world: all views show the same."""

from __future__ import annotations

import numpy as np
import pytest

from pano_mvs.geometry import Rigid3, pixel_from_ray, ray_grid
from tests.synthetic.persons import OUTFITS, POSES, draw_people, person

SIZE_HW = (64, 128)
GROUND_Y = 1.6


def blank_view(center: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray, Rigid3]:
    """A grey plane under a sky without surfaces."""
    pose = Rigid3.from_center(np.eye(3), np.array(center))
    down = ray_grid(SIZE_HW)[..., 1]
    ranges = np.where(down > 0.02, (GROUND_Y - center[1]) / np.maximum(down, 0.02), np.nan).astype(np.float32)
    return np.full((*SIZE_HW, 3), 120, np.uint8), ranges, pose


@pytest.mark.parametrize("pose", POSES)
def test_another_view_shows_the_same_person(pose: str) -> None:
    somebody = person(pose, "jacket", at_xz=(0.6, 0.8), ground_y=GROUND_Y, heading=0.3)
    first, second = (
        draw_people(*blank_view(center), people=[somebody]) for center in ((0.0, 0.0, 0.0), (1.5, 0.1, 1.2))
    )
    assert first.people.sum() > 40
    points = (ray_grid(SIZE_HW) * first.ranges[..., None])[first.people] - (1.5, 0.1, 1.2)
    distances = np.linalg.norm(points, axis=1)
    x, y = np.floor(pixel_from_ray(points / distances[:, None], SIZE_HW)).astype(int).T
    around = second.people | np.roll(second.people, 1, axis=0) | np.roll(second.people, -1, axis=0)
    around |= np.roll(around, 1, axis=1) | np.roll(around, -1, axis=1)
    assert around[np.minimum(y, SIZE_HW[0] - 1), x % SIZE_HW[1]].mean() > 0.97
    assert (points[:, 1] + 0.1 < GROUND_Y + 0.02).all()


def test_people_are_hidden_by_what_is_nearer() -> None:
    picture, ranges, pose = blank_view((0.0, 0.0, 0.0))
    somebody = person("standing", "shirt", at_xz=(0.0, 3.0), ground_y=GROUND_Y, heading=0.0)
    drawn = draw_people(picture, np.full_like(ranges, 1.0), pose, people=[somebody], shadows=False)
    assert not drawn.people.any()
    np.testing.assert_array_equal(drawn.picture, picture)


def test_shadows_lie_on_the_ground() -> None:
    picture, ranges, pose = blank_view((0.0, 0.0, 0.0))
    somebody = person("crouching", "black", at_xz=(0.5, 0.0), ground_y=GROUND_Y, heading=0.0)
    drawn = draw_people(picture, ranges, pose, people=[somebody])
    assert drawn.shadow.sum() > 20
    assert not (drawn.shadow & drawn.people).any()
    assert (drawn.picture[drawn.shadow] < 70).all()
    np.testing.assert_array_equal(drawn.ranges[drawn.shadow], ranges[drawn.shadow])
    assert not draw_people(picture, ranges, pose, people=[somebody], shadows=False).shadow.any()


def test_outfits_differ() -> None:
    view = blank_view((0.0, 0.0, 0.0))
    colors = set()
    for outfit in OUTFITS:
        drawn = draw_people(*view, people=[person("bent", outfit, at_xz=(0.1, 0.1), ground_y=GROUND_Y, heading=1.0)])
        colors.add(tuple(np.rint(drawn.picture[drawn.people].mean(axis=0) / 8)))
    assert len(colors) == len(OUTFITS)
