"""Evidence of pairs for the pose of an image: a rotation, a direction and a length for every geometry of a pair."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.poses.placement.view_graph import Edge
from pano_mvs.algorithms.two_view.significance import log10_false_alarms
from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3, angle_between, ranges_from_bearings
from pano_mvs.scene import TwoView

ScaleEstimator: TypeAlias = Literal["cauchy", "log_median", "kappa"]
ScaleOf: TypeAlias = Callable[[FloatArray, FloatArray], float]
"""`estimate_scale` with an estimator: ratios of single features and their weights to one scale factor."""


def estimate_scale(
    ratios: FloatArray, weights: FloatArray, *, estimator: ScaleEstimator = "cauchy", kappa: float = 0.01
) -> float:
    """Estimate one scale factor from the ratios of single features.

    "kappa" is the paper's estimator: the ratio with most other ratios within κ (absolute). "log_median" is the median
    of the log-ratios. "cauchy" is their weighted centre under a Cauchy loss, by iterated reweighting from the median.

    Args:
        ratios: (M,) positive, M ≥ 1.
        weights: (M,) inverse variances of the log-ratios, up to a factor; only used by "cauchy".
        estimator: "kappa", "log_median" or "cauchy".
        kappa: the paper's κ.

    Raises:
        UsageError: if there is no ratio, or a ratio is not positive.
    """
    if len(ratios) == 0 or not np.all(ratios > 0):
        raise UsageError("a scale factor needs at least one ratio, all positive")
    if estimator == "kappa":
        ordered = np.sort(ratios)
        first, end = np.searchsorted(ordered, ordered - kappa), np.searchsorted(ordered, ordered + kappa, "right")
        neighbours = end - first
        # Of several ratios with equally many neighbours take the middle one, so that no end of the range is preferred.
        best = np.flatnonzero(neighbours == neighbours.max())
        return float(ordered[best[len(best) // 2]])
    logs = np.log(ratios)
    center = _median(logs)
    return float(np.exp(center if estimator == "log_median" else _cauchy_center(logs, weights, center)))


def _cauchy_center(logs: FloatArray, weights: FloatArray, center: float) -> float:
    spread = np.sqrt(weights / _median(weights))
    for _ in range(20):
        deviations = (logs - center) * spread
        scale = max(1.4826 * _median(np.abs(deviations)), 1e-9)
        robust = weights / (1 + (deviations / (2 * scale)) ** 2)
        moved = float(np.sum(robust * logs) / np.sum(robust))
        if abs(moved - center) < 1e-7:
            break
        center = moved
    return center


def _median(values: FloatArray) -> float:
    """Return the median; for a few hundred values several times as fast as numpy's, and called very often here."""
    ordered = np.sort(values)
    return float(0.5 * (ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2]))


_MIN_RATIOS = 6
AGREEING = 1.25
"""Lengths within this factor agree."""


@dataclass(frozen=True, eq=False)
class Geometry:
    """One of the geometries of a pair (i, j), i < j."""

    view: TwoView  # second_from_first with the matches that support it
    # grows slowly with the number of matches, since a repeated floor may give hundreds of matches to a false geometry,
    # and with their share of the matches of the pair's best geometry
    weight: float
    direction_std_deg: float  # standard deviation of its direction
    # (2, M) ranges of its matches from either image, in units of its translation, NaN where not usable
    unit_ranges: FloatArray
    parallax_rad: FloatArray  # (M,) angle between the rays of each match after de-rotation

    @cached_property
    def parallax_deg(self) -> float:
        """The median parallax; 0 without matches."""
        return float(np.rad2deg(np.median(self.parallax_rad))) if len(self.parallax_rad) else 0.0


def geometries_of(view: TwoView, bearings_first: FloatArray, bearings_second: FloatArray) -> tuple[Geometry, ...]:
    """Return all geometries of a pair, the one with most support first.

    Args:
        view: the pair's two-view geometry with its alternatives.
        bearings_first: (N, 3) unit rays of all key points of the first image.
        bearings_second: (N, 3) unit rays of the second image.
    """
    found = []
    most = max(len(view), 1)
    for rank, geometry in enumerate((view, *view.alternatives)):
        p, q = bearings_first[geometry.matches_idx[:, 0]], bearings_second[geometry.matches_idx[:, 1]]
        ranges, parallax = unit_ranges(Rigid3(geometry.rotation, geometry.direction), p, q)
        # Standard deviation of the direction that is assumed for a geometry without one.
        found.append(
            Geometry(
                view=geometry,
                weight=(1 + np.log10(max(len(geometry), 1) / 15)) * min(1.0, np.sqrt(len(geometry) / most)),
                direction_std_deg=view.direction_std_deg if rank == 0 else 0.5,
                unit_ranges=ranges,
                parallax_rad=parallax,
            )
        )
    return tuple(sorted(found, key=lambda geometry: -geometry.weight))


@dataclass(frozen=True, eq=False)
class PairEvidence:
    """The W geometries that join an image to registered images."""

    partner: NDArray[np.intp]  # (W,) position of the registered image
    rank: NDArray[np.intp]  # (W,) rank of the geometry in its pair
    weight: FloatArray  # (W,) weight of the geometry
    rotations: FloatArray  # (W, 3, 3) rotation of cam_from_world of the image according to the geometry
    origins: FloatArray  # (W, 3) centre of the partner in the world
    directions: FloatArray  # (W, 3) unit vector from there to the image
    # (W,) the distance at which points are at their known ranges; NaN if too few points determine it
    lengths: FloatArray
    tolerance_rad: FloatArray  # (W,) largest error of a direction

    def __len__(self) -> int:
        return len(self.partner)

    @property
    def total(self) -> float:
        """The weight of a pose that agrees with every partner's heaviest geometry."""
        return float(best_by_partner(self.partner, self.weight[None])[0])


def best_by_partner(partner: NDArray[np.intp], weights: FloatArray) -> FloatArray:
    """Return the sum over partners of the largest weight among their geometries, (C,), for weights (C, W)."""
    total = np.zeros(len(weights))
    for idx in np.unique(partner):
        total += weights[:, partner == idx].max(axis=1)
    return total


def gather_pair_evidence(
    image: int,
    partners: Sequence[int],
    *,
    geometries: Mapping[Edge, tuple[Geometry, ...]],
    cameras: Mapping[int, Rigid3],
    ranges: Mapping[int, FloatArray],
    scale_of: ScaleOf = estimate_scale,
) -> PairEvidence:
    """Return the evidence of the pairs of an image with registered partners.

    Args:
        image: the image to place.
        partners: registered images that share a pair with it.
        geometries: of all pairs (i, j), i < j.
        cameras: cam_from_world of registered images.
        ranges: (N,) known ranges of every partner's key points in scene units, NaN where unknown.
        scale_of: estimates a length from the ratios of known ranges.
    """
    rows = []
    for partner in partners:
        camera = cameras[partner]
        for rank, geometry in enumerate(geometries[min(image, partner), max(image, partner)]):
            from_partner, matches = oriented(geometry.view, partner, image)
            length = _length(
                ranges[partner][matches[:, 0]],
                geometry.unit_ranges[int(partner > image)],
                geometry.parallax_rad,
                scale_of=scale_of,
            )
            rows.append(
                (
                    partner,
                    rank,
                    geometry.weight,
                    from_partner.rotation @ camera.rotation,
                    camera.center,
                    camera.rotation.T @ from_partner.center,
                    length,
                    np.deg2rad(1.0 + 2 * min(geometry.direction_std_deg, 1.0) + 5 * geometry.view.residual_deg),
                )
            )
    columns = list(zip(*rows, strict=True)) if rows else [()] * 8
    return PairEvidence(
        partner=np.array(columns[0], np.intp),
        rank=np.array(columns[1], np.intp),
        weight=np.array(columns[2], np.float64),
        rotations=np.array(columns[3], np.float64).reshape(-1, 3, 3),
        origins=np.array(columns[4], np.float64).reshape(-1, 3),
        directions=np.array(columns[5], np.float64).reshape(-1, 3),
        lengths=np.array(columns[6], np.float64),
        tolerance_rad=np.array(columns[7], np.float64),
    )


def oriented(view: TwoView, first: int, second: int) -> tuple[Rigid3, NDArray[np.int32]]:
    """Return second_from_first with |t| = 1, and the matches with the first image's key points in the first column.

    `view` is stored with the smaller position as the first image.
    """
    pose, matches = Rigid3(view.rotation, view.direction), view.matches_idx
    if first < second:
        return pose, matches
    reversed_matches: NDArray[np.int32] = matches[:, ::-1]
    return pose.inverse(), reversed_matches


def _length(known_ranges: FloatArray, unit_ranges: FloatArray, parallax: FloatArray, *, scale_of: ScaleOf) -> float:
    """Return the length of the translation that puts points at their known ranges; NaN if it is not determined."""
    ratios = known_ranges / unit_ranges
    known = np.isfinite(ratios)
    ratios = ratios[known]
    if len(ratios) < _MIN_RATIOS:
        return np.nan
    length = scale_of(ratios, np.sin(parallax[known]) ** 2)
    agreeing = int((np.abs(np.log(ratios / length)) < np.log(AGREEING)).sum())
    return length if agreeing >= max(_MIN_RATIOS, 0.4 * len(ratios)) else np.nan


def significant_length(
    second_from_first: Rigid3, p: FloatArray, q: FloatArray, *, known_ranges: FloatArray, rng: np.random.Generator
) -> tuple[float, float]:
    """Return the length of a translation that puts points at their known ranges, and log₁₀ of its false alarms.

    A range of false matches is any known range over any other one in units of the translation, so that the chance of
    agreeing with a length is measured on shuffled ranges, for each of several tolerances.

    Args:
        second_from_first: relative pose, |t| = 1.
        p: (M, 3) unit rays of the matches in the first image.
        q: (M, 3) in the second image.
        known_ranges: (M,) ranges of the points from the first image, NaN where unknown.
        rng: shuffles the ranges.
    """
    (unit, _), parallax = unit_ranges(second_from_first, p, q)
    usable = np.isfinite(known_ranges / unit)
    known, unit, parallax = known_ranges[usable], unit[usable], parallax[usable]
    if len(known) < 2:
        return np.nan, np.inf
    length = estimate_scale(known / unit, np.sin(parallax) ** 2)
    tolerances = np.log(AGREEING) / 2.0 ** np.arange(4)
    off = np.abs(np.log(known / unit / length))
    shuffled = np.abs(np.log(rng.permuted(np.tile(known, (50, 1)), axis=1) / unit / length))
    alarms = [
        log10_false_alarms(
            int((off < tolerance).sum()),
            len(known),
            chance=float((shuffled < tolerance).sum() + 1) / (shuffled.size + 1),
            sample=1,
            models_per_sample=len(tolerances),
        )
        for tolerance in tolerances
    ]
    return length, min(alarms)


def unit_ranges(second_from_first: Rigid3, p: FloatArray, q: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the ranges of matches from both images, (2, M), NaN unless they meet in front of both, and parallaxes."""
    ranges = np.stack(ranges_from_bearings(p, q, second_from_first))
    parallax = angle_between(p @ second_from_first.rotation.T, q)
    with np.errstate(invalid="ignore"):
        usable = (ranges > 0).all(axis=0) & (parallax > float(np.deg2rad(1.0)))
    return np.where(usable, ranges, np.nan), parallax
