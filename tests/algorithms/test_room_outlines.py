"""The room around a single panorama is outlined by its picture alone."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.poses.frame.vertical_lines import find_segments, turn_into_walls
from pano_mvs.algorithms.poses.frame.walls import walls_of_picture
from pano_mvs.algorithms.structure.room_outlines import ceilings_of, lines_of, outline_of
from pano_mvs.geometry import UP, ray_grid, rotation_from_rotvec
from pano_mvs.scene import RoomLines
from pano_mvs.scene.rooms import OUTLINE_AZIMUTHS
from tests.synthetic.drawn_rooms import COLORS, SIZE_HW, TILT, box, true_distances

ALL = np.ones(SIZE_HW, np.bool_)


@pytest.mark.slow
def test_a_plain_room_is_outlined_in_heights_of_the_camera() -> None:
    picture = box()
    lines = lines_of(picture, ALL)
    assert np.degrees(lines.wall_rad or 0.0) == pytest.approx(25.0, abs=0.3)
    outline = outline_of(picture, lines, ceilings_of([lines]))
    outline.check()
    assert outline.ceiling == pytest.approx(0.7, rel=0.02)
    off = np.abs(outline.distances / true_distances() - 1)
    assert np.median(off) < 0.01
    assert np.mean(off < 0.05) > 0.95
    assert np.median(outline.probabilities) > 0.8


@pytest.mark.slow
def test_the_camera_is_levelled_by_the_lines_of_its_picture() -> None:
    lines = lines_of(box(), ALL)
    up = lines.cam_from_level @ UP
    assert np.degrees(np.arccos(up @ (TILT @ UP))) < 0.2
    # Without a sensor, up to 15° from the rows of the picture; what a sensor says is where the search begins.
    leaning = rotation_from_rotvec(np.radians([-14.0, 0.0, 2.0]))
    lines = lines_of(box(cam_from_level=leaning), ALL)
    assert np.degrees(np.arccos(lines.cam_from_level @ UP @ (leaning @ UP))) < 0.2
    tilted = rotation_from_rotvec(np.radians([25.0, 0.0, 0.0]))
    given = lines_of(box(cam_from_level=tilted), ALL, tuple(rotation_from_rotvec((0.02, 0, 0.01)) @ tilted @ UP))
    assert np.degrees(np.arccos(given.cam_from_level @ UP @ (tilted @ UP))) < 0.2


def test_lines_along_walls_say_how_a_camera_is_tilted() -> None:
    segments = find_segments({"": lambda: (box(), ALL)}, {"": np.eye(3)})
    turn, weight = turn_into_walls(segments, np.radians(25.0))
    assert 0 < weight <= segments.weights.sum()
    assert np.degrees(np.arccos(turn @ UP @ (TILT @ UP))) < 0.2


@pytest.mark.slow
def test_the_frame_of_walls_is_upright_and_along_them() -> None:
    found = walls_of_picture(box(), ALL, UP)
    assert found is not None
    walls = rotation_from_rotvec((0.0, np.radians(25.0), 0.0))[:, [0, 2]].T @ TILT.T
    across = np.abs(walls @ found.T)  # of either wall, by the axes of the frame
    assert np.degrees(np.arccos(across[:, [0, 2]].max(axis=1))) == pytest.approx(0.0, abs=0.5)
    assert np.degrees(np.arccos(-(found @ TILT @ UP)[1])) < 0.2
    assert walls_of_picture(NOISE, ALL, UP) is None
    # A panorama of more columns is reduced, and what is masked does not count.
    large = np.repeat(np.repeat(box(), 4, axis=0), 4, axis=1)
    assert walls_of_picture(large, np.ones(large.shape[:2], np.bool_), UP) is not None
    assert walls_of_picture(large, np.zeros(large.shape[:2], np.bool_), UP) is None


SHADE = np.broadcast_to(np.linspace(60, 200, SIZE_HW[0])[:, None, None], (*SIZE_HW, 3)).astype(np.uint8)
NOISE = np.random.default_rng(1).integers(0, 256, (*SIZE_HW, 3), np.uint8)


@pytest.mark.parametrize("picture", [SHADE, NOISE], ids=["shade", "noise"])
def test_a_picture_without_walls_has_no_outline(picture: NDArray[np.uint8]) -> None:
    lines = lines_of(picture, ALL)
    lines.check()
    assert lines.wall_rad is None
    outline = outline_of(picture, lines, ceilings_of([lines]))
    outline.check()
    assert outline.ceiling is None
    assert np.isnan(outline.distances).all()


@pytest.mark.slow
def test_other_panoramas_say_how_high_the_ceiling_is() -> None:
    """What is painted like the ceiling looks like a lower one; the other rooms of the house have none."""
    clear, seen = box(), box().astype(np.float64)
    rays = ray_grid(SIZE_HW) @ TILT
    level = np.hypot(rays[..., 0], rays[..., 2])
    azimuth = np.round(np.degrees(np.arctan2(rays[..., 0], rays[..., 2]))).astype(int) % OUTLINE_AZIMUTHS
    height = -rays[..., 1] / level * true_distances()[azimuth]  # above the camera, on the walls
    seen[(height > 0.45) & (height < 0.7)] = COLORS[1] - 10
    picture = seen.round().astype(np.uint8)
    own = lines_of(picture, ALL)
    alone = outline_of(picture, own, ceilings_of([own]))
    assert alone.ceiling == pytest.approx(0.45, rel=0.05)
    others = [lines_of(box(turn, walls=walls), ALL) for turn, walls in ((10.0, (1.0, 2.0, 3.0, 1.3)),)]
    together = ceilings_of([own, *others])
    assert outline_of(clear, lines_of(clear, ALL), together).ceiling == pytest.approx(0.7, rel=0.02)
    assert outline_of(picture, own, together).ceiling == pytest.approx(0.7, rel=0.05)


def test_nothing_is_said_of_a_capture_without_walls() -> None:
    assert not ceilings_of([RoomLines.unknown()]).clarity.any()
