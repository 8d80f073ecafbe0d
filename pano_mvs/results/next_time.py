"""What to do when a place is captured again: where to stand and what is missing, from the coverage of a run."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.text import plural, shortened_list
from pano_mvs.results.coverage import LonelyArea, ViewCoverage
from pano_mvs.results.figures import median, share, significant
from pano_mvs.results.records import Direction, PairLink, PosesSummary
from pano_mvs.results.summary import RunSummary
from pano_mvs.results.verdict import FAIR_CONSISTENT, compares_views


def _nearest_others(centers: FloatArray, most: int) -> NDArray[np.intp]:
    """Return the nearest other points of each point, (N, K), nearest first."""
    most = min(most, len(centers) - 1)
    near = np.empty((len(centers), most), np.intp)
    for idx, center in enumerate(centers):  # a search tree would take longer to import
        squared = ((centers - center) ** 2).sum(axis=1)
        squared[idx] = np.inf
        candidates = np.flatnonzero(squared <= np.partition(squared, most - 1)[most - 1])
        near[idx] = candidates[np.argsort(squared[candidates], kind="stable")[:most]]
    return near


@dataclass(frozen=True, eq=False)
class CameraGroup:
    """The cameras of a group, with what is known of their surroundings."""

    number: int
    poses: PosesSummary  # of the group; the centres of all cameras are known
    centers: FloatArray  # (N, 3), N > 1
    neighbours: NDArray[np.intp]  # (N, K) up to six nearest other cameras, nearest first
    coverage: Mapping[str, ViewCoverage]  # what the views see, as far as known

    @staticmethod
    def of(number: int, poses: PosesSummary, coverage: Mapping[str, ViewCoverage]) -> CameraGroup | None:
        """Return a group; None if it has fewer than two cameras, or not all their centres are known."""
        centers = np.array(poses.centers, np.float64).reshape(-1, 3)
        if len(centers) != len(poses.registered) or len(centers) < 2 or not np.isfinite(centers).all():
            return None
        return CameraGroup(number, poses, centers, _nearest_others(centers, 6), coverage)

    @property
    def names(self) -> tuple[str, ...]:
        """The images, in the order of `centers`."""
        return self.poses.registered

    @property
    def unit(self) -> str:
        """The unit of length."""
        return "m" if self.poses.metric else "scene units"

    def length(self, value: float) -> str:
        """Return a length with its unit."""
        return f"{significant(value)} {self.unit}"

    def nearest(self, idx: int) -> NDArray[np.intp]:
        """Return up to six other cameras, nearest first."""
        return np.asarray(self.neighbours[idx])

    def distance(self, first: int, second: int) -> float:
        """Return the distance between two cameras."""
        return float(np.linalg.norm(self.centers[first] - self.centers[second]))

    def typical_range(self, idx: int) -> float | None:
        """Return the median range of a view, or None if it is unknown."""
        known = self.coverage.get(self.names[idx])
        return None if known is None else known.typical_range

    def between(self, pair: tuple[int, int], severity: _Severity, text: str, *, count: int = 1) -> _Reason:
        """Return a reason to take panoramas in the middle between two cameras."""
        x, y, z = (float(value) for value in self.centers[list(pair)].mean(axis=0))
        names = self.names[pair[0]], self.names[pair[1]]
        return _Reason(severity, text, names, group=self.number, at=(x, y, z), count=count)


def shortest_tree(centers: FloatArray) -> list[tuple[int, int, float]]:
    """Return (first, second, length) of the edges of the minimum spanning tree of points (N, 3), by Prim's method."""
    count = len(centers)
    length = np.full(count, np.inf)
    nearest = np.zeros(count, np.int64)
    outside = np.ones(count, np.bool_)
    edges: list[tuple[int, int, float]] = []
    current = 0
    for _ in range(count - 1):
        outside[current] = False
        distance = np.linalg.norm(centers - centers[current], axis=1)
        closer = outside & (distance < length)
        length[closer], nearest[closer] = distance[closer], current
        current = int(np.argmin(np.where(outside, length, np.inf)))
        edges.append((int(nearest[current]), current, float(length[current])))
    return edges


MIN_CAMERAS = 4
"""Spacing, links and confirmed shares are compared within a group only if it has at least this many cameras."""


LONG_BASELINE, SHORT_BASELINE = 0.8, 0.03
"""Distance of a camera to its neighbours relative to its median range: above is too long, below too short."""

_WEAK = 0.5  # of the median share that other views confirm
_MAX_UNREGISTERED = 4


class _Severity(IntEnum):
    APART, UNREGISTERED, DOUBTFUL, SPACING, WEAK, LOOSE, LONELY = range(7)


@dataclass(frozen=True)
class Suggestion:
    """Something to do when the place is captured again."""

    action: str  # what to do, in a sentence that names images
    reasons: tuple[str, ...]  # why, with figures
    group: int = 0  # number of the group in whose world `at` is
    at: Direction | None = None  # where to stand; None if no place is known


@dataclass(frozen=True)
class _Reason:
    """A reason to take panoramas between two images, or else for an action."""

    severity: _Severity
    text: str
    between: tuple[str, str] | None = None
    action: str = ""
    group: int = 0
    at: Direction | None = None
    count: int = 1  # of panoramas between the two


def suggestions(summary: RunSummary, coverage: Mapping[str, ViewCoverage] | None = None) -> tuple[Suggestion, ...]:
    """Return what to do when the place is captured again, the most urgent first.

    Reasons for the same two images become one suggestion.

    Args:
        coverage: what the views see, as far as known; see `pano_mvs.results.coverage`.
    """
    reasons = [*_connect_groups(summary), *_register(summary)]
    for number, poses in enumerate(summary.poses.by_group()):
        group = CameraGroup.of(number, poses, coverage or {})
        if group is not None:
            found = _spacing(group), _doubtful(group), _weak(group, summary), _loose(group), _lonely(group)
            reasons += [reason for some in found for reason in some]
    together: dict[object, list[_Reason]] = {}
    for idx, reason in enumerate(reasons):
        together.setdefault(tuple(sorted(reason.between)) if reason.between else idx, []).append(reason)
    ranked = []
    for several in together.values():
        first = several[0]
        action = first.action
        if first.between is not None:
            count = max(reason.count for reason in several)
            what = "a panorama" if count == 1 else f"{count} panoramas"
            action = f"Take {what} between {' and '.join(sorted(first.between))}."
        place = Suggestion(action, tuple(reason.text for reason in several), first.group, first.at)
        ranked.append((min(reason.severity for reason in several), -len(several), first.between is None, place))
    ranked.sort(key=lambda entry: entry[:3])
    return tuple(suggestion for *_, suggestion in ranked)


def _connect_groups(summary: RunSummary) -> Iterator[_Reason]:
    """Suggest panoramas between groups that no reliable pair connects."""
    for number, group in enumerate(summary.poses.groups[1:], start=1):
        size = f"group {number} ({len(group.images)} {plural(len(group.images), 'panorama')})"
        pair = group.nearest_pair
        if pair is not None:
            reason = (
                f"{size} has no reliable connection to the largest group; of all pairs across, this one has the most "
                f"in common: {_matches(pair.matches, pair.candidates)}"
            )
            yield _Reason(_Severity.APART, reason, (pair.first, pair.second))
            continue
        largest = summary.poses.groups[0].images
        action = f"Take panoramas on the way from {shortened_list(largest, 2)} to {shortened_list(group.images, 2)}."
        reason = f"{size} has no reliable connection to the largest group, and no pair across was compared"
        yield _Reason(_Severity.APART, reason, action=action)


def _register(summary: RunSummary) -> Iterator[_Reason]:
    """Suggest panoramas between images without a pose and the registered ones with which they share most."""
    poses = summary.poses
    best = _best_partners(poses)
    # Those that the source left out, as not being panoramas, for example, need no others beside them.
    sources = {stage.name for stage in summary.stages if stage.use.startswith("source.")}
    unreadable = {name for name, rejection in summary.rejected.items() if rejection.stage in sources}
    left_out = [name for name in poses.rejected if name not in unreadable]
    with_partner = sorted((name for name in left_out if name in best), key=lambda name: _strength(best[name]))[::-1]
    for name in with_partner[:_MAX_UNREGISTERED]:
        link = best[name]
        partner = link.second if link.first == name else link.first
        reason = f"the image {name} has no pose; this pair has {_matches(link.inliers, link.candidates)}"
        yield _Reason(_Severity.UNREGISTERED, reason, (name, partner))
    rest = [name for name in left_out if name not in with_partner[:_MAX_UNREGISTERED]]
    if rest:
        count = f"{len(rest)} {'more ' if len(rest) < len(left_out) else ''}{plural(len(rest), 'panorama')}"
        action = f"Take panoramas 0.5–1 m apart on the way to {shortened_list(rest)}."
        reason = f"{count} of {len(poses.registered) + len(poses.rejected)} {plural(len(rest), 'has', 'have')} no pose"
        yield _Reason(_Severity.UNREGISTERED, reason, action=action)


def _best_partners(poses: PosesSummary) -> dict[str, PairLink]:
    """Return the pair of each unregistered image that has the most in common with a registered one."""
    registered = set(poses.registered)
    best: dict[str, PairLink] = {}
    for link in poses.links:
        for name, other in ((link.first, link.second), (link.second, link.first)):
            if name in poses.rejected and other in registered and link.candidates != 0:
                best[name] = max(best.get(name, link), link, key=_strength)
    return best


def _strength(link: PairLink) -> tuple[int, int]:
    return link.inliers, link.candidates or 0


def _matches(inliers: int, candidates: int | None) -> str:
    verified = f"{inliers} verified {plural(inliers, 'match', 'matches')}"
    return verified if candidates is None else f"{verified} of {candidates} {plural(candidates, 'candidate')}"


def _spacing(group: CameraGroup) -> Iterator[_Reason]:
    """Suggest panoramas in gaps, and other distances if neighbours are too close."""
    edges = shortest_tree(group.centers)
    typical = median([length for _, _, length in edges]) or 0.0
    for first, second, length in edges if len(group.names) >= MIN_CAMERAS and typical > 0 else ():
        ranges = [known for idx in (first, second) if (known := group.typical_range(idx)) is not None]
        # Cameras are far apart if their distance is more than this many times the median distance of neighbours; a gap
        # below a tenth of the median range costs nothing.
        if length > 2.0 * typical and (not ranges or length > 0.1 * min(ranges)):
            reason = (
                f"they are {group.length(length)} apart; the median distance between neighbours is "
                f"{group.length(typical)}"
            )
            count = min(20, max(1, math.ceil(length / typical * (1 - 1e-6)) - 1))
            yield group.between((first, second), _Severity.SPACING, reason, count=count)
    for idx, name in enumerate(group.names):
        known = group.typical_range(idx)
        other = int(group.nearest(idx)[0])
        if known is not None and (distance := group.distance(idx, other)) > LONG_BASELINE * known:
            reason = (
                f"{name} is {group.length(distance)} from its nearest neighbour, {share(distance / known)} of the "
                f"median distance to what it sees ({group.length(known)}): near surfaces look too different"
            )
            yield group.between((idx, other), _Severity.SPACING, reason)
    yield from _all_too_close(group)


def _all_too_close(group: CameraGroup) -> Iterator[_Reason]:
    """Suggest larger distances if all near neighbours of cameras are too close for their ranges."""
    known = [idx for idx in range(len(group.names)) if group.typical_range(idx)]
    farthest = {idx: group.distance(idx, int(group.nearest(idx)[:4][-1])) for idx in known}
    ratios = {idx: length / (group.typical_range(idx) or 1.0) for idx, length in farthest.items()}
    close = [idx for idx in known if ratios[idx] < SHORT_BASELINE]
    if not close:
        return
    worst = min(close, key=ratios.__getitem__)
    middle = median([group.typical_range(idx) for idx in close]) or 0.0
    low, high = (significant(factor * middle) for factor in (0.05, 0.2))
    names = shortened_list(group.names[idx] for idx in close)
    reason = (
        f"{len(close)} of {len(group.names)} panoramas ({names}) have their nearest neighbours within "
        f"{share(SHORT_BASELINE)} of the median distance to what they see, so that ranges are uncertain; "
        f"{group.names[worst]}, for example, within {group.length(farthest[worst])}, {share(ratios[worst])}"
    )
    action = f"Take panoramas {low}–{high} {group.unit} apart."
    yield _Reason(_Severity.SPACING, reason, action=action, group=group.number)


def _doubtful(group: CameraGroup) -> Iterator[_Reason]:
    """Suggest panoramas beside cameras whose poses are doubtful."""
    for idx, name in enumerate(group.names):
        if name in group.poses.doubts:
            reason = f"the pose of {name} is doubtful: {group.poses.doubts[name]}"
            yield group.between((idx, int(group.nearest(idx)[0])), _Severity.DOUBTFUL, reason)


def _weak(group: CameraGroup, summary: RunSummary) -> Iterator[_Reason]:
    """Suggest panoramas beside cameras of whose pixels other views confirm much less than usual."""
    shares = {view.name: view.consistent for view in summary.views if view.consistent is not None}
    usual = median(list(shares.values()))
    if usual is None or not compares_views(summary) or len(group.names) < MIN_CAMERAS:
        return
    limit = max(FAIR_CONSISTENT, _WEAK * usual)
    for idx, name in enumerate(group.names):
        other = int(group.nearest(idx)[0])
        known = group.typical_range(idx)
        # A panorama between two cameras that are too close would be of no use.
        is_close = known is not None and group.distance(idx, other) < SHORT_BASELINE * known
        if shares.get(name, 1.0) < limit and not is_close:
            reason = f"other views confirm {share(shares[name])} of {name}, and {share(usual)} of the median view"
            yield group.between((idx, other), _Severity.WEAK, reason)


def _loose(group: CameraGroup) -> Iterator[_Reason]:
    """Suggest panoramas beside cameras that share a verified geometry with only one other."""
    links = [link for link in group.poses.links if link.inliers]
    if len(group.names) < MIN_CAMERAS or not links:
        return
    count = Counter(name for link in links for name in link[:2])
    only = {name: link for link in links for name in link[:2] if count[name] == 1}
    for idx, name in enumerate(group.names):
        if name not in only:
            continue
        link = only[name]
        partner = link.second if link.first == name else link.first
        others = [int(at) for at in group.nearest(idx) if group.names[at] != partner]
        reason = (
            f"one panorama alone, {partner}, shares a verified geometry with {name} ({_matches(link.inliers, None)})"
        )
        yield group.between((idx, others[0]), _Severity.LOOSE, reason)


def _lonely(group: CameraGroup) -> Iterator[_Reason]:
    """Suggest panoramas towards the largest areas that one camera alone sees."""
    areas = [
        (area, idx)
        for idx, name in enumerate(group.names)
        if name in group.coverage
        for area in group.coverage[name].areas
    ]
    areas.sort(key=lambda pair: -pair[0].share)
    for area, idx in areas[:3]:
        name, where = group.names[idx], direction_words(area)
        reason = (
            f"{share(area.share)} of the sphere around {name}, {where}, about {group.length(area.distance)} away, is "
            "hidden from the nearest other panoramas"
        )
        x, y, z = (float(value) for value in (group.centers[idx] + np.array(area.at)) / 2)
        action = f"Take a panorama half-way from {name} to what it sees {where}."
        yield _Reason(_Severity.LONELY, reason, action=action, group=group.number, at=(x, y, z))


def direction_words(area: LonelyArea) -> str:
    """Return the direction of an area in its image in words.

    >>> direction_words(LonelyArea(-42.4, 11.0, 0.1, 1.0, (0.0, 0.0, 0.0)))
    '42° to the left of the image centre, 11° above the horizon'
    """
    azimuth, elevation = round(area.azimuth_deg), round(area.elevation_deg)
    across = f"{abs(azimuth)}° to the {'right' if azimuth > 0 else 'left'} of the image centre"
    if abs(azimuth) < 5:
        across = "at the image centre"
    elif abs(azimuth) > 175:
        across = "at the left and right edge of the image"
    if abs(elevation) < 5:
        return across
    return f"{across}, {abs(elevation)}° {'above' if elevation > 0 else 'below'} the horizon"


def marks_of(found: Iterable[Suggestion], group: int) -> list[tuple[int, Direction]]:
    """Return the number, from 1, and the place of each suggestion that has one in the world of a group."""
    return [(number, one.at) for number, one in enumerate(found, start=1) if one.at is not None and one.group == group]
