"""The camera of an ordinary photograph: pose, focal length and radial distortion, and their refinement."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import Rigid3, rotation_from_rotvec

if TYPE_CHECKING:
    from scipy.optimize import OptimizeResult

# Errors beyond this many times the median of the inliers' count less and less (Cauchy's loss).
_ROBUST = 1.5


@dataclass(frozen=True, slots=True, eq=False)
class Sightings:
    """Where a photograph shows points."""

    pixels_px: FloatArray  # (N, 2) float64
    points_in_world: FloatArray  # (N, 3) float64
    whitening: FloatArray  # (N, 2, 2) matrices W that turn errors in pixels into independent ones with a deviation of 1
    tested: int  # number of points that could have been seen

    @staticmethod
    def joined(parts: Sequence[Sightings]) -> Sightings:
        """Return the sightings of several panoramas."""
        return Sightings(
            np.concatenate([np.zeros((0, 2)), *(part.pixels_px for part in parts)]),
            np.concatenate([np.zeros((0, 3)), *(part.points_in_world for part in parts)]),
            np.concatenate([np.zeros((0, 2, 2)), *(part.whitening for part in parts)]),
            sum(part.tested for part in parts),
        )

    def errors(
        self, camera: PhotographCamera, size_hw: tuple[int, int], *, center_px: FloatArray | float = 0.0
    ) -> FloatArray:
        """Return the errors (N, 2) of a camera, whose optical centre is off the middle, in standard deviations."""
        away = camera.project(self.points_in_world, size_hw)[0] + center_px - self.pixels_px
        return np.asarray(np.einsum("nij,nj->ni", self.whitening, away))

    def robust(
        self, camera: PhotographCamera, size_hw: tuple[int, int], scale: float, *, center_px: FloatArray | float = 0.0
    ) -> FloatArray:
        """Return vectors (2N,) whose squares are the losses (Cauchy's) of the errors relative to a scale."""
        errors = self.errors(camera, size_hw, center_px=center_px) / scale
        squared = (errors**2).sum(axis=1, keepdims=True) + 1e-12
        return np.asarray((errors * np.sqrt(np.log1p(squared) / squared)).ravel())

    def scale(self, camera: PhotographCamera, size_hw: tuple[int, int]) -> float:
        """Return the error from which sightings count less and less."""
        return max(1.0, _ROBUST * float(np.median(np.linalg.norm(self.errors(camera, size_hw), axis=1))))


class FocalPrior(NamedTuple):
    """What is known about a focal length."""

    focal_px: float  # the expected focal length
    log_std: float  # standard deviation of its natural logarithm


@dataclass(frozen=True, slots=True, eq=False)
class PhotographCamera:
    """The camera of a photograph; see `Photographs` for the projection."""

    cam_from_world: Rigid3  # the pose
    focal_px: float  # focal length
    radial: float  # coefficient of the distortion

    def fov_deg(self, size_hw: tuple[int, int]) -> float:
        """Return the angle that the longer side of a photograph covers, without the distortion."""
        return float(np.degrees(2 * np.arctan(max(size_hw) / 2 / self.focal_px)))

    def project(self, points_in_world: FloatArray, size_hw: tuple[int, int]) -> tuple[FloatArray, NDArray[np.bool_]]:
        """Return the pixels (N, 2) of points (N, 3), and which of them are before the camera, (N,)."""
        in_cam = self.cam_from_world.apply(points_in_world)
        before = in_cam[:, 2] > 1e-9
        plane = in_cam[:, :2] / np.where(before, in_cam[:, 2], 1.0)[:, None]
        if self.radial < 0:  # beyond this radius, the distortion folds back into the picture
            before &= (plane**2).sum(axis=1) < -1 / (3 * self.radial)
        distorted = (1 + self.radial * (plane**2).sum(axis=1, keepdims=True)) * plane
        return self.focal_px * distorted + np.array(size_hw[::-1]) / 2, before

    def errors(self, pixels_px: FloatArray, points_in_world: FloatArray, size_hw: tuple[int, int]) -> FloatArray:
        """Return the reprojection errors (N,) in pixels; infinite behind the camera."""
        seen, before = self.project(points_in_world, size_hw)
        return np.asarray(np.where(before, np.linalg.norm(seen - pixels_px, axis=1), np.inf))


def refine_camera(
    pixels_px: FloatArray,
    points_in_world: FloatArray,
    camera: PhotographCamera,
    *,
    size_hw: tuple[int, int],
    prior: FocalPrior,
    max_error: float,
) -> PhotographCamera:
    """Return the camera that minimises the robust reprojection error of its inliers, given the prior.

    The inliers are selected again a few times. Without priors, focal length, distortion and distance would be ambiguous
    where all points are about equally far away.

    Args:
        pixels_px: (N, 2).
        points_in_world: (N, 3).
        camera: the camera to start from.
        size_hw: (height, width) of the photograph.
        prior: what is known about the focal length.
        max_error: the largest error of an inlier, in radians at the centre.
    """
    for _ in range(4):
        errors = camera.errors(pixels_px, points_in_world, size_hw)
        inliers = errors < camera.focal_px * max_error
        if inliers.sum() < 6:
            break
        scale_px = max(0.1, _ROBUST * float(np.median(errors[inliers])))
        camera = _adjusted(
            pixels_px[inliers], points_in_world[inliers], camera, size_hw=size_hw, prior=prior, scale_px=scale_px
        )
    return camera


def _adjusted(
    pixels_px: FloatArray,
    points_in_world: FloatArray,
    camera: PhotographCamera,
    *,
    size_hw: tuple[int, int],
    prior: FocalPrior,
    scale_px: float,
) -> PhotographCamera:
    """Return the camera with the smallest errors (Cauchy's loss with a scale) to all of some points."""

    def losses(moved: PhotographCamera, _rest: FloatArray) -> FloatArray:
        errors = (moved.project(points_in_world, size_hw)[0] - pixels_px).ravel() / scale_px
        return np.asarray(np.sign(errors) * np.sqrt(np.log1p(errors**2)))

    return _moved(camera, _least_squares(camera, prior, losses).x)


def refine_by_sightings(
    camera: PhotographCamera, sightings: Sightings, *, size_hw: tuple[int, int], prior: FocalPrior
) -> PhotographCamera:
    """Return the camera that minimises the robust errors of sightings, each in units of its standard deviation.

    A sighting is less certain along the direction in which an error of the point's range moves it, so that points of
    distant panoramas count mainly by their epipolar lines.

    Args:
        camera: the camera to start from.
        sightings: where the photograph shows points.
        size_hw: (height, width) of the photograph.
        prior: what is known about the focal length.
    """
    scale = sightings.scale(camera, size_hw)
    found = _least_squares(camera, prior, lambda moved, _rest: sightings.robust(moved, size_hw, scale))
    return _moved(camera, found.x)


def optical_center_offset(
    camera: PhotographCamera, sightings: Sightings, *, size_hw: tuple[int, int], prior: FocalPrior
) -> tuple[FloatArray, FloatArray]:
    """Return how far the optical centre is from the middle of the photograph, (2,), and its standard deviations (2,).

    Both are shares of the longer side. All other parameters are estimated with it. It is far from the middle if the
    photograph was cropped.

    Args:
        camera: the refined camera, whose optical centre is the middle.
        sightings: where the photograph shows points.
        size_hw: (height, width) of the photograph.
        prior: what is known about the focal length.
    """
    scale = sightings.scale(camera, size_hw)
    found = _least_squares(
        camera,
        prior,
        lambda moved, shift: sightings.robust(moved, size_hw, scale, center_px=max(size_hw) * shift),
        more=(0.02, 0.02),
    )
    variance = 2 * found.cost / max(1, len(found.fun) - len(found.x))
    jacobian: FloatArray = np.asarray(found.jac, np.float64)
    covariance = variance * np.linalg.pinv(jacobian.T @ jacobian)
    return np.asarray(found.x[8:]), np.sqrt(np.diag(covariance)[8:])


def _least_squares(
    camera: PhotographCamera,
    prior: FocalPrior,
    errors_of: Callable[[PhotographCamera, FloatArray], FloatArray],
    *,
    more: tuple[float, ...] = (),
) -> OptimizeResult:
    """Minimise errors, given the prior, over small changes of a camera and of further parameters.

    Args:
        camera: the camera to start from.
        prior: what is known about the focal length.
        errors_of: errors of a camera with the further parameters.
        more: typical values of these, which start at 0.
    """
    from scipy.optimize import least_squares

    def residuals(change: FloatArray) -> FloatArray:
        moved = _moved(camera, change[:8])
        own = [np.log(moved.focal_px / prior.focal_px) / prior.log_std, moved.radial / 0.1]
        return np.concatenate([errors_of(moved, change[8:]), own])

    # Typical changes of rotation, translation, log focal length and distortion.
    steps = (0.01, 0.01, 0.01, 0.01, 0.01, 0.01, 0.05, 0.05, *more)
    return least_squares(residuals, np.zeros(len(steps)), x_scale=steps)


def _moved(camera: PhotographCamera, change: FloatArray) -> PhotographCamera:
    """Return a camera after a small rotation, a translation, and changes of log focal length and distortion."""
    pose = camera.cam_from_world
    turn = rotation_from_rotvec(change[:3])
    moved = Rigid3(turn @ pose.rotation, turn @ pose.translation + change[3:6])
    return PhotographCamera(moved, camera.focal_px * float(np.exp(change[6])), camera.radial + float(change[7]))
