"""Find people who stand, sit or walk around the camera."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property

import cv2
import numpy as np

from pano_mvs.algorithms.faces.layout import upright_rotation
from pano_mvs.algorithms.masks.areas import area_labels
from pano_mvs.algorithms.masks.person_views import MAP_HW, SIDE_PX, Look, Map, SeenPanorama, rolled, stereographic_look
from pano_mvs.algorithms.ranges.agreement import pixels_containing
from pano_mvs.core.arrays import FloatArray, Mask

_BELONGS = 0.5


@dataclass(frozen=True, eq=False)
class _Candidate:
    """An area of a view: its directions (N, 3), their middle, extent, and solid angle."""

    rays: FloatArray
    center: FloatArray
    extent_deg: float
    area_deg2: float
    score: float

    @cached_property
    def span_deg(self) -> tuple[float, float]:
        """The elevations of its feet and its head."""
        low, high = np.quantile(np.arcsin(np.clip(-self.rays[:, 1], -1, 1)), (0.01, 0.99))
        return float(np.degrees(low)), float(np.degrees(high))

    @property
    def aspect(self) -> float:
        """The ratio of its height to its width, as seen from the camera."""
        across = np.arcsin(np.clip(self.rays @ upright_rotation(self.center)[:2].T, -1, 1))
        width, height = np.ptp(np.quantile(across, (0.02, 0.98), axis=0), axis=0)
        return float(height / max(width, 1e-6))


def upright_people(seen: SeenPanorama, known: Mask, *, min_area_deg2: float, passers_by: bool) -> Mask:
    """Return the pixels, `MAP_HW`, of people around the camera.

    A network that outlines what is in the middle of a view looks along the horizon. Each outline is seen again in the
    middle of views of its own, rolled and mirrored: these have to detect a person, and a second network has to find a
    person there.

    `seen`: the panorama. `known`: (H, W) people who are found already, `MAP_HW`. `min_area_deg2`: the smallest person.
    `passers_by`: whether to find people whose feet are far from the camera.
    """
    found = known.copy()
    candidates = [_candidate(seen.middle(each)[1], each) for each in _ring()]
    possible = [each for each in candidates if each is not None and _stands(each)]
    tried: list[_Candidate] = []
    # Time is limited: at most this many candidates are looked at.
    for each in sorted(possible, key=lambda candidate: -candidate.score)[:8]:
        if (
            each.area_deg2 < min_area_deg2 / 2
            or found[pixels_containing(each.rays, MAP_HW)].mean() > 0.5
            or any(_same(each, o) for o in tried)
        ):
            continue
        tried.append(each)
        found |= _confirmed(seen, each, passers_by=passers_by, tried=tried)
    return found


def _candidate(outline: Map, view: Look) -> _Candidate | None:
    """Return the area in the middle of a view; None without one."""
    count, labels = cv2.connectedComponents((outline > _BELONGS).astype(np.uint8), connectivity=4)
    flat, middle = labels.ravel(), (_middle() * outline).ravel()
    scores = np.bincount(flat, middle, count)
    scores[0] = 0
    best = int(scores.argmax())
    area = labels == best
    if best == 0 or area.sum() < 100:
        return None
    rays, solid_angles = _geometry(view)
    inside, weights = rays[area], solid_angles[area]
    center = weights @ inside
    center /= np.linalg.norm(center)
    extent_deg = 2 * float(np.degrees(np.quantile(np.arccos(np.clip(inside @ center, -1, 1)), 0.97)))
    share = float(scores[best] / outline[area].sum())
    return _Candidate(inside, center, extent_deg, float(weights.sum()) * np.degrees(1) ** 2, share)


def _confirmed(seen: SeenPanorama, candidate: _Candidate, *, passers_by: bool, tried: list[_Candidate]) -> Mask:
    """Return the pixels, `MAP_HW`, of a person; none if the views of a candidate do not agree that it is one."""
    nobody = np.zeros(MAP_HW, np.bool_)
    for idx in range(3):
        view = _look_at(candidate)
        if idx == 0 and _probability_in(candidate, seen.probability(view), view) < 0.1:
            return nobody
        again = _candidate(seen.middle(view)[1], view)
        if again is None or not _stands(again):
            return nobody
        grows = again.extent_deg > 1.25 * candidate.extent_deg
        candidate = again
        if not grows:
            break
    tried.append(candidate)
    # People are taller than wide; tables and benches are not. The feet of the operator are at least so far below the
    # horizon.
    if candidate.aspect < 1.15 or (not passers_by and candidate.span_deg[0] > -40.0):
        return nobody
    mean = _seen_again(seen, candidate)
    if mean is None:
        return nobody
    labels = area_labels(np.asarray(mean > _BELONGS))
    inside = labels[pixels_containing(candidate.rays, MAP_HW)]
    return np.isin(labels, np.unique(inside[inside >= 0]))


def _seen_again(seen: SeenPanorama, candidate: _Candidate) -> Map | None:
    """Return the mean outline, `MAP_HW`, in several views of a candidate; None if they do not show a person."""
    first = _look_at(candidate)
    probability = _probability_in(candidate, seen.probability(first), first)
    if probability < 0.65:
        return None
    missed, found = 0, []
    for view, mirrored in (
        (first, False),
        (_look_at(candidate, 12.0), True),
        (_look_at(candidate, -12.0, 1.2), False),
    ):
        presence, outline = seen.middle(view, mirrored=mirrored)
        found.append((view, outline))
        missed += presence < 0.5
        # A person is detected in all views but one, or in all but one of those half a height lower, which show somebody
        # who is seen down to the waist.
        if presence < 0.5 and missed == 2 and (probability < 0.75 or not _seen_lower(seen, candidate)):
            return None
    return np.asarray(np.mean([view.on_map(outline) for view, outline in found], axis=0), np.float32)


def _seen_lower(seen: SeenPanorama, candidate: _Candidate) -> bool:
    """Return whether all but one of four views half a height lower show a person."""
    missed = 0
    for wider in (1.33, 1.67):
        view = _look_at(candidate, wider=wider, lower=0.5)
        for mirrored in (False, True):
            missed += seen.middle(view, mirrored=mirrored)[0] < 0.5
            if missed > 1:
                return False
    return True


def _look_at(candidate: _Candidate, roll_deg: float = 0.0, wider: float = 1.0, *, lower: float = 0.0) -> Look:
    """Return a view with a candidate in its middle, or lower by a share of its height."""
    # A candidate is seen again in views this many times as wide.
    fov_deg = float(np.clip(1.8 * wider * candidate.extent_deg, 30.0, 165.0))
    upright = upright_rotation(candidate.center)
    feet_deg, head_deg = candidate.span_deg
    turn = np.radians(lower * (head_deg - feet_deg))
    axis = np.cos(turn) * upright[2] + np.sin(turn) * upright[1]
    return stereographic_look(rolled(upright_rotation(axis), float(np.radians(roll_deg))), fov_deg)


def _probability_in(candidate: _Candidate, probability: Map, view: Look) -> float:
    """Return the mean probability of a person over a candidate."""
    x, y = np.floor(view.view.pixels_from_rays(candidate.rays)).astype(np.intp).T
    inside = (x >= 0) & (y >= 0) & (x < SIDE_PX) & (y < SIDE_PX)
    return float(probability[y[inside], x[inside]].mean()) if inside.any() else 0.0


def _stands(candidate: _Candidate) -> bool:
    """Return whether a candidate may stand on the ground, and is not a part of a facade."""
    feet_deg, head_deg = candidate.span_deg
    # People stand on the ground: their heads are not much farther above the horizon than their feet are below it. Those
    # beside the camera may be taller than it, and may be seen in part.
    return feet_deg < -30.0 or head_deg < 4.0 - 0.8 * feet_deg


def _same(first: _Candidate, second: _Candidate) -> bool:
    """Return whether two candidates are of the same thing."""
    apart_deg = np.degrees(np.arccos(np.clip(first.center @ second.center, -1, 1)))
    smaller, larger = sorted((first.extent_deg, second.extent_deg))
    return bool(apart_deg < 0.15 * smaller and larger < 1.2 * smaller)


def _geometry(view: Look) -> tuple[FloatArray, FloatArray]:
    """Return the rays (256, 256, 3) and the solid angles (256, 256) of a stereographic view's pixels."""
    along = view.rays @ view.view.view_from_cam[2]
    return view.rays, ((1 + along) / 2 / view.view.focal_px) ** 2


@cache
def _middle() -> Map:
    offsets = np.arange(SIDE_PX) - (SIDE_PX - 1) / 2
    # What is in the middle of a view is looked for with this standard deviation.
    falloff = np.exp(-(offsets**2) / (2 * 55.0**2))
    return np.asarray(falloff[:, None] * falloff, np.float32)


@cache
def _ring() -> tuple[Look, ...]:
    elevation = np.radians(-12.0)
    looks = []
    for azimuth in np.radians(np.arange(0, 360, 45)):
        x, z = np.cos(elevation) * np.sin(azimuth), np.cos(elevation) * np.cos(azimuth)
        looks.append(stereographic_look(upright_rotation(np.array([x, -np.sin(elevation), z])), 85.0))
    return tuple(looks)
