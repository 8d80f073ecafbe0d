"""Fit camera positions to GPS or a survey: scale to metres and, on request, a world frame of east, down, north."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pano_mvs.algorithms.poses.frame.gauge import moved_poses
from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.text import plural
from pano_mvs.geometry import UP, Similarity3, rotation_from_rotvec, rotation_from_two_vectors
from pano_mvs.geometry.geodesy import lla_from_local, local_from_lla
from pano_mvs.scene import Poses, WorldAxes

ComplexArray = NDArray[np.complex128]

_MIN_POSITIONS = 3
_MAX_HYPOTHESES = 2000
_OUTLIER_SIGMAS = 3.0


@dataclass(frozen=True, eq=False)
class GpsFit:
    """A fit of camera positions to GPS or a survey; falsy, with the reason, if there is no reliable one."""

    local_from_world: Similarity3  # the similarity into metres east, down, north of the origin
    origin: FloatArray  # (3,) latitude deg, longitude deg, altitude m; of a survey x, y, z in its own frame
    used: int  # number of positions that agree with the fit
    of: int  # number of registered panoramas with a position
    residual_m: float = float("nan")  # median horizontal distance between the positions and the fit
    scale_error: float = float("nan")  # relative standard deviation of the scale
    reason: str = ""  # why there is no reliable fit; "" if there is one
    survey: str = ""  # name of the file of surveyed positions; "" for GPS

    def __bool__(self) -> bool:
        return not self.reason

    @property
    def source(self) -> str:
        """Where the positions come from, in words."""
        return f"the positions in {self.survey}" if self.survey else "GPS"

    @property
    def words(self) -> str:
        """The fit in words."""
        return (
            f"{self.source} of {self.used} of {self.of} panoramas (median residual {self.residual_m:.2f} m, scale ± "
            f"{100 * self.scale_error:.1f} %)"
        )


def fit_gps(
    poses: Poses,
    positions_lla: Mapping[str, Sequence[float]],
    up_in_world: FloatArray,
    *,
    gps_noise_m: float,
    rng: np.random.Generator,
) -> GpsFit:
    """Fit camera centres to GPS positions by scale, heading and shift, given the vertical.

    Only latitude and longitude determine scale and heading, since altitudes are several times as noisy or missing
    altogether: x' = a x + b in the complex plane of the ground. The initial fit is the pair of positions that agrees
    with most others (MSAC), followed by least squares with Cauchy weights.

    Args:
        poses: registered images, in any unit and world frame.
        positions_lla: image name to (latitude deg, longitude deg, altitude m).
        up_in_world: (3,) unit vector away from gravity.
        gps_noise_m: standard deviation of a position along an axis; if the residuals of the fit are larger, they are
            used.
        rng: draws pairs if there are too many to try all.
    """
    located = [name for name in poses.names if name in positions_lla]
    lla = np.array([positions_lla[name] for name in located], np.float64).reshape(-1, 3)
    origin_lla = np.median(lla, axis=0) if located else np.zeros(3)
    local = local_from_lla(lla, origin_lla)
    fit = _fit(poses, dict(zip(located, local, strict=True)), up_in_world, noise_m=gps_noise_m, rng=rng)
    return replace(fit, origin=origin_lla)


def fit_survey(
    poses: Poses,
    positions_xyz: Mapping[str, ArrayLike],
    up_in_world: FloatArray,
    *,
    noise_m: float,
    rng: np.random.Generator,
    survey: str,
) -> GpsFit:
    """Fit camera centres to surveyed positions, as `fit_gps` does.

    Args:
        poses: registered images, in any unit and world frame.
        positions_xyz: image name to x, y, z in metres, z up.
        up_in_world: (3,) unit vector away from gravity.
        noise_m: standard deviation of a position along an axis.
        rng: draws pairs if there are too many to try all.
        survey: name of the file, for messages.
    """
    located = [name for name in poses.names if name in positions_xyz]
    xyz = np.array([positions_xyz[name] for name in located], np.float64).reshape(-1, 3)
    origin = np.median(xyz, axis=0) if located else np.zeros(3)
    local = (xyz - origin)[:, [0, 2, 1]] * (1, -1, 1)
    fit = _fit(poses, dict(zip(located, local, strict=True)), up_in_world, noise_m=noise_m, rng=rng, survey=survey)
    return replace(fit, origin=origin)


def _fit(
    poses: Poses,
    positions: Mapping[str, FloatArray],
    up_in_world: FloatArray,
    *,
    noise_m: float,
    rng: np.random.Generator,
    survey: str = "",
) -> GpsFit:
    """Fit camera centres to positions (3,) in metres east, down and north of an origin."""
    located = [idx for idx, name in enumerate(poses.names) if name in positions]
    unknown = GpsFit(Similarity3(1.0, np.eye(3), np.zeros(3)), np.zeros(3), 0, len(located), survey=survey)
    if len(located) < _MIN_POSITIONS:
        kind = f"position in {survey}" if survey else "GPS position"
        return replace(
            unknown,
            reason=f"{len(located)} of {len(poses.names)} registered panoramas "
            f"{plural(len(located), 'has', 'have')} a {kind}; {_MIN_POSITIONS} are needed",
        )
    local = np.array([positions[poses.names[idx]] for idx in located], np.float64)
    levelling = rotation_from_two_vectors(up_in_world, UP)
    level = poses.centers[located] @ levelling.T
    source, target = level[:, 0] + 1j * level[:, 2], local[:, 0] + 1j * local[:, 2]
    factor, shift = _fit_plane(source, target, noise_m, rng=rng)
    residuals_m = np.abs(factor * source + shift - target)
    agree = residuals_m < _OUTLIER_SIGMAS * noise_m * np.sqrt(2)
    fit = replace(
        unknown,
        local_from_world=_similarity(factor, shift, levelling, level=level[agree], local=local[agree]),
        used=int(agree.sum()),
        residual_m=float(np.median(residuals_m)),
    )
    return _judged(fit, factor, source[agree], residuals_m=residuals_m[agree], gps_noise_m=noise_m)


def scaled_by_gps(poses: Poses, fit: GpsFit) -> Poses:
    """Return the same scene in metres, without rotating or moving the world frame.

    Args:
        poses: the poses that were fitted.
        fit: a reliable fit.
    """
    similarity = Similarity3(fit.local_from_world.scale, np.eye(3), np.zeros(3))
    return replace(moved_poses(poses, similarity), scale=f"metres, by {fit.words}", metric=True)


def georeferenced_poses(poses: Poses, fit: GpsFit) -> Poses:
    """Return the same scene in metres, x east, y down, z north, with the first camera as its origin.

    The axes of a survey are its own: x and z of the world are x and y of the survey, which need not be east and north.

    Args:
        poses: the poses that were fitted.
        fit: a reliable fit.
    """
    first_in_local = fit.local_from_world.apply(poses.centers[0])
    to_first = Similarity3(1.0, np.eye(3), -first_in_local)
    moved = moved_poses(poses, to_first @ fit.local_from_world)
    moved.translations[0] = 0.0
    metric = replace(moved, scale=f"metres, by {fit.words}", metric=True)
    if fit.survey:
        x, y, z = fit.origin + first_in_local[[0, 2, 1]] * (1, 1, -1)
        at = f"({x:z.3f}, {y:z.3f}, {z:z.3f})"
        frame = f"x as x, y down, z as y in {fit.survey}; origin at the first registered camera {at}"
        return replace(metric, frame=frame, axes=WorldAxes.LEVEL, origin_lla=None)
    latitude, longitude, altitude = lla_from_local(first_in_local, fit.origin)
    frame = (
        f"x east, y down, z north, by GPS; origin at the first registered camera ({latitude:z.7f}°, "
        f"{longitude:z.7f}°, {altitude:z.1f} m)"
    )
    origin_lla = (float(latitude), float(longitude), float(altitude))
    return replace(metric, frame=frame, axes=WorldAxes.NORTH, origin_lla=origin_lla)


def _judged(
    fit: GpsFit, factor: complex, source: ComplexArray, *, residuals_m: FloatArray, gps_noise_m: float
) -> GpsFit:
    """Return the fit with its uncertainty, rejected if it is not reliable."""
    if fit.used < max(_MIN_POSITIONS, fit.of / 2):
        return replace(
            fit,
            reason=f"only {fit.used} of {fit.of} positions by {fit.source} fit the camera poses; the others are "
            f"more than {_OUTLIER_SIGMAS:g} times {gps_noise_m:g} m off",
        )
    freedom = 2 * len(source) - 4
    noise_m = max(gps_noise_m, float(np.sqrt(np.sum(residuals_m**2) / freedom)))
    spread_m = float(abs(factor) * np.sqrt(np.sum(np.abs(source - source.mean()) ** 2)))
    fit = replace(fit, scale_error=noise_m / spread_m if spread_m > 0 else float("inf"))
    # A scale with a larger relative uncertainty than this is not used.
    if fit.scale_error > 0.1:
        side_m = spread_m / np.sqrt(len(source))
        return replace(
            fit,
            reason=f"the positions by {fit.source} lie within about {side_m:.1f} m of their middle, too close for "
            f"positions that are good to {noise_m:.1f} m: the scale would be known to ± "
            f"{100 * fit.scale_error:.0f} %",
        )
    return fit


def _fit_plane(
    source: ComplexArray, target: ComplexArray, noise_m: float, *, rng: np.random.Generator
) -> tuple[complex, complex]:
    """Return a and b of target ≈ a source + b, robust to outliers."""
    first, second = _pairs(len(source), rng)
    baselines = source[second] - source[first]
    usable = np.abs(baselines) > 1e-6 * np.abs(source - source.mean()).max()
    if not usable.any():
        return 0.0, complex(np.median(target.real), np.median(target.imag))
    first, second = first[usable], second[usable]
    factors = (target[second] - target[first]) / baselines[usable]
    limit = (_OUTLIER_SIGMAS * noise_m) ** 2 * 2
    costs = [
        np.minimum(np.abs(factor * (source - source[idx]) + target[idx] - target) ** 2, limit).sum()
        for factor, idx in zip(factors, first, strict=True)
    ]
    best = int(np.argmin(costs))
    factor, shift = factors[best], target[first[best]] - factors[best] * source[first[best]]
    for _ in range(20):
        residuals = np.abs(factor * source + shift - target)
        weights = 1 / (1 + (residuals / (noise_m * np.sqrt(2))) ** 2)
        middle, aim = np.average(source, weights=weights), np.average(target, weights=weights)
        centred = source - middle
        factor = np.sum(weights * centred.conj() * (target - aim)) / np.sum(weights * np.abs(centred) ** 2)
        shift = aim - factor * middle
    return complex(factor), complex(shift)


def _pairs(count: int, rng: np.random.Generator) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return all pairs of positions, or a random sample if there are too many."""
    if count * (count - 1) // 2 <= _MAX_HYPOTHESES:
        pairs = np.array(list(combinations(range(count), 2)))
    else:
        first = rng.integers(count, size=_MAX_HYPOTHESES)
        pairs = np.stack([first, (first + rng.integers(1, count, size=_MAX_HYPOTHESES)) % count], axis=1)
    return pairs[:, 0], pairs[:, 1]


def _similarity(
    factor: complex, shift: complex, levelling: FloatArray, *, level: FloatArray, local: FloatArray
) -> Similarity3:
    """Return local_from_world of a fit on the ground; the height is the median over the positions used."""
    scale = abs(factor)
    # A rotation by α in the complex plane x + iz is a rotation by −α about y, which points down.
    turn = rotation_from_rotvec([0.0, -np.angle(factor), 0.0])
    down_m = float(np.median(local[:, 1] - scale * level[:, 1])) if len(local) else 0.0
    return Similarity3(scale, turn @ levelling, np.array([shift.real, down_m, shift.imag]))
