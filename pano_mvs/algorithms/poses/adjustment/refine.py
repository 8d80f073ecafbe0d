"""Refine the poses of a whole capture by angular bundle adjustment, with rejection of outliers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.poses.adjustment.bundle import Bundle, Loss, adjust_bundle
from pano_mvs.algorithms.poses.adjustment.patch_alignment import Picture, align_tracks
from pano_mvs.algorithms.poses.adjustment.points import triangulate_observations
from pano_mvs.algorithms.poses.adjustment.uncertainty import camera_deviations
from pano_mvs.algorithms.poses.frame.gauge import first_neighbour, in_gauge_of
from pano_mvs.core.settings import Setting, checks_settings
from pano_mvs.scene import Poses
from pano_mvs.scene.pose_groups import per_group

FloatArray = NDArray[np.float64]

_ROUNDS = 3
# The first rounds only select the observations of the last round.
_TOLERANCES = (1e-3, 1e-3, 1e-7)
_MIN_ANGLE_RAD = float(np.deg2rad(1.0))
# Sigma of a key point in a panorama of 1024 columns, a fifth of a pixel, to which the scale of the loss refers.
_USUAL_SIGMA_RAD = float(np.deg2rad(0.07))


@checks_settings
def refine_poses(
    poses: Poses,
    *,
    loss: Annotated[Loss, Setting("robust loss of the angular residuals")] = "cauchy",
    loss_scale_deg: Annotated[float, Setting("residual at which an observation starts to lose influence", gt=0)] = 0.1,
    max_error_deg: Annotated[float, Setting("observations with a larger error are dropped", gt=0)] = 0.4,
    max_iterations: Annotated[int, Setting("maximum number of iterations in each round", ge=1)] = 50,
    load: Callable[[str], Picture] | None = None,
) -> Poses:
    """Refine poses and points by minimising the robust sum of squared angles between observed and predicted rays.

    The angle is measured on the tangent plane of each observed ray, so that pixels near a pole have the weight of the
    area they cover, and the seam has no effect. Between rounds, points are triangulated again, and observations that do
    not fit are dropped. The world frame stays the same: the first camera and the length of its first baseline are
    fixed; if lengths are metres, the cameras as a whole stay in place. The uncertainty of each camera, relative to the
    first camera and first baseline, is in `center_stds` and `rotation_stds_rad`; see `camera_deviations`. Groups are
    adjusted one by one, each in its own world frame.

    If the images are given, observations are then refined by aligning patches, each with its precision (see
    `align_tracks`), and everything is adjusted once more. This halves the error if key points are few or coarse.

    Args:
        poses: poses with tracks; poses without tracks are returned unchanged.
        loss: "huber" or "cauchy".
        loss_scale_deg: error at which an observation starts to lose influence. If the precision of observations is
            known, this is for a standard deviation of 0.07°, and scales with it.
        max_iterations: maximum number of steps in each round.
        max_error_deg: observations with a larger error are dropped.
        load: returns the panorama and the mask of an image by its name; None keeps the observations as they are.

    Raises:
        UsageError: if a setting is out of bounds.
    """
    refined = partial(
        _refined,
        loss=loss,
        loss_scale_deg=loss_scale_deg,
        max_iterations=max_iterations,
        max_error_deg=max_error_deg,
    )
    adjusted = per_group(poses, partial(refined, rounds=_ROUNDS))
    return adjusted if load is None else per_group(align_tracks(adjusted, load), partial(refined, rounds=1))


def _refined(
    poses: Poses, *, loss: Loss, loss_scale_deg: float, max_iterations: int, max_error_deg: float, rounds: int
) -> Poses:
    """Return one group, refined."""
    bundle, colors = _bundle(poses)
    for round_idx in range(rounds):
        # Wide at first: observations that are far off only because of wrong poses shall pull, not be dropped.
        widen = 2 ** (rounds - 1 - round_idx)
        bundle, colors = _fitting(bundle, colors, max_error_rad=float(np.deg2rad(max_error_deg * widen)))
        bundle = adjust_bundle(
            bundle,
            loss=loss,
            scale_rad=float(np.deg2rad(loss_scale_deg * widen)),
            max_iterations=max_iterations,
            tolerance=_TOLERANCES[round_idx],
        )
    bundle, colors = _without_outliers(bundle, colors, max_error_rad=float(np.deg2rad(max_error_deg)))
    refined = _poses(poses, bundle, colors)
    neighbour = first_neighbour(poses.centers)
    if neighbour and len(bundle.points):
        centers, rotations = camera_deviations(
            bundle, loss=loss, scale_rad=float(np.deg2rad(loss_scale_deg)), neighbour=neighbour
        )
        refined = replace(refined, center_stds=centers, rotation_stds_rad=rotations)
    return in_gauge_of(refined, poses.centers)


def _bundle(poses: Poses) -> tuple[Bundle, NDArray[np.uint8]]:
    order = np.lexsort((poses.track_image_idx, poses.track_point_idx))
    seen, point_idx = np.unique(poses.track_point_idx[order], return_inverse=True)
    bundle = Bundle(
        rotations=np.array(poses.rotations),
        centers=poses.centers,
        points=np.array(poses.points_in_world)[seen],
        point_idx=point_idx.astype(np.int32),
        image_idx=np.array(poses.track_image_idx)[order],
        bearings=np.array(poses.track_bearings)[order],
        sigmas=None
        if poses.track_sigmas_rad is None
        else poses.track_sigmas_rad[order].astype(np.float64) / _USUAL_SIGMA_RAD,
    )
    return bundle, np.array(poses.point_colors_rgb)[seen]


def _fitting(bundle: Bundle, colors: NDArray[np.uint8], *, max_error_rad: float) -> tuple[Bundle, NDArray[np.uint8]]:
    """Triangulate all points again, and keep the observations and points that fit."""
    found = triangulate_observations(
        bundle.centers[bundle.image_idx],
        np.einsum("tji,tj->ti", bundle.rotations[bundle.image_idx], bundle.bearings),
        bundle.point_idx,
        count=len(bundle.points),
        max_error_rad=max_error_rad,
        min_angle_rad=_MIN_ANGLE_RAD,
    )
    return _selected(replace(bundle, points=found.points_in_world), colors, found.used, valid=found.valid)


def _without_outliers(
    bundle: Bundle, colors: NDArray[np.uint8], *, max_error_rad: float
) -> tuple[Bundle, NDArray[np.uint8]]:
    """Drop observations with large errors, then points with fewer than two observations."""
    used = bundle.errors_rad() <= max_error_rad
    valid = np.bincount(bundle.point_idx[used], minlength=len(bundle.points)) >= 2
    return _selected(bundle, colors, used & valid[bundle.point_idx], valid=valid)


def _selected(
    bundle: Bundle, colors: NDArray[np.uint8], used: NDArray[np.bool_], *, valid: NDArray[np.bool_]
) -> tuple[Bundle, NDArray[np.uint8]]:
    selected = replace(
        bundle,
        points=bundle.points[valid],
        point_idx=(np.cumsum(valid) - 1)[bundle.point_idx[used]].astype(np.int32),
        image_idx=bundle.image_idx[used],
        bearings=bundle.bearings[used],
        sigmas=None if bundle.sigmas is None else bundle.sigmas[used],
    )
    return selected, colors[valid]


def _poses(poses: Poses, bundle: Bundle, colors: NDArray[np.uint8]) -> Poses:
    count = len(bundle.points)
    sizes = np.maximum(np.bincount(bundle.point_idx, minlength=count), 1)
    errors = np.bincount(bundle.point_idx, bundle.errors_rad(), count) / sizes
    return replace(
        poses,
        rotations=bundle.rotations,
        translations=-np.einsum("nij,nj->ni", bundle.rotations, bundle.centers),
        points_in_world=bundle.points,
        point_colors_rgb=colors,
        point_errors_rad=errors.astype(np.float32),
        track_point_idx=bundle.point_idx,
        track_image_idx=bundle.image_idx,
        track_bearings=bundle.bearings,
        track_sigmas_rad=None if bundle.sigmas is None else (bundle.sigmas * _USUAL_SIGMA_RAD).astype(np.float32),
    )
