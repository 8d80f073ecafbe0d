"""Find where the parts of a house stand, from the links between their panoramas and the directions of their walls."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs_tours.parts import Part, PartLink

_DIRECTION_STD = np.deg2rad(12.0)
_LENGTH_STD = 0.4  # of the logarithm of the length of a link that meets the floor
_USUAL_LENGTH, _USUAL_STD = 2.3, 0.5  # of a link, in camera heights, and standard deviation of its logarithm
_WALL_STD = np.deg2rad(2.0)
_HEIGHT_STD = 0.06  # of the logarithm of a height above the floor; see `joining.floors`
_STARTS, _LEAST_STARTS = 16, 4  # trees from which the search begins; fewer for more than 12 parts
_EQUALLY_GOOD = 1.0  # difference of costs, which are half the sums of squares, within which solutions may be right


@dataclass(frozen=True, eq=False)
class Place:
    """Where a part stands in the plan of a house, whose unit is the height of the cameras above the floor.

    Deviations are relative to the first part, and infinite if nothing determines the value.
    """

    position: FloatArray  # (2,) x and z of the origin of the part, which lies amid its cameras
    turn_rad: float  # by which directions in the part are turned, from z towards x
    scale: float  # the unit of the part
    position_std: float
    turn_std_rad: float


def layout(parts: Sequence[Part], links: Sequence[PartLink], *, rng: np.random.Generator) -> list[Place | None]:
    """Return the place of each part that links join with the first one, in whose frame all are; None for the others.

    The robust cost of all links is minimised: of their directions, of their lengths where they meet the floor, and of
    walls, which are at right angles in the whole house. Links are hardly exact, and through doors they show the door,
    so that single ones may be 30° off. As directions have many local minima, the search begins with several trees of
    links, in which two links that lead back and forth say how one part is turned relative to the other. Where solutions
    that are equally good differ, their difference counts as deviation.

    Args:
        parts: the one in whose frame the others are placed is the first.
        links: between their panoramas, and within them.
        rng: chooses the trees.
    """
    joined = _joined(len(parts), links)
    used = [link for link in links if link.parts[0] in joined]

    def residuals(values: FloatArray) -> FloatArray:
        return _residuals(values.reshape(-1, 4), parts, used, joined=joined)

    starts = min(_STARTS, max(_LEAST_STARTS, 12 * _STARTS // len(joined))) if len(joined) > 1 else 1
    solutions = [
        scipy.optimize.least_squares(
            residuals, _start(parts, joined, used, rng=rng).ravel(), loss="cauchy", xtol=1e-10, ftol=1e-10
        )
        for _ in range(starts)
    ]
    # Of solutions whose costs differ by no more than rounding, the first one.
    least = min(float(one.cost) for one in solutions)
    best = next(one for one in solutions if one.cost <= least * (1 + 1e-6) + 1e-6)
    values = best.x.reshape(-1, 4)
    stds = _deviations(np.asarray(best.jac)).reshape(-1, 4)
    position_stds, turn_stds = np.hypot(stds[:, 0], stds[:, 1]), stds[:, 2]
    for one in solutions:
        if one.cost <= least + _EQUALLY_GOOD:
            off = one.x.reshape(-1, 4) - values
            position_stds = np.maximum(position_stds, np.hypot(off[:, 0], off[:, 1]))
            turn_stds = np.maximum(turn_stds, np.abs(_within(off[:, 2], 2 * np.pi)))
    position_stds[0] = turn_stds[0] = 0.0
    places: list[Place | None] = [None] * len(parts)
    for row, number in enumerate(joined):
        x, z, turn, log_scale = values[row].tolist()
        places[number] = Place(
            np.array([x, z]),
            float(np.angle(np.exp(1j * turn))),
            float(np.exp(log_scale)),
            float(position_stds[row]),
            float(turn_stds[row]),
        )
    return places


def _joined(count: int, links: Sequence[PartLink]) -> list[int]:
    """Return the parts that links join with the first one, in ascending order."""
    reached = {0}
    while more := {
        number for link in links for number in link.parts if number not in reached and reached & {*link.parts}
    }:
        reached |= more
    return [number for number in range(count) if number in reached]


def _start(
    parts: Sequence[Part], joined: Sequence[int], links: Sequence[PartLink], *, rng: np.random.Generator
) -> FloatArray:
    """Return rows of x, z, turn and logarithm of the scale, (K, 4), along a random tree of links."""
    scales = {number: _first_scale(parts[number]) for number in joined}
    values = {0: (0.0, 0.0, 0.0)}
    while len(values) < len(joined):
        open_links = [link for link in links if (link.parts[0] in values) != (link.parts[1] in values)]
        back_and_forth = [
            link
            for link in open_links
            if link.parts[0] in values and any(other.parts == link.parts[::-1] for other in open_links)
        ]
        # Without a link in the other direction, how the next part is turned is a guess.
        link = (back_and_forth or open_links)[int(rng.integers(len(back_and_forth or open_links)))]
        here, there = link.parts if link.parts[0] in values else link.parts[::-1]
        back = [other for other in open_links if other.parts == (there, here)]
        x, z, turn = values[here]
        if link.parts[0] == here:
            azimuth = turn + link.azimuth_rad
            next_turn = float(rng.uniform(-np.pi, np.pi))
            if back:
                next_turn = azimuth + np.pi - back[int(rng.integers(len(back)))].azimuth_rad
            next_turn = _snapped(next_turn, parts, there)
        else:
            next_turn = _snapped(float(rng.uniform(-np.pi, np.pi)), parts, there)
            azimuth = next_turn + link.azimuth_rad + np.pi
        own, other = link.centers if link.parts[0] == here else link.centers[::-1]
        length = link.length if np.isfinite(link.length) else _USUAL_LENGTH
        at = np.array([x, z]) + scales[here] * _turned(own, turn)
        at += length * np.array([np.sin(azimuth), np.cos(azimuth)]) - scales[there] * _turned(other, next_turn)
        values[there] = (float(at[0]), float(at[1]), next_turn)
    return np.array([(*values[number], np.log(scales[number])) for number in joined])


def _first_scale(part: Part) -> float:
    """Return how many camera heights the unit of a part is, by the height above its floor, else a usual value."""
    if part.is_single:
        return 1.0
    if np.isfinite(part.height):
        return 1 / part.height
    centers = np.array([pose.center for pose in part.cameras.values()])
    apart = np.linalg.norm(centers[:, None] - centers, axis=2)
    nearest = np.where(apart > 1e-6 * apart.max(), apart, np.inf).min(axis=1)  # copies stand at one position
    known = np.isfinite(nearest)
    return float(_USUAL_LENGTH / np.median(nearest[known])) if known.any() else 1.0


def _snapped(turn: float, parts: Sequence[Part], number: int) -> float:
    """Return the turn nearest to a given one with which the walls of a part are parallel to those of the first one."""
    off = turn + parts[number].wall_rad - parts[0].wall_rad
    return float(turn - _within(off, np.pi / 2)) if np.isfinite(off) else turn


def _within(angle: FloatArray | float, period: float) -> FloatArray:
    """Return the angle within half a period around 0."""
    return np.asarray((np.asarray(angle) + period / 2) % period - period / 2)


def _turned(xz: FloatArray, turn: FloatArray | float) -> FloatArray:
    """Return positions x and z (…, 2) whose azimuths, from z towards x, have grown by a turn."""
    sine, cosine = np.sin(turn), np.cos(turn)
    return np.stack([cosine * xz[..., 0] + sine * xz[..., 1], cosine * xz[..., 1] - sine * xz[..., 0]], axis=-1)


def _residuals(
    values: FloatArray, parts: Sequence[Part], links: Sequence[PartLink], *, joined: Sequence[int]
) -> FloatArray:
    """Return the residuals of the places of the joined parts, (K, 4), in standard deviations."""
    row = {number: idx for idx, number in enumerate(joined)}
    turns = values[:, 2]
    heights = np.array([parts[number].height if not parts[number].is_single else 1.0 for number in joined])
    walls = np.array([parts[number].wall_rad for number in joined])
    fixed = np.isfinite(heights)
    of_parts = [
        1e3 * values[0, :3],  # the first part stays where it is
        (values[fixed, 3] + np.log(heights[fixed])) / _HEIGHT_STD,
        (values[~fixed, 3] - np.log([_first_scale(parts[joined[idx]]) for idx in np.flatnonzero(~fixed).tolist()]))
        / 1.0,
    ]
    if np.isfinite(walls[0]):
        known = np.isfinite(walls)
        of_parts.append(_within(turns + walls - walls[0], np.pi / 2)[known] / _WALL_STD)
    if not links:
        return np.concatenate(of_parts)
    ends: NDArray[np.intp] = np.array([[row[number] for number in link.parts] for link in links], np.intp)
    centers = np.array([link.centers for link in links])
    there = values[ends][..., :2] + np.exp(values[ends][..., 3:]) * _turned(centers, turns[ends])
    offsets = there[:, 1] - there[:, 0]
    stated = np.array([link.azimuth_rad for link in links]) + turns[ends[:, 0]]
    off = _within(np.arctan2(offsets[:, 0], offsets[:, 1]) - stated, 2 * np.pi) / _DIRECTION_STD
    lengths = np.array([link.length for link in links])
    logs = np.log(np.maximum(np.linalg.norm(offsets, axis=1), 1e-6))
    known = np.isfinite(lengths)
    long = np.where(known, (logs - np.log(np.where(known, lengths, 1.0))) / _LENGTH_STD, 0.0)
    usual = np.where(known, 0.0, (logs - np.log(_USUAL_LENGTH)) / _USUAL_STD)
    return np.concatenate([*of_parts, off[ends[:, 0] != ends[:, 1]], long + usual])


def _deviations(jacobian: FloatArray) -> FloatArray:
    """Return the standard deviation of each unknown; infinite where nothing determines it."""
    values, vectors = np.linalg.eigh(jacobian.T @ jacobian)
    with np.errstate(divide="ignore"):
        variances = np.where(values > 1e-9 * max(values[-1], 1e-300), 1 / np.maximum(values, 1e-300), np.inf)
        spread = np.where(np.abs(vectors) > 1e-6, vectors**2, 0.0)
        known = np.isfinite(variances)
        total = spread[:, known] @ variances[known]
    return np.sqrt(np.where((spread[:, ~known] > 0).any(axis=1), np.inf, total))
