"""Refine the observations of tracks by aligning patches of the images with one another on the sphere."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.ranges.agreement import pixels_containing
from pano_mvs.algorithms.two_view.refinement import tangent_basis
from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import pad_panorama
from pano_mvs.scene import Poses
from pano_mvs.scene.pose_groups import per_group

Picture = tuple[NDArray[np.uint8], NDArray[np.bool_]]

SIZE, MARGIN = 13, 4
_MAX_WIDTH = 4096  # wider panoramas are rarely sharp to a pixel, and their patches would contain too little detail
_PAD_PX = 8
# All of these were tuned on rendered and synthetic captures; the result changes little around them.
_WINDOW = SIZE / 4  # standard deviation of the weights, in samples
_MIN_CORRELATION = 0.85
_MAX_SHIFT = 1.0  # samples
_FLOOR = 0.1  # samples: error that the deviation of the aligned patches does not include
_MAX_PER_IMAGE = 1500  # observations: if there are more, their number gives enough precision
_AT_ONCE = 100_000  # observations whose patches are in memory at a time


def align_tracks(poses: Poses, load: Callable[[str], Picture]) -> Poses:
    """Return poses whose observations are refined by the images, with the precision of each observation.

    A key point is located in each image on its own, to a fifth of a pixel or worse; its surroundings in two images can
    be aligned far more precisely. Each track has a reference, the observation whose viewing direction is nearest to the
    average of the track. A patch of 13 × 13 pixels around it, normal to the reference's ray, is sampled in all images
    of the track as the poses and the point's range predict, and aligned with the reference's patch by the method of
    Lucas and Kanade with an affine warp. Observations that do not align (low contrast, occluded, at a depth
    discontinuity, next to masked pixels) stay where they are and get less weight. If there are more than 1500
    observations per image on average, only the longest tracks are aligned.

    Cameras and points do not move: adjust them afterwards (`refine_poses`). The method is deterministic.

    Args:
        poses: poses with tracks, accurate to a pixel or two.
        load: returns the panorama (H, W, 3) and the mask (H, W) of an image by its name. Called once or a few times for
            each image.

    Returns:
        The same poses with new `track_bearings`, and with `track_sigmas_rad`.
    """
    return per_group(poses, lambda group: _aligned(group, load))


def _aligned(poses: Poses, load: Callable[[str], Picture]) -> Poses:
    if not len(poses.track_point_idx):
        return poses
    step_rad = 2 * np.pi / min(load(poses.names[0])[0].shape[1], _MAX_WIDTH)
    sightings = _sightings(poses, step_rad)
    bearings = np.array(poses.track_bearings)
    lengths = np.bincount(poses.track_point_idx)
    order = np.argsort(-lengths, kind="stable")
    chosen = np.zeros(len(lengths), np.bool_)
    chosen[order[np.cumsum(lengths[order]) <= _MAX_PER_IMAGE * len(poses.names)]] = True
    chosen = chosen[poses.track_point_idx]  # observations of the longest tracks
    # In samples: of an observation that does not align and keeps its detected position, and of one that is not tried.
    sigmas_rad = np.where(chosen, 0.3, 0.15) * step_rad
    for block in _blocks(sightings.reference_idx, poses.track_image_idx, chosen):
        _align_block(poses, sightings, block, load=load, step_rad=step_rad, bearings=bearings, sigmas_rad=sigmas_rad)
    return replace(poses, track_bearings=bearings, track_sigmas_rad=sigmas_rad.astype(np.float32))


@dataclass(frozen=True, slots=True, eq=False)
class _Sightings:
    """The reference of each observation, (T,), and the rays of its patch in its camera, (T, 3).

    `middles` points along the observed ray, with the length of the point's range. The patch's sample (u, v) is in the
    direction middles + u first_axes + v second_axes. A sample is `step_rad` times `zoom` (T,) wide as seen by the
    camera.
    """

    reference_idx: NDArray[np.intp]
    middles: FloatArray
    first_axes: FloatArray
    second_axes: FloatArray
    zoom: FloatArray


def _sightings(poses: Poses, step_rad: float) -> _Sightings:
    point_idx, image_idx = poses.track_point_idx, poses.track_image_idx
    towards = poses.points_in_world[point_idx] - poses.centers[image_idx]
    ranges = np.maximum(np.linalg.norm(towards, axis=1), 1e-12)
    rays = towards / ranges[:, None]
    count = len(poses.points_in_world)
    total = np.stack([np.bincount(point_idx, column, count) for column in rays.T], axis=1)
    mean = total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12)
    # The reference of a point is the ray nearest to the mean, the nearer of two.
    # Two observations are equally near to their mean, except for rounding errors.
    likeness = np.round(np.sum(rays * mean[point_idx], axis=1), 9)
    order = np.lexsort((ranges, -likeness, point_idx))
    first = np.concatenate([[True], np.diff(point_idx[order]) > 0])
    reference_of_point = np.zeros(count, np.intp)
    reference_of_point[point_idx[order[first]]] = order[first]
    reference_idx = reference_of_point[point_idx]
    steps = (step_rad * ranges[reference_idx])[:, None, None]
    axes = poses.rotations[image_idx] @ (steps * tangent_basis(rays[reference_idx]))
    return _Sightings(
        reference_idx=reference_idx,
        middles=ranges[:, None] * poses.track_bearings,
        first_axes=np.ascontiguousarray(axes[..., 0]),
        second_axes=np.ascontiguousarray(axes[..., 1]),
        zoom=ranges[reference_idx] / ranges,
    )


def _blocks(
    reference_idx: NDArray[np.intp], image_idx: NDArray[np.int32], chosen: NDArray[np.bool_]
) -> Iterator[NDArray[np.intp]]:
    """Yield positions of chosen observations, whole tracks, about `_AT_ONCE` at a time, sorted by image."""
    order = np.lexsort((reference_idx, image_idx[reference_idx]))
    order = order[chosen[order]]
    if not len(order):
        return
    starts = np.flatnonzero(np.concatenate([[True], np.diff(reference_idx[order]) != 0]))
    chosen = starts[np.unique(np.searchsorted(starts, np.arange(0, len(order), _AT_ONCE)).clip(max=len(starts) - 1))]
    yield from np.split(order, chosen[1:])


def _align_block(
    poses: Poses,
    sightings: _Sightings,
    block: NDArray[np.intp],
    *,
    load: Callable[[str], Picture],
    step_rad: float,
    bearings: FloatArray,
    sigmas_rad: FloatArray,
) -> None:
    """Write the bearings and sigmas of the observations of some tracks."""
    place = np.full(len(bearings), -1, np.intp)
    place[block] = np.arange(len(block))
    targets = block[sightings.reference_idx[block] != block]
    references = sightings.reference_idx[targets]
    shifts, correlations, deviations = aligned_shifts(
        _patches(poses, sightings, block, load=load), place[references], place[targets]
    )
    zoom = sightings.zoom[targets]
    moved = np.linalg.norm(shifts, axis=1) * zoom
    good = (correlations > _MIN_CORRELATION) & (moved < _MAX_SHIFT)
    targets, references, shifts = targets[good], references[good], shifts[good]
    rays = (
        sightings.middles[targets]
        + shifts[:, :1] * sightings.first_axes[targets]
        + shifts[:, 1:] * sightings.second_axes[targets]
    )
    bearings[targets] = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    # Two patches with the same standard deviation differ by √(2 (1 − correlation)).
    noise = np.sqrt(np.maximum(2 * (1 - correlations[good]), 1e-4))
    sigmas_rad[targets] = step_rad * np.hypot(_FLOOR, deviations[good] * noise * zoom[good])
    np.minimum.at(sigmas_rad, references, sigmas_rad[targets])


def _patches(
    poses: Poses, sightings: _Sightings, block: NDArray[np.intp], *, load: Callable[[str], Picture]
) -> NDArray[np.float32]:
    """Return the patches of observations with their margins, (M, n, n) grey levels, loading one image at a time."""
    # Importing numba takes most of a second, so import it only where it is used.
    from pano_mvs.algorithms.poses.adjustment.kernels_patch_alignment import sample_patches

    side = SIZE + 2 * MARGIN
    patches = np.empty((len(block), side, side), np.float32)
    image_idx = poses.track_image_idx[block]
    for image in np.unique(image_idx):
        own = np.flatnonzero(image_idx == image)
        seen = block[own]
        sampled = np.empty((len(own), side, side), np.float32)
        panorama, mask = load(poses.names[image])
        rays = sightings.middles[seen], sightings.first_axes[seen], sightings.second_axes[seen]
        sample_patches(smoothed_gray(panorama), _PAD_PX, *rays, sampled)
        sampled[_masked(mask, rays)] = 0.0  # patches without contrast do not align
        patches[own] = sampled
    return patches


def _masked(mask: NDArray[np.bool_], rays: tuple[FloatArray, FloatArray, FloatArray]) -> NDArray[np.bool_]:
    """Return which patches, (M,), extend into the masked part of an image; 5 × 5 rays of each patch are tested."""
    middles, first_axes, second_axes = rays
    masked = np.zeros(len(middles), np.bool_)
    if mask.all():
        return masked
    steps = np.linspace(-(SIZE - 1) / 2, (SIZE - 1) / 2, 5)
    for across in steps:
        for down in steps:
            masked |= ~mask[pixels_containing(middles + across * first_axes + down * second_axes, mask.shape)]
    return masked


def smoothed_gray(panorama: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return the grey levels from which patches are sampled, (H + 16, W + 16), with a margin of 8 pixels."""
    gray = cv2.cvtColor(panorama, cv2.COLOR_RGB2GRAY).astype(np.float32)
    sigma_px = 0.5 * max(1.0, panorama.shape[1] / _MAX_WIDTH)  # standard deviation, in samples
    return np.asarray(cv2.GaussianBlur(pad_panorama(gray, _PAD_PX), (0, 0), sigma_px), np.float32)


def aligned_shifts(
    patches: NDArray[np.float32], reference_idx: NDArray[np.intp], target_idx: NDArray[np.intp]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the shifts of patch centres that align the patches with their references.

    Args:
        patches: (T, 21, 21) grey levels: 13 × 13 samples and a margin of 4 around them.
        reference_idx: (M,) patches to align with.
        target_idx: (M,) patches to align.

    Returns:
        shifts (M, 2) in samples along a patch's columns and rows; correlations (M,) after alignment, 0 if there is no
        contrast or no alignment within the margin; deviations (M,) of the shift along its least certain axis, in
        samples, for noise as large as the contrast.
    """
    from pano_mvs.algorithms.poses.adjustment.kernels_patch_alignment import align_patches

    count = len(target_idx)
    shifts, correlations, deviations = np.empty((count, 2)), np.empty(count), np.empty(count)
    align_patches(patches, reference_idx, target_idx, window(), 6.0, shifts, correlations, deviations)
    return shifts, correlations, deviations


def window() -> FloatArray:
    """Return the weights of a patch's samples, (13, 13)."""
    squared = (np.arange(SIZE) - (SIZE - 1) / 2) ** 2
    weights: FloatArray = np.exp(-0.5 * (squared[:, None] + squared) / _WINDOW**2)
    return weights
