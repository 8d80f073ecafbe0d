"""Refine the poses of a whole capture by angular bundle adjustment, with outliers rejected and lengths by floors."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.poses.adjustment.bundle import Bundle, Loss, RobustLoss, adjust_bundle
from pano_mvs.algorithms.poses.adjustment.lengths import floor_lengths, lengths_of, open_lengths, pairs_of_scales
from pano_mvs.algorithms.poses.adjustment.patch_alignment import Picture, align_tracks
from pano_mvs.algorithms.poses.adjustment.tracks import triangulate_observations
from pano_mvs.algorithms.poses.adjustment.uncertainty import (
    OffsetScale,
    camera_deviations,
    estimate_offset_scale,
    held_cameras,
    parameter_step,
    ray_derivatives,
)
from pano_mvs.algorithms.poses.frame.gauge import first_neighbour, in_gauge_of
from pano_mvs.algorithms.poses.frame.metric_scale import scaled_poses
from pano_mvs.algorithms.two_view.refinement import tangent_basis
from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.settings import Setting, checks_settings
from pano_mvs.geometry import LensRig
from pano_mvs.scene import Poses
from pano_mvs.scene.pose_groups import per_group, split_groups

_ROUNDS = 3
# The first rounds only select the observations of the last round.
_TOLERANCES = (1e-3, 1e-3, 1e-7)
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
    rigs: Mapping[str, LensRig] | None = None,
) -> Poses:
    """Refine poses and points by minimising the robust sum of squared angles between observed and predicted rays.

    The angle is measured on the tangent plane of each observed ray, so that pixels near a pole have the weight of the
    area they cover, and the seam has no effect. Between rounds, points are triangulated again, and observations that do
    not fit are dropped. The world frame stays the same: the first camera and the length of its first baseline are
    fixed; if lengths are metres, the cameras as a whole stay in place. The uncertainty of each camera, relative to the
    first camera and first baseline, is in `center_stds` and `rotation_stds_rad`; see `camera_deviations`. Groups are
    adjusted one by one, each in its own world frame.

    If the cameras stand upright, the heights at which pairs of them see the floor below them are expected to be equal,
    within their spread, which determines lengths where few matches do (see `floor_lengths`).

    If the images are given, observations are then refined by aligning patches, each with its precision (see
    `align_tracks`), and everything is adjusted once more. This halves the error if key points are few or coarse.

    Panoramas that were stitched from two lenses are not central cameras: with their rigs, each ray starts at the centre
    of its lens. The distance of the lenses then also determines the unit of length. If it is determined to 3 %, the
    poses are in metres, and `scale` states the uncertainty; otherwise the offsets are ignored, unless the poses were in
    metres before. `track_bearings` remain bearings of the panoramas.

    Args:
        poses: poses with tracks; poses without tracks are returned unchanged.
        loss_scale_deg: error at which an observation starts to lose influence. If the precision of observations is
            known, this is for a standard deviation of 0.07°, and scales with it.
        load: returns the panorama and the mask of an image by its name; None keeps the observations as they are.
        rigs: image name to the lenses of its panorama; other images are central cameras.

    Raises:
        UsageError: if a setting is out of bounds.
    """
    settings = _Settings(loss, loss_scale_deg, max_error_deg, max_iterations)
    if rigs:
        return per_group(poses, lambda group: _refined_with_rigs(group, settings, rigs, load=load))
    return _refined_centrally(poses, settings, load=load)


def fitted_elevation_range(poses: Poses, refined: Poses, *, loss: Loss, loss_scale_deg: float) -> ElevationRange | None:
    """Return the elevations that the panoramas of the largest group cover, by its tracks; None without tracks.

    If the rays of full spheres do not fit, the poses are refined again with the rays that fit better, until the range
    stays the same.

    Args:
        poses: poses with tracks.
        refined: the same, refined.
        loss: as in `refine_poses`.
        loss_scale_deg: as in `refine_poses`.
    """
    group, fitted = split_groups(poses)[0], split_groups(refined)[0]
    neighbour = first_neighbour(fitted.centers)
    if not neighbour or not len(fitted.track_point_idx):
        return None
    found = ElevationRange(90.0, -90.0, (0.0, 0.0))
    # Nine captures of full spheres are within 2.3 deviations; later rounds choose the observations that fit them.
    for round_idx in range(8):
        robust = RobustLoss(loss, float(np.deg2rad(loss_scale_deg)))
        step = estimate_elevation_range(_bundle(fitted)[0], robust, neighbour=neighbour)
        found = found.then(step)
        if step.deviations <= (1 if round_idx else 3.0):
            break
        again = replace(
            group,
            rotations=fitted.rotations,
            translations=fitted.translations,
            track_bearings=found.bearings(group.track_bearings),
        )
        fitted = refine_poses(again, loss=loss, loss_scale_deg=loss_scale_deg)
    return found


@dataclass(frozen=True, slots=True)
class _Settings:
    """The settings of `refine_poses`."""

    loss: Loss
    loss_scale_deg: float
    max_error_deg: float
    max_iterations: int

    def robust(self, wider: int = 1) -> RobustLoss:
        """Return the loss, with a wider scale."""
        return RobustLoss(self.loss, float(np.deg2rad(self.loss_scale_deg * wider)))


def _refined_centrally(poses: Poses, settings: _Settings, *, load: Callable[[str], Picture] | None) -> Poses:
    """Return poses whose rays all start at the centres of their cameras, refined."""

    def refined(group: Poses, rounds: int) -> Poses:
        bundle, colors = _adjusted(*_bundle(group), settings, rounds=rounds)
        refined = _with_uncertainty(
            _poses(group, bundle, colors), bundle, settings, neighbour=first_neighbour(group.centers)
        )
        return in_gauge_of(refined, group.centers)

    adjusted = per_group(poses, partial(refined, rounds=_ROUNDS))
    return adjusted if load is None else per_group(align_tracks(adjusted, load), partial(refined, rounds=1))


def _refined_with_rigs(
    poses: Poses, settings: _Settings, rigs: Mapping[str, LensRig], *, load: Callable[[str], Picture] | None
) -> Poses:
    """Return one group, refined with the true rays of the lenses."""
    neighbour = first_neighbour(poses.centers)
    own_rigs = [rigs.get(name) for name in poses.names]
    if not neighbour or not any(own_rigs) or not len(poses.track_point_idx):
        return _refined_centrally(poses, settings, load=load)
    estimate = partial(estimate_offset_scale, loss=settings.robust(), neighbour=neighbour)
    bundle, colors = _with_offsets(*_bundle(poses), own_rigs)
    measured = all(rig.metric for rig in own_rigs if rig is not None)
    if poses.metric and measured:
        bundle = replace(bundle, units_per_m=1.0)
    else:
        found = _with_unit(bundle, colors, settings, estimate=estimate)
        if found is None:
            return _refined_centrally(poses, settings, load=load)
        bundle = found
    adjusted, colors = _adjusted(bundle, colors, settings, rounds=_ROUNDS)
    refined = _poses(poses, adjusted, colors, rigs=own_rigs)
    if load is not None:
        aligned, colors = _with_offsets(*_bundle(align_tracks(refined, load)), own_rigs)
        adjusted, colors = _adjusted(replace(aligned, units_per_m=bundle.units_per_m), colors, settings, rounds=1)
        refined = _poses(refined, adjusted, colors, rigs=own_rigs)
    refined = _with_uncertainty(refined, adjusted, settings, neighbour=neighbour)
    if poses.metric and measured:
        return in_gauge_of(refined, poses.centers)
    scale = estimate(adjusted)
    # Offsets that determine the unit of length less well than this are too small to matter. A wrong solution leaves
    # out most observations.
    if not scale.relative_std < 0.03 or len(adjusted.bearings) < 0.5 * len(bundle.bearings):
        return _refined_centrally(poses, settings, load=load)
    if not measured:
        return in_gauge_of(refined, poses.centers)
    distance_mm = 2000 * np.median([rig.lens_offset_m for rig in own_rigs if rig is not None])
    origin = (
        f"the distance of {distance_mm:.3g} mm between the lens centres, uncertain by {100 * scale.relative_std:.1f} %"
    )
    return scaled_poses(refined, 1 / adjusted.units_per_m, origin=origin)


def _with_unit(
    bundle: Bundle, colors: NDArray[np.uint8], settings: _Settings, *, estimate: Callable[[Bundle], OffsetScale]
) -> Bundle | None:
    """Return a bundle with its units per metre and rough cameras; None if the offsets do not determine the unit."""
    for _ in range(10):
        # Until the offsets are known in units of the world, no observation can be called an outlier.
        rough, _unused = _adjusted(bundle, colors, settings, rounds=1, widen=4)
        scale = estimate(rough)
        # Before outliers are dropped and patches are aligned.
        if not scale.relative_std < 0.5:
            return None
        # Relative difference of two estimates.
        known = abs(scale.units_per_m - bundle.units_per_m) < 0.02 * scale.units_per_m
        bundle = replace(bundle, rotations=rough.rotations, centers=rough.centers, units_per_m=scale.units_per_m)
        if known:
            return bundle
    return None


def _adjusted(
    bundle: Bundle, colors: NDArray[np.uint8], settings: _Settings, *, rounds: int, widen: int = 1
) -> tuple[Bundle, NDArray[np.uint8]]:
    """Return one group's bundle after some rounds of adjustment, without outliers."""
    max_error_rad = float(np.deg2rad(settings.max_error_deg)) * widen
    pairs = pairs_of_scales(bundle)
    lengths = lengths_of(pairs, bundle.centers)
    for round_idx in range(rounds):
        # Wide at first: observations that are far off only because of wrong poses shall pull, not be dropped.
        wider = 2 ** (rounds - 1 - round_idx) * widen
        world_from_cam = np.swapaxes(bundle.rotations, 1, 2)[bundle.image_idx]
        starts = bundle.centers[bundle.image_idx]
        if bundle.offsets_m is not None:
            starts = starts + np.einsum("tij,tj->ti", world_from_cam, bundle.origins)
        found = triangulate_observations(
            starts,
            np.einsum("tij,tj->ti", world_from_cam, bundle.bearings),
            bundle.point_idx,
            count=len(bundle.points),
            max_error_rad=float(np.deg2rad(settings.max_error_deg * wider)),
            min_angle_rad=float(np.deg2rad(1.0)),
        )
        bundle, colors = _selected(replace(bundle, points=found.points_in_world), colors, found.used, valid=found.valid)
        loss = settings.robust(wider)
        known = floor_lengths(bundle, scale_rad=loss.scale_rad)
        if before := open_lengths(bundle, pairs, lengths, scale_rad=loss.scale_rad):
            known = known + before if known else before
        bundle = adjust_bundle(
            replace(bundle, lengths=known),
            loss,
            max_iterations=settings.max_iterations,
            tolerance=_TOLERANCES[round_idx - rounds] if widen == 1 else _TOLERANCES[0],
        )
    # Drop observations with large errors, then points with fewer than two observations.
    used = bundle.errors_rad() <= max_error_rad
    valid = np.bincount(bundle.point_idx[used], minlength=len(bundle.points)) >= 2
    return _selected(bundle, colors, used & valid[bundle.point_idx], valid=valid)


def _with_uncertainty(poses: Poses, bundle: Bundle, settings: _Settings, *, neighbour: int) -> Poses:
    """Return refined poses with the standard deviations of their cameras, given the distance of one to the first."""
    if not neighbour or not len(bundle.points):
        return poses
    centers, rotations = camera_deviations(bundle, settings.robust(), neighbour=neighbour)
    return replace(poses, center_stds=centers, rotation_stds_rad=rotations)


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


def _with_offsets(
    bundle: Bundle, colors: NDArray[np.uint8], rigs: Sequence[LensRig | None]
) -> tuple[Bundle, NDArray[np.uint8]]:
    """Replace the bearings of stitched panoramas by the rays of their lenses; drop those whose patches show both."""
    offsets_m, bearings = np.zeros_like(bundle.bearings), bundle.bearings.copy()
    used = np.ones(len(bearings), np.bool_)
    for idx, rig in enumerate(rigs):
        if rig is not None:
            own = bundle.image_idx == idx
            offsets_m[own], bearings[own] = rig.rays_from_bearings(bundle.bearings[own])
            # A patch this close to the strip in which two lenses are mixed shows both. Such key points bias the unit of
            # length: by 1.4 % instead of 0.3 % for 30 mm.
            strip_rad = float(np.radians(rig.blend_deg / 2 + 2.0))
            used[own] = rig.angle_from_seam(bundle.bearings[own]) > strip_rad
    valid = np.bincount(bundle.point_idx[used], minlength=len(bundle.points)) >= 2
    with_offsets = replace(bundle, bearings=bearings, offsets_m=offsets_m)
    return _selected(with_offsets, colors, used & valid[bundle.point_idx], valid=valid)


def _stitched_bearings(bundle: Bundle, rigs: Sequence[LensRig | None]) -> FloatArray:
    """Return the bearings in the panoramas of the rays of a bundle: `_with_offsets`, inverted."""
    assert bundle.offsets_m is not None
    bearings = bundle.bearings.copy()
    for idx, rig in enumerate(rigs):
        if rig is not None:
            own = bundle.image_idx == idx
            bearings[own] = rig.bearings_from_rays(bundle.offsets_m[own], bundle.bearings[own])
    return bearings


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
        offsets_m=None if bundle.offsets_m is None else bundle.offsets_m[used],
    )
    return selected, colors[valid]


def _poses(
    poses: Poses, bundle: Bundle, colors: NDArray[np.uint8], *, rigs: Sequence[LensRig | None] | None = None
) -> Poses:
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
        track_bearings=bundle.bearings if rigs is None else _stitched_bearings(bundle, rigs),
        track_sigmas_rad=None if bundle.sigmas is None else (bundle.sigmas * _USUAL_SIGMA_RAD).astype(np.float32),
    )


@dataclass(frozen=True, slots=True)
class ElevationRange:
    """The elevations of the upper and the lower edge of the panoramas."""

    top_deg: float  # of the upper edge; 90 for a full sphere
    bottom_deg: float  # of the lower edge; −90 for a full sphere
    stds_deg: tuple[float, float]  # standard deviations of both from noise in the rays; inf if they cannot be estimated

    @property
    def is_full(self) -> bool:
        """Return whether both edges may be the poles, within four standard deviations."""
        return self.deviations <= 4.0

    @property
    def deviations(self) -> float:
        """The larger distance of an edge from its pole, in standard deviations."""
        off_deg = np.abs([self.top_deg - 90.0, self.bottom_deg + 90.0])
        # Beyond the noise in the rays: on six captures of full spheres, real and rendered, the edges were at most 0.23°
        # off.
        return float((off_deg / np.hypot(self.stds_deg, 0.25)).max())

    def elevations_rad(self, elevations_rad: FloatArray) -> FloatArray:
        """Return the true elevations of what images that were read as full spheres show at some elevations."""
        middle, half = 0.5 * (self.top_deg + self.bottom_deg), 0.5 * (self.top_deg - self.bottom_deg)
        elevations: FloatArray = np.radians(middle) + elevations_rad * half / 90.0
        return elevations

    def bearings(self, bearings: FloatArray) -> FloatArray:
        """Return the true rays (T, 3) of images that were read as full spheres."""
        x, y, z = bearings.T
        azimuths, elevations = np.arctan2(x, z), self.elevations_rad(np.arcsin(np.clip(-y, -1, 1)))
        level = np.cos(elevations)
        return np.stack([level * np.sin(azimuths), -np.sin(elevations), level * np.cos(azimuths)], axis=1)

    def then(self, step: ElevationRange) -> ElevationRange:
        """Return the range whose true elevations are those of a further step."""
        edges = np.degrees(step.elevations_rad(np.radians([self.top_deg, self.bottom_deg])))
        return ElevationRange(float(edges[0]), float(edges[1]), step.stds_deg)


def estimate_elevation_range(bundle: Bundle, loss: RobustLoss, *, neighbour: int) -> ElevationRange:
    """Return the elevations of the edges that fit the rays best.

    Args:
        bundle: an adjusted bundle of panoramas that all cover the same elevations.
        loss: the loss of the adjustment.
        neighbour: position of the camera whose distance to the first is held.
    """
    held = held_cameras(bundle, loss, neighbour=neighbour)
    derivatives = ray_derivatives(held.bundle)
    x, y, z = held.bundle.bearings.T
    elevations, level = np.arcsin(np.clip(-y, -1, 1)), np.maximum(np.hypot(x, z), 1e-12)
    upwards = np.stack([y * x / level, -level, y * z / level], axis=1)
    by_shift = -np.einsum("tij,tj->ti", np.swapaxes(tangent_basis(held.bundle.bearings), 1, 2), upwards)
    step, covariance = parameter_step(held, derivatives, np.stack([elevations[:, None] * by_shift, by_shift], axis=-1))
    edges = np.array([[np.pi / 2, 1.0], [-np.pi / 2, 1.0]])
    variances = np.einsum("ek,kl,el->e", edges, np.where(np.isfinite(covariance), covariance, 0.0), edges)
    if not (variances > 0).all():
        return ElevationRange(90.0, -90.0, (float("inf"), float("inf")))
    top, bottom = np.degrees(edges @ (np.array([1.0, 0.0]) + step))
    stds = np.degrees(np.sqrt(variances))
    return ElevationRange(float(top), float(bottom), (float(stds[0]), float(stds[1])))
