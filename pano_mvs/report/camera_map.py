"""Draw the cameras from above and from the side, with the links of the match graph."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath

import numpy as np

from pano_mvs.algorithms.points.plan_grid import bar_length, bar_text
from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.text import plural
from pano_mvs.geometry import rotation_from_two_vectors
from pano_mvs.results.figures import significant
from pano_mvs.results.records import Direction, PairLink, PosesSummary
from pano_mvs.scene import WorldAxes

_WINDOW = 10  # cameras whose positions in the capture differ by at most this follow each other closely


@dataclass(frozen=True)
class WalkPath:
    """A walk."""

    # positions of the cameras in order; a new stretch begins where consecutive cameras are not matched
    stretches: tuple[tuple[int, ...], ...]

    @staticmethod
    def is_closure(first: int, second: int) -> bool:
        """Return whether a pair of positions in the order of the capture is a loop closure."""
        return abs(first - second) > _WINDOW


def find_walk(count: int, pairs: Sequence[tuple[int, int]]) -> WalkPath | None:
    """Return the walk along which cameras were taken, or None if they were not taken along one.

    They were if they are many, most consecutive ones are matched, and most pairs are of cameras that follow each other
    closely, although many others would have been possible.
    """
    if count < 20 or not pairs:
        return None
    distinct = {(min(pair), max(pair)) for pair in pairs}
    near = sum(b - a <= _WINDOW for a, b in distinct)
    consecutive = [(idx, idx + 1) in distinct for idx in range(count - 1)]
    is_walk = (
        sum(consecutive) >= 0.8 * (count - 1)
        and near >= 0.6 * len(distinct)
        and (len(distinct) <= 0.25 * count * (count - 1) / 2 or near == len(distinct))
    )
    if not is_walk:
        return None
    stretches: list[list[int]] = [[0]]
    for idx, is_matched in enumerate(consecutive, start=1):
        if is_matched:
            stretches[-1].append(idx)
        else:
            stretches.append([idx])
    return WalkPath(tuple(tuple(stretch) for stretch in stretches))


# In units of the drawing, which is about 310 px wide on a phone and 510 px on a desk. Labels are placed for the phone,
# where text is larger in these units.
_WIDTH, _HEIGHT, _BORDER = 360, 320, 40
_MAX_LABELS = 40


@dataclass(frozen=True)
class Link:
    """One matched pair, drawn."""

    ends: tuple[float, float, float, float]  # x1, y1, x2, y2
    strength: float  # from 0 to 1, by its inliers
    text: str  # the tooltip
    rejected: bool  # whether no common geometry was found
    closure: bool = False  # whether it closes a loop of a walk


@dataclass(frozen=True)
class CameraMap:
    """One drawing, in the units of an SVG view box."""

    title: str  # the caption, which names the direction of view
    text: str  # description for screen readers
    size_wh: tuple[int, int]
    links: tuple[Link, ...]  # in drawing order: rejected links, then weak ones, then strong ones
    # (x, y, name, position of the label or None)
    cameras: tuple[tuple[float, float, str, tuple[float, float] | None], ...]
    dots: str  # an SVG path of the cameras if there are too many to name
    bar: tuple[float, float, float, str]  # (x, y, length, text) of the scale bar
    north: bool = False  # whether north is upwards
    # (x, y, name, reason) of cameras whose poses are doubtful; drawn above the others
    doubtful: tuple[tuple[float, float, str, str], ...] = ()
    # the probability that the pose of each of `cameras` is right, None where unknown; empty if all are
    judged: tuple[float | None, ...] = ()
    # (x, y, number) of places to stand, numbered as in the list of suggestions; only from above
    marks: tuple[tuple[float, float, int], ...] = ()
    # an SVG path along the cameras of a walk in their order; empty if they were not taken along one
    path: str = ""
    # (x, y) of the first and the last camera of a walk whose cameras have no labels
    ends: tuple[tuple[float, float], ...] = ()

    @property
    def radius(self) -> float:
        """The radius at which a camera is drawn."""
        return 4.5 if len(self.cameras) <= _MAX_LABELS else 2.5 if len(self.cameras) <= 150 else 1.6

    @property
    def closures(self) -> int:
        """The number of drawn pairs that close loops of a walk."""
        return sum(link.closure for link in self.links)

    @property
    def rejected(self) -> int:
        """The number of rejected pairs that are drawn."""
        return sum(link.rejected for link in self.links)


def camera_maps(
    poses: PosesSummary,
    reasons: Mapping[tuple[str, str], str] | None = None,
    *,
    marks: Sequence[tuple[int, Direction]] = (),
) -> tuple[CameraMap, ...]:
    """Return the cameras from above and from the side; nothing if no centre is known.

    Args:
        poses: of one group of cameras.
        reasons: why pairs have no common geometry, if known.
        marks: number and position in the world of places to stand, drawn from above. Those outside of the map are drawn
            at its edge.
    """
    names = list(poses.registered)
    centers = np.array(poses.centers, dtype=np.float64).reshape(-1, 3)
    if not names or len(centers) != len(names) or not np.isfinite(centers).all():
        return ()
    level_from_world = rotation_from_two_vectors(up_of(poses), (0, -1, 0))
    centers = centers @ level_from_world.T
    places = np.array([place for _, place in marks], np.float64).reshape(-1, 3) @ level_from_world.T
    unit = "m" if poses.metric else "scene units"
    short = [PurePosixPath(name).stem for name in names]
    labels = short if len(set(short)) == len(short) else list(names)
    position = {name: idx for idx, name in enumerate(names)}
    # There may be half a million of them, so only those that are drawn get words.
    links = [link for link in poses.links if link.first in position and link.second in position]
    walk = find_walk(len(names), [(position[link.first], position[link.second]) for link in links if link.inliers])
    chosen = _chosen(links, position, labels, reasons=reasons or {}, walk=walk)
    north = poses.axes is WorldAxes.NORTH
    doubts = {idx: poses.doubts[name] for idx, name in enumerate(names) if name in poses.doubts}
    return tuple(
        _drawn(
            title,
            _flat(centers, axes),
            labels,
            marks=[(number, at) for (number, _), at in zip(marks, _flat(places, axes), strict=True)]
            if title == "From above"
            else (),
            links=chosen,
            walk=walk,
            doubts=doubts,
            judged=tuple(map(poses.p_right.get, names)) if poses.p_right else (),
            unit=unit,
            tallest=tallest,
            north=north and title == "From above",
        )
        for title, axes, tallest in (
            ("From above", ((0, 1.0), (2, -1.0)), _HEIGHT),
            ("From the side", ((0, 1.0), (1, 1.0)), 180),
        )
    )


def _flat(points: FloatArray, axes: tuple[tuple[int, float], ...]) -> FloatArray:
    return np.stack([sign * points[:, axis] for axis, sign in axes], axis=-1)


def up_of(poses: PosesSummary) -> FloatArray:
    """Return the up direction in the world, a unit vector (3,).

    It is −y if the world is level, otherwise the mean `up` of the cameras, which are mostly held upright,
    otherwise −y, that of the first camera.
    """
    up = np.array(poses.up or (0, -1, 0), np.float64)
    usable = np.isfinite(up).all() and np.linalg.norm(up) > 1e-6
    if not usable or poses.axes.is_level:
        return np.array([0.0, -1.0, 0.0])
    return np.asarray(up / np.linalg.norm(up))


@dataclass(frozen=True)
class _Joined:
    """A link to draw: positions of two cameras, number of inliers, tooltip, and whether it closes a loop of a walk."""

    first: int
    second: int
    inliers: int
    text: str
    closure: bool


def _chosen(
    links: Sequence[PairLink],
    position: Mapping[str, int],
    labels: list[str],
    *,
    reasons: Mapping[tuple[str, str], str],
    walk: WalkPath | None,
) -> list[_Joined]:
    """Return links between registered cameras: some rejected ones, then the strongest, in ascending order.

    Of a walk, those that close loops come last, so that they are drawn over the others.
    """

    # Of the rejected links, those with the most candidates.
    def closes(link: PairLink) -> bool:
        return walk is not None and bool(link.inliers) and walk.is_closure(position[link.first], position[link.second])

    found = sorted(links, key=lambda link: (closes(link), link.inliers, -(link.candidates or 0)))
    split = sum(not link.inliers for link in found)
    chosen = found[:split][:600] + found[split:][-1500:]
    return [
        _Joined(
            first := position[link.first],
            second := position[link.second],
            link.inliers,
            f"{labels[first]} – {labels[second]}: {_words(link, reasons.get((link.first, link.second), ''))}"
            f"{'; closes a loop' if closes(link) else ''}",
            closes(link),
        )
        for link in chosen
    ]


def _words(link: PairLink, why: str) -> str:
    """Return what a link says when pointed at, behind the names of its cameras."""
    of = "" if link.candidates is None else f" of {link.candidates} {plural(link.candidates, 'candidate')}"
    matches = f"{link.inliers} {plural(link.inliers, 'match', 'matches')}{of}"
    words = matches if link.inliers else f"rejected{of and f', none{of}'}"
    return f"{words}{why and f'; {why}'}"


def _drawn(
    title: str,
    flat: FloatArray,
    labels: list[str],
    *,
    marks: Sequence[tuple[int, FloatArray]],
    links: list[_Joined],
    walk: WalkPath | None,
    doubts: Mapping[int, str],
    judged: tuple[float | None, ...],
    unit: str,
    tallest: int,
    north: bool,
) -> CameraMap:
    """Return the drawing of cameras at positions (N, 2), with x to the right and y down."""
    low, high = flat.min(axis=0), flat.max(axis=0)
    extent = np.maximum(high - low, 1e-9 + 0.02 * float((high - low).max()))
    if not (high - low).any():
        extent = np.ones(2)
    scale = float(min((_WIDTH - 2 * _BORDER) / extent[0], (tallest - 2 * _BORDER) / extent[1]))
    height = int(np.clip(extent[1] * scale + 2 * _BORDER, 140, tallest))

    def on_map(points: FloatArray) -> FloatArray:
        return np.asarray(np.round((points - (low + high) / 2) * scale + (_WIDTH / 2, height / 2 - 6), 1), np.float64)

    placed = on_map(flat)
    edge = np.array([_WIDTH, height]) - 14.0
    clipped = [(np.clip(on_map(at), 14.0, edge), number) for number, at in marks]
    marked = tuple((float(at[0]), float(at[1]), number) for at, number in clipped)
    most = max((link.inliers for link in links), default=1) or 1
    at = [(float(x), float(y)) for x, y in placed]
    lines = tuple(
        Link((*at[link.first], *at[link.second]), link.inliers / most, link.text, not link.inliers, link.closure)
        for link in links
    )
    named = len(labels) <= 600
    spots = _label_spots(placed, labels)
    cameras = [(float(x), float(y), label, spot) for (x, y), label, spot in zip(placed, labels, spots, strict=True)]
    length = bar_length(400 / scale)
    bar = (14.0, height - 14.0, round(length * scale, 1), bar_text(length, unit))
    wide, deep = (f"{significant(float(size), 3)} {unit}" for size in high - low)
    cameras_text = f"{len(labels)} {plural(len(labels), 'camera')}"
    text = f"{cameras_text} {title.lower()}, {wide} across and {deep} {'deep' if tallest == _HEIGHT else 'high'}"
    dots = "" if named else "".join(f"M{x:g} {y:g}h0" for x, y in placed)
    text += f", {len(doubts)} of them doubtful" if doubts else ""
    doubtful = tuple((float(placed[idx, 0]), float(placed[idx, 1]), labels[idx], why) for idx, why in doubts.items())
    shown = tuple(cameras if named else ())
    path = (
        ""
        if walk is None
        else "".join(
            f"M{'L'.join(f'{at[idx][0]:g} {at[idx][1]:g}' for idx in stretch)}"
            for stretch in walk.stretches
            if len(stretch) > 1
        )
    )
    ends = () if walk is None or len(labels) <= _MAX_LABELS else (at[0], at[-1])
    return CameraMap(
        title,
        text,
        (_WIDTH, height),
        lines,
        shown,
        dots,
        bar,
        north,
        doubtful,
        judged if named else (),
        marked,
        path,
        ends,
    )


def _label_spots(placed: FloatArray, labels: list[str]) -> list[tuple[float, float] | None]:
    """Return the position of each label beside its camera, or None if no position is free.

    If there are too many cameras, there are no labels.
    """
    if len(labels) > _MAX_LABELS:
        return [None] * len(labels)
    found: list[tuple[float, float] | None] = []
    taken: list[tuple[float, float, float]] = []
    for (x, y), label in zip(placed, labels, strict=True):
        wide = 8.6 * len(label)
        spots = [(float(x) + across, float(y) + down) for across in (9, -9 - wide) for down in (-7, 18, 34)]
        free = (spot for spot in spots if _fits(spot, wide, taken))
        found.append(next(free, None))
        if found[-1] is not None:
            taken.append((*found[-1], wide))
    return found


def _fits(spot: tuple[float, float], wide: float, taken: list[tuple[float, float, float]]) -> bool:
    """Return whether a label is within the map and overlaps no other label."""
    left, y = spot
    if left < 2 or left + wide > _WIDTH - 2:
        return False
    return all(left + wide < other or other + width < left or abs(y - line) >= 16 for other, line, width in taken)
