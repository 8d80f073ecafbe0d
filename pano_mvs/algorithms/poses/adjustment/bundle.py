"""Angular bundle adjustment: Levenberg–Marquardt on cameras and points, points eliminated (Schur complement)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np
import scipy
from numpy.typing import NDArray

from pano_mvs.algorithms.poses.adjustment.camera_system import camera_order, camera_solver, camera_span, held
from pano_mvs.algorithms.two_view.refinement import tangent_basis
from pano_mvs.core.arrays import FloatArray, IndexArray
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import rotation_from_rotvec

Loss: TypeAlias = Literal["cauchy", "huber"]


@dataclass(frozen=True, slots=True)
class RobustLoss:
    """The loss of errors r: Huber's min(r², 2 s r − s²), or Cauchy's s² log(1 + r²/s²)."""

    kind: Loss
    scale_rad: float  # s, the error at which an observation with sigma 1 starts to lose influence

    def weights(self, errors_rad: FloatArray) -> FloatArray:
        """Return the weight of each observation in the reweighted least-squares problem, (T,) in (0, 1]."""
        relative = errors_rad / self.scale_rad
        weights: FloatArray = 1 / (1 + relative**2) if self.kind == "cauchy" else 1 / np.maximum(relative, 1.0)
        return weights

    def cost(self, errors_rad: FloatArray) -> float:
        """Return the loss summed over all observations, in units of the squared scale."""
        relative = errors_rad / self.scale_rad
        if self.kind == "cauchy":
            return float(np.sum(np.log1p(relative**2)))
        return float(np.sum(np.where(relative < 1, relative**2, 2 * relative - 1)))


_LENGTH_PULL = 3.0  # standard deviations at which an expected length starts to lose influence


@dataclass(frozen=True, eq=False)
class Lengths:
    """Expected lengths of baselines."""

    pairs: NDArray[np.intp]  # (K, 2) positions of the cameras of each baseline
    lengths: FloatArray  # (K,) the expected distances of their centres
    stds: FloatArray  # (K,) standard deviation of the logarithm of each
    weight: float  # of their squared deviations relative to that of rays, in units of the scale of their loss

    def __add__(self, other: Lengths) -> Lengths:
        """Return the lengths of both, with the weight of the first."""
        return Lengths(
            np.concatenate([self.pairs, other.pairs]),
            np.concatenate([self.lengths, other.lengths]),
            np.concatenate([self.stds, other.stds]),
            self.weight,
        )

    def in_order(self, place: NDArray[np.intp]) -> Lengths:
        """Return the lengths after camera n has got position place[n]."""
        return replace(self, pairs=place[self.pairs])

    def cost(self, centers: FloatArray) -> float:
        """Return the robust loss, to be added to that of the rays."""
        deviations, _ = self._deviations(centers)
        return self.weight * float(np.sum(_LENGTH_PULL**2 * np.log1p((deviations / _LENGTH_PULL) ** 2)))

    def add_to(self, system: ReducedCameras, centers: FloatArray, *, scale_rad: float) -> None:
        """Add the products of derivatives to a reduced system of cameras, some of whose points both cameras see."""
        deviations, towards = self._deviations(centers)
        weights = self.weight * scale_rad**2 / (1 + (deviations / _LENGTH_PULL) ** 2)
        rows = np.concatenate([towards, -towards], axis=1)  # by the centres of the first and the second camera
        places = np.concatenate([6 * self.pairs[:, :1] + [3, 4, 5], 6 * self.pairs[:, 1:] + [3, 4, 5]], axis=1)
        np.add.at(system.gradient, places, (weights * deviations)[:, None] * rows)
        np.add.at(system.diagonal, places, weights[:, None] * rows**2)
        row, column = places[:, :, None], places[:, None, :]
        lower = row >= column
        products = weights[:, None, None] * rows[:, :, None] * rows[:, None, :]
        columns = np.broadcast_to(column, lower.shape)[lower]
        np.add.at(system.band, (columns, (row - column)[lower]), products[lower])

    def _deviations(self, centers: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return by how many standard deviations lengths differ, and the derivatives by the first centres (K, 3)."""
        baselines = centers[self.pairs[:, 0]] - centers[self.pairs[:, 1]]
        squares = np.sum(baselines**2, axis=1)
        deviations = (np.log(squares) / 2 - np.log(self.lengths)) / self.stds
        return deviations, baselines / squares[:, None] / self.stds[:, None]


@dataclass(frozen=True, eq=False)
class Bundle:
    """Cameras, points, and observations sorted by point."""

    rotations: FloatArray  # (N, 3, 3) of cam_from_world
    centers: FloatArray  # (N, 3) in the world
    points: FloatArray  # (P, 3) in the world
    point_idx: IndexArray  # (T,) ascending
    image_idx: IndexArray  # (T,)
    bearings: FloatArray  # (T, 3) unit rays in the camera
    # (T,) standard deviation of each ray relative to a typical one, positive; None if all are equal
    sigmas: FloatArray | None = None
    # (T, 3) where each ray starts in its camera's frame, in metres; None if all start at the centre
    offsets_m: FloatArray | None = None
    units_per_m: float = 0.0  # units of the world per metre, by which the offsets are multiplied; 0 ignores them
    # expected lengths of baselines between cameras that share points; None if nothing is known
    lengths: Lengths | None = None

    @property
    def origins(self) -> FloatArray:
        """Where each ray starts in its camera's frame, (T, 3), in units of the world."""
        return np.zeros_like(self.bearings) if self.offsets_m is None else self.units_per_m * self.offsets_m

    def rays_in_cam(self) -> FloatArray:
        """Return the vectors from the rays' origins to their points, (T, 3), in the camera frames."""
        towards = self.points[self.point_idx] - self.centers[self.image_idx]
        rays: FloatArray = np.einsum("tij,tj->ti", self.rotations[self.image_idx], towards)
        return rays if self.offsets_m is None else rays - self.origins

    def check(self) -> None:
        """Raise UsageError unless observations are sorted by point, every point has one, and sigmas are positive."""
        if np.any(np.diff(self.point_idx) < 0) or len(np.unique(self.point_idx)) != len(self.points):
            raise UsageError("the observations of a bundle must be sorted by point, and every point must have one")
        if self.sigmas is not None and (self.sigmas.shape != self.point_idx.shape or not np.all(self.sigmas > 0)):
            raise UsageError("a bundle needs one positive sigma for each observation, or none at all")

    def errors_rad(self) -> FloatArray:
        """Return the angle between every observed ray and the ray to its point, (T,), in [0, π]."""
        in_cam = self.rays_in_cam()
        sine = np.linalg.norm(np.cross(self.bearings, in_cam), axis=1)
        angles: FloatArray = np.arctan2(sine, np.sum(self.bearings * in_cam, axis=1))
        return angles

    def scaled_errors_rad(self) -> FloatArray:
        """Return the errors divided by the sigmas, (T,), to which the robust loss is applied."""
        errors = self.errors_rad()
        return errors if self.sigmas is None else errors / self.sigmas

    def weights(self, scaled_errors_rad: FloatArray, loss: RobustLoss) -> FloatArray:
        """Return the weight of each squared error in the reweighted least-squares problem, (T,)."""
        weights = loss.weights(scaled_errors_rad)
        return weights if self.sigmas is None else weights / self.sigmas**2


def adjust_bundle(
    bundle: Bundle,
    loss: RobustLoss,
    *,
    max_iterations: int = 50,
    tolerance: float = 1e-7,
    fixed_camera: int = 0,
) -> Bundle:
    """Minimise the robust sum of squared angular errors; one camera stays fixed.

    Errors are divided by the sigmas of their observations, so precise rays have more weight than coarse ones. If all
    rays start at the centres, only the gauge determines the scale, which stays near its initial value because of the
    damping. Rays with offsets determine it.

    Args:
        bundle: initial values.
        loss: of the errors.
        max_iterations: maximum number of steps.
        tolerance: the adjustment ends with a step that lowers the cost by a smaller share than this.
        fixed_camera: position of the camera that stays fixed.

    Raises:
        UsageError: if the observations are not sorted by point.
    """
    bundle.check()
    if not len(bundle.points):
        return bundle
    order = camera_order(bundle.point_idx, bundle.image_idx, len(bundle.centers))
    place = np.argsort(order)
    ordered = _adjust_ordered(
        with_camera_order(bundle, order, place),
        loss,
        max_iterations=max_iterations,
        tolerance=tolerance,
        fixed_camera=int(place[fixed_camera]),
    )
    return with_camera_order(ordered, place, order)


def with_camera_order(bundle: Bundle, order: NDArray[np.intp], place: NDArray[np.intp]) -> Bundle:
    """Return the bundle with its cameras in another order; place[order[n]] is n."""
    return replace(
        bundle,
        rotations=bundle.rotations[order],
        centers=bundle.centers[order],
        image_idx=place[bundle.image_idx].astype(np.int32),
        lengths=None if bundle.lengths is None else bundle.lengths.in_order(place),
    )


def _adjust_ordered(
    bundle: Bundle, loss: RobustLoss, *, max_iterations: int, tolerance: float, fixed_camera: int
) -> Bundle:
    # Importing numba takes most of a second, so import it only where it is used.
    from pano_mvs.algorithms.poses.adjustment.kernels_bundle import ray_errors

    layout = _Layout.of(bundle)
    observed = bundle.point_idx, bundle.image_idx, bundle.bearings, layout.origins

    def scaled_errors_rad(of: Bundle) -> FloatArray:
        errors: FloatArray = ray_errors(of.rotations, of.centers, of.points, *observed)
        return errors if bundle.sigmas is None else errors / bundle.sigmas

    def cost_of(of: Bundle, errors: FloatArray) -> float:
        lengths = 0.0 if of.lengths is None else of.lengths.cost(of.centers)
        return loss.cost(errors) + lengths

    errors = scaled_errors_rad(bundle)
    cost, damping = cost_of(bundle, errors), 1e-4
    for _ in range(max_iterations):
        weights = bundle.weights(errors, loss)
        moved = _step(bundle, layout, weights, damping=damping, fixed_camera=fixed_camera, scale_rad=loss.scale_rad)
        moved_errors = scaled_errors_rad(moved)
        moved_cost = cost_of(moved, moved_errors)
        if not moved_cost < cost:
            damping *= 10
            if damping > 1e6:
                break
            continue
        converged = cost - moved_cost < tolerance * cost
        bundle, errors, cost, damping = moved, moved_errors, moved_cost, max(damping / 10, 1e-9)
        if converged:
            break
    return bundle


@dataclass(frozen=True, eq=False)
class ReducedCameras:
    """The reduced system of the cameras after elimination of the points, and what is needed to recover the points."""

    band: FloatArray  # (6N, width), see `camera_system`
    gradient: FloatArray  # (6N,)
    diagonal: FloatArray  # (6N,) of the cameras' own blocks, before elimination
    couplings: FloatArray  # (T, 6, 3) blocks of camera and point of every observation
    inverses: FloatArray  # (P, 3, 3) inverses of the points' own blocks
    point_gradients: FloatArray  # (P, 3)


@dataclass(frozen=True, eq=False)
class _Layout:
    """Data that do not change during an adjustment."""

    starts: NDArray[np.intp]  # (P + 1,) the observations of point p are starts[p] to starts[p + 1]
    width: int  # width of the band, see `camera_system`
    bases: FloatArray  # (T, 3, 2) two vectors normal to each observed ray
    origins: FloatArray  # (T, 3) where each ray starts in its camera's frame

    @staticmethod
    def of(bundle: Bundle) -> _Layout:
        """Return the layout of a bundle."""
        starts = np.searchsorted(bundle.point_idx, np.arange(len(bundle.points) + 1))
        width = 6 * (camera_span(starts, bundle.image_idx) + 1)
        return _Layout(starts, width, tangent_basis(bundle.bearings), bundle.origins)


def reduced_cameras(
    bundle: Bundle, weights: FloatArray, *, damping: float, layout: _Layout | None = None
) -> ReducedCameras:
    """Return the reduced camera system of a weighted bundle; points are damped, cameras are not."""
    from pano_mvs.algorithms.poses.adjustment.kernels_bundle import reduced_system

    layout = layout or _Layout.of(bundle)
    return ReducedCameras(
        *reduced_system(
            bundle.rotations,
            bundle.centers,
            bundle.points,
            layout.starts,
            bundle.image_idx,
            layout.bases,
            layout.origins,
            weights,
            damping,
            layout.width,
        )
    )


def _step(
    bundle: Bundle, layout: _Layout, weights: FloatArray, *, damping: float, fixed_camera: int, scale_rad: float
) -> Bundle:
    """Return the bundle after one damped step."""
    from pano_mvs.algorithms.poses.adjustment.kernels_bundle import moved_points

    system = reduced_cameras(bundle, weights, damping=damping, layout=layout)
    if bundle.lengths is not None:
        bundle.lengths.add_to(system, bundle.centers, scale_rad=scale_rad)
    # The small constant keeps a camera without observations in place.
    system.band[:, 0] += damping * system.diagonal + 1e-12 * system.diagonal.mean()
    band, gradient = held(system.band, system.gradient, fixed_camera)
    try:
        steps = -camera_solver(band)(gradient).reshape(-1, 6)
    except scipy.linalg.LinAlgError:
        return bundle
    return replace(
        bundle,
        rotations=rotation_from_rotvec(steps[:, :3]) @ bundle.rotations,
        centers=bundle.centers + steps[:, 3:],
        points=moved_points(
            bundle.points,
            layout.starts,
            bundle.image_idx,
            system.couplings,
            system.inverses,
            system.point_gradients,
            np.ascontiguousarray(steps),
        ),
    )
