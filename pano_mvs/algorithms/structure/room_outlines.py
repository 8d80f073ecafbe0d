"""Find the room around a single panorama, in heights of its camera, from its picture alone.

The elevation of the crease of a wall with the floor gives its distance in heights of the camera, and that of its crease
with the ceiling then gives the height of the ceiling. Panoramas of one capture mostly have the same, so that all count:
a room and a smaller one of the same shape look alike in one picture, but not in several. Walls have four directions at
right angles, which line segments show; `best_walls` selects one for each azimuth.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.poses.frame.vertical_lines import find_segments
from pano_mvs.algorithms.poses.frame.walls import level_and_walls
from pano_mvs.algorithms.structure.outline import Labels, best_walls, pieces
from pano_mvs.algorithms.structure.skyline import Skyline, clearest_total, skyline, wall_distances
from pano_mvs.algorithms.structure.view import blurred
from pano_mvs.core.arrays import FloatArray, Picture
from pano_mvs.geometry import UP, Rigid3
from pano_mvs.scene.rooms import CEILINGS, Ceilings, RoomLines, RoomOutline

_COARSE_DISTANCES, _DISTANCES = np.geomspace(0.3, 9.0, 160), np.geomspace(0.3, 9.0, 200)
_TURN_STEP = 4  # every fourth azimuth shows the height of the ceiling
# What all panoramas say of the ceiling counts as four times what one says: with 4 to 1000, all of 119 panoramas of
# eight rendered houses have the height within 6 %, with 0 (the own picture alone) 72 %.
_COMMON_WEIGHT = 4.0
# Around the height that is common, what a change of its logarithm costs: the upper edges of skirting boards look like a
# ceiling that is 5 % higher. With 60 and 200 instead of 6, 93 and 96 % instead of 85 % of them are within 3 %.
_MOVED, _MOVING_COST = np.linspace(0.94, 1.06, 13), 100.0
# The logarithm of the odds that a wall's distance is within 5 % of the truth: a constant, the mean clarity along its
# piece beyond that of the clearest wall at another distance, and the logarithm of the azimuths of the piece. Fitted to
# 36,000 azimuths of eight rendered houses; of 7,100 in ZInD's sample tour, which had no part in it, 30, 43, 70 and 84 %
# are right where it says 35, 50, 69 and 90 %.
_ODDS, _OTHER_WALL = (-1.316, 2.315, 0.3425), 0.1


def lines_of(picture: Picture, valid: NDArray[np.bool_], up_in_cam: Sequence[float] | None = None) -> RoomLines:
    """Return what the lines of a panorama say of the room around it.

    Args:
        picture: (H, W, 3) RGB, the full sphere.
        valid: (H, W) pixels that count for line segments.
        up_in_cam: (3,) direction away from gravity, to some degrees; None: that of the picture's rows.
    """
    up = np.asarray(UP if up_in_cam is None else up_in_cam, np.float64)
    segments = find_segments({"": lambda: (picture, valid)}, {"": np.eye(3)})
    level_from_cam, wall = level_and_walls(segments, up)
    if wall is None:
        return RoomLines(level_from_cam.T, None, np.zeros(0, np.float32))
    around = skyline(blurred(picture), Rigid3(level_from_cam.T, np.zeros(3)), _TURN_STEP)
    return RoomLines(level_from_cam.T, wall, _ceiling_clarity(around, wall, CEILINGS).astype(np.float32))


def ceilings_of(panoramas: Iterable[RoomLines]) -> Ceilings:
    """Return what the lines of all panoramas of a capture say of the height of its ceilings."""
    clarity = [one.ceiling_clarity.astype(np.float64) for one in panoramas if one.wall_rad is not None]
    common = [of_one - np.median(of_one) for of_one in clarity] or [np.zeros(len(CEILINGS))]
    return Ceilings(np.mean(common, axis=0).astype(np.float32))


def outline_of(picture: Picture, lines: RoomLines, ceilings: Ceilings) -> RoomOutline:
    """Return the outline of the room around a panorama; unknown where the picture shows no walls at right angles.

    Args:
        picture: (H, W, 3) RGB, the full sphere.
        lines: of this panorama.
        ceilings: of the capture.
    """
    if lines.wall_rad is None:
        return RoomOutline.unknown(lines.cam_from_level)
    soft, level = blurred(picture), Rigid3(np.asarray(lines.cam_from_level), np.zeros(3))
    ceiling = _common_ceiling(lines, ceilings.clarity.astype(np.float64))
    coarse = _ceiling_clarity(skyline(soft, level, _TURN_STEP), lines.wall_rad, ceiling * _MOVED)
    ceiling *= float(_MOVED[np.argmax(coarse - _MOVING_COST * np.log(_MOVED) ** 2)])
    around = skyline(soft, level)
    distance = wall_distances(around, lines.wall_rad, _DISTANCES)
    clarity = around.clarity(distance, down=1.0, up=ceiling)
    label = best_walls(clarity, distance)
    azimuths = np.arange(len(label))
    found = np.where(label >= 0, distance[label, azimuths], np.nan)
    right = np.where(label >= 0, _probability(label, clarity, distance), np.nan)
    return RoomOutline(
        lines.cam_from_level, lines.wall_rad, ceiling, found.astype(np.float32), right.astype(np.float32)
    )


def _ceiling_clarity(around: Skyline, wall_rad: float, ceilings: FloatArray) -> FloatArray:
    """Return how clear the creases of walls are with the floor and with ceilings at some heights, (K,), from 0 to 2."""
    distance = wall_distances(around, wall_rad, _COARSE_DISTANCES)
    on_floor = around.crease_clarity(distance, -1.0)
    totals = [clearest_total(on_floor + around.crease_clarity(distance, height)) for height in ceilings.tolist()]
    result: FloatArray = np.array(totals) / distance.shape[1]
    return result


def _common_ceiling(lines: RoomLines, common: FloatArray) -> float:
    """Return the height of the ceiling that the lines of a panorama and of all panoramas show together."""
    step = int(np.argmax(lines.ceiling_clarity + _COMMON_WEIGHT * common))
    best = int(np.argmax(common))
    if abs(step - best) > 2 or not 0 < best < len(CEILINGS) - 1:
        return float(CEILINGS[step])
    before, at, after = common[best - 1 : best + 2]
    bend = before - 2 * at + after
    part = 0.5 * (before - after) / bend if bend < 0 else 0.0
    return float(CEILINGS[best] * (CEILINGS[1] / CEILINGS[0]) ** part)


def _probability(label: Labels, clarity: FloatArray, distance: FloatArray) -> FloatArray:
    """Return the probability that the distance of the wall at each azimuth is within 5 % of the truth, (A,)."""
    azimuths = np.arange(len(label))
    with np.errstate(invalid="ignore"):
        is_other = np.abs(np.log(distance / distance[label, azimuths])) > _OTHER_WALL
    beyond = clarity[label, azimuths] - np.where(is_other, np.maximum(clarity, 0.0), 0.0).max(axis=0)
    result = np.zeros(len(label))
    for start, end in pieces(label):
        piece = np.arange(start, end) % len(label)
        if label[piece[0]] < 0:
            continue
        odds = _ODDS[0] + _ODDS[1] * beyond[piece].mean() + _ODDS[2] * np.log(len(piece))
        result[piece] = 1 / (1 + np.exp(-odds))
    return result
