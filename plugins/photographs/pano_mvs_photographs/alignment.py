"""Refine the camera of a photograph by patches of panoramas, and confirm it by them."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterable, Sequence
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.poses.adjustment.patch_alignment import MARGIN, SIZE, aligned_shifts, smoothed_gray, window
from pano_mvs.algorithms.two_view.refinement import tangent_basis
from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.errors import UsageError
from pano_mvs_photographs.camera import (
    FocalPrior,
    PhotographCamera,
    Sightings,
    optical_center_offset,
    refine_by_sightings,
)
from pano_mvs_photographs.panoramas import SurfacePoints

# Levels of the panoramas in each round: coarse patches are aligned from further away.
_ROUNDS = (1, 0, 0)


class Aligned(NamedTuple):
    """A camera after alignment."""

    camera: PhotographCamera  # the camera
    confirmed: int  # number of points that the photograph shows where the camera predicts them
    tested: int  # number of points that it could show
    # distance of the optical centre from the middle of the photograph, as a share of the longer side; 0 if it is not
    # significant
    off_center: float = 0.0

    @property
    def share(self) -> float:
        """The share of the tested points that are confirmed."""
        return self.confirmed / max(1, self.tested)


class PanoramaPatches:
    """The panoramas and the points of their surfaces; the panoramas of the last few photographs stay in memory.

    Args:
        surface: returns the points of a panorama by its name.
        load: returns a panorama (H, W, 3) by its name.
    """

    def __init__(self, surface: Callable[[str], SurfacePoints], load: Callable[[str], NDArray[np.uint8]]) -> None:
        self.surface = surface
        self._load = load
        self._held: OrderedDict[str, list[NDArray[np.float32]]] = OrderedDict()

    def levels(self, name: str) -> list[NDArray[np.float32]]:
        """Return the `panorama_levels` of a panorama."""
        if name not in self._held:
            while len(self._held) >= 10:
                self._held.popitem(last=False)
            self._held[name] = panorama_levels(_reduced(self._load(name), 2048), max(_ROUNDS) + 1)
        self._held.move_to_end(name)
        return self._held[name]


class PhotographPatches:
    """A photograph that is aligned with panoramas. It is kept in grey, and smoothed when it is needed.

    Args:
        photograph: (H, W, 3) uint8 RGB.
        panoramas: what it is aligned with.
    """

    def __init__(self, photograph: NDArray[np.uint8], panoramas: PanoramaPatches) -> None:
        self._size_hw = (photograph.shape[0], photograph.shape[1])
        self._gray = np.asarray(cv2.cvtColor(_reduced(photograph, 2048), cv2.COLOR_RGB2GRAY), np.uint8)
        self._panoramas = panoramas

    @property
    def too_narrow(self) -> bool:
        """Whether the photograph, reduced to at most 2048 pixels, is narrower or lower than a patch."""
        return bool(min(self._gray.shape) < MIN_SIDE_PX)

    @cached_property
    def _levels(self) -> list[NDArray[np.float32]]:
        return photograph_levels(self._gray)

    def aligned(self, camera: PhotographCamera, names: Iterable[str], *, prior: FocalPrior) -> Aligned:
        """Return the camera that some panoramas' patches confirm best, from one that is accurate to about a degree.

        Args:
            camera: the camera to start from.
            names: the panoramas.
            prior: what is known about the focal length.

        Raises:
            UsageError: if the photograph is too narrow.
        """
        if self.too_narrow:
            raise UsageError(f"the photograph, reduced to {self._gray.shape}, is smaller than a patch")
        chosen, sightings = list(names), Sightings.joined([])
        for level in _ROUNDS:
            sightings = Sightings.joined(
                [
                    sight_points(
                        self._panoramas.surface(name),
                        self._panoramas.levels(name)[level],
                        self._levels,
                        camera=camera,
                        size_hw=self._size_hw,
                    )
                    for name in chosen
                ]
            )
            # With fewer patches than these, the pose is wrong.
            if len(sightings.pixels_px) < max(12, 0.03 * sightings.tested):
                return Aligned(camera, 0, sightings.tested)
            camera = refine_by_sightings(camera, sightings, size_hw=self._size_hw, prior=prior)
        errors = np.linalg.norm(sightings.errors(camera, self._size_hw), axis=1)
        offset, stds = optical_center_offset(camera, sightings, size_hw=self._size_hw, prior=prior)
        significant = float(np.linalg.norm(offset / np.maximum(stds, 1e-9))) > 4.0
        off_center = float(np.linalg.norm(offset)) if significant else 0.0
        return Aligned(camera, int((errors < 3.0).sum()), sightings.tested, off_center)


def _reduced(picture: NDArray[np.uint8], max_px: int) -> NDArray[np.uint8]:
    scale = min(1.0, max_px / max(picture.shape))
    if scale == 1:
        return picture
    size_xy = [max(1, round(side * scale)) for side in picture.shape[1::-1]]
    return np.asarray(cv2.resize(picture, size_xy, interpolation=cv2.INTER_AREA), np.uint8)


BoolArray = NDArray[np.bool_]

MIN_SIDE_PX = SIZE + 2 * MARGIN + 1
"""Photographs with a shorter side have no levels."""

_PAD_PX = 8
# A patch is compared only where the photograph sees the surface at less than 75° from its normal, and not from behind.
_MIN_COSINE = 0.25
_MIN_CORRELATION, _MAX_SHIFT = 0.8, 3.0
_FLOOR = 0.05


def photograph_levels(gray: NDArray[np.uint8]) -> list[NDArray[np.float32]]:
    """Return a photograph (H, W) at its size, half of it, a quarter …, smoothed as the panoramas are.

    The smaller side of each level has at least `MIN_SIDE_PX` pixels.
    """
    levels: list[NDArray[np.float32]] = []
    reduced = gray.astype(np.float32)
    while len(levels) < 7 and min(reduced.shape) >= MIN_SIDE_PX:
        levels.append(np.asarray(cv2.GaussianBlur(reduced, (0, 0), 0.5), np.float32))
        size_xy = [max(1, round(side / 2 ** len(levels))) for side in gray.shape[::-1]]
        reduced = np.asarray(cv2.resize(reduced, size_xy, interpolation=cv2.INTER_AREA), np.float32)
    return levels


def panorama_levels(panorama: NDArray[np.uint8], count: int) -> list[NDArray[np.float32]]:
    """Return a panorama (H, W, 3) at its size, half of it, …, as `sample_patches` reads them."""
    levels = []
    for _ in range(count):
        levels.append(smoothed_gray(panorama))
        size_xy = panorama.shape[1] // 4 * 2, panorama.shape[1] // 4
        panorama = np.asarray(cv2.resize(panorama, size_xy, interpolation=cv2.INTER_AREA), np.uint8)
    return levels


def sight_points(
    surface: SurfacePoints,
    panorama: NDArray[np.float32],
    levels: Sequence[NDArray[np.float32]],
    *,
    camera: PhotographCamera,
    size_hw: tuple[int, int],
) -> Sightings:
    """Align a patch around each point, on the tangent plane of the surface, with the photograph.

    The method is that of `align_tracks`, with the panorama as reference and the plane of the surface instead of a patch
    normal to the ray: 13 × 13 samples, one pixel of the panorama apart.

    Args:
        surface: the points.
        panorama: one of `panorama_levels`, which determines the width of the patches.
        levels: `photograph_levels`.
        camera: the camera of the photograph, accurate to about three samples.
        size_hw: (height, width) of the photograph as the camera has it.
    """
    from pano_mvs.algorithms.poses.adjustment.kernels_patch_alignment import sample_patches  # compiles on import

    step_rad = 2 * np.pi / (panorama.shape[1] - 2 * _PAD_PX)
    seen = _testable(surface, camera, size_hw, step_rad=step_rad)
    surface = surface[seen]
    side = SIZE + 2 * MARGIN
    count = len(surface.ranges)
    if not count:
        return Sightings.joined([])
    patches = np.empty((2 * count, side, side), np.float32)
    axes = step_rad * tangent_basis(surface.bearings)
    first, second = np.ascontiguousarray(axes[..., 0]), np.ascontiguousarray(axes[..., 1])
    sample_patches(panorama, _PAD_PX, np.ascontiguousarray(surface.bearings), first, second, patches[:count])
    patches[count:], jacobians = _photograph_patches(surface, (first, second), levels, camera=camera, size_hw=size_hw)
    shifts, correlations, _ = aligned_shifts(patches, np.arange(count), np.arange(count, 2 * count))
    good = (correlations > _MIN_CORRELATION) & (np.linalg.norm(shifts, axis=1) < _MAX_SHIFT)
    surface, shifts = surface[good], shifts[good]
    rays = surface.bearings + shifts[:, :1] * first[good] + shifts[:, 1:] * second[good]
    pixels = camera.project(_on_planes(surface, rays), size_hw)[0]
    in_samples = _shift_covariances(patches[:count][good], correlations[good])
    points = surface.points_in_world
    nearer = surface.bearings * (surface.ranges * np.exp(-surface.range_stds))[:, None]
    moved = camera.project(surface.cam_from_world.inverse().apply(nearer), size_hw)[0]
    along = camera.project(points, size_hw)[0] - moved
    covariances = jacobians[good] @ in_samples @ jacobians[good].swapaxes(1, 2) + along[:, :, None] * along[:, None]
    whitening = np.linalg.cholesky(np.linalg.inv(covariances)).swapaxes(1, 2)
    return Sightings(pixels, points, whitening, count)


def _shift_covariances(patches: NDArray[np.float32], correlations: FloatArray) -> FloatArray:
    """Return the covariances (N, 2, 2) of shifts, in samples: large along the edges of a patch, small across them.

    Two patches with the same standard deviation differ by √(2 (1 − correlation)) of it.
    """
    inner = slice(MARGIN, -MARGIN)
    values = patches[:, inner, inner].astype(np.float64)
    weights = window() / window().sum()
    mean = (values * weights).sum(axis=(1, 2))[:, None, None]
    contrast = np.maximum((weights * (values - mean) ** 2).sum(axis=(1, 2)), 1e-9)
    across = 0.5 * (patches[:, inner, MARGIN + 1 : 1 - MARGIN] - patches[:, inner, MARGIN - 1 : -MARGIN - 1])
    down = 0.5 * (patches[:, MARGIN + 1 : 1 - MARGIN, inner] - patches[:, MARGIN - 1 : -MARGIN - 1, inner])
    gradients = np.stack([across, down], axis=-1).astype(np.float64)
    structure = np.einsum("nyxi,nyxj,yx->nij", gradients, gradients, window()) / contrast[:, None, None]
    noise = np.maximum(2 * (1 - correlations), 1e-4)[:, None, None]
    information = structure / (4 * noise) + np.eye(2) / _MAX_SHIFT**2
    covariances = np.linalg.inv(information)
    largest = np.linalg.eigvalsh(covariances)[:, -1:, None]
    return np.asarray(covariances + (_FLOOR**2 + largest) * np.eye(2))


def _testable(
    surface: SurfacePoints, camera: PhotographCamera, size_hw: tuple[int, int], *, step_rad: float
) -> NDArray[np.intp]:
    """Return the positions of the points that the photograph would see from the front, away from its border."""
    points = surface.points_in_world
    pixels, before = camera.project(points, size_hw)
    normals = surface.normals_in_cam @ surface.cam_from_world.rotation
    view = camera.cam_from_world.center - points
    distance = np.maximum(np.linalg.norm(view, axis=1), 1e-9)
    with np.errstate(invalid="ignore"):
        facing = (normals * view).sum(axis=1) > _MIN_COSINE * distance
        facing &= -(surface.normals_in_cam * surface.bearings).sum(axis=1) > _MIN_COSINE
    border = (SIZE / 2 * step_rad * surface.ranges / distance * camera.focal_px)[:, None]
    inside = ((pixels >= border) & (pixels < np.array(size_hw[::-1]) - border)).all(axis=1)
    return np.flatnonzero(before & facing & inside)


def _on_planes(surface: SurfacePoints, rays: FloatArray) -> FloatArray:
    """Return where rays (N, …, 3) in the panorama's frame meet the tangent planes of the points, in the world."""
    middle = (1, *[1] * (rays.ndim - 2))
    normals = surface.normals_in_cam.reshape(len(rays), *middle[1:], 3)
    heights = (surface.normals_in_cam * surface.bearings).sum(axis=1) * surface.ranges
    slopes = np.minimum((rays * normals).sum(axis=-1), -0.02)
    in_cam = rays * (heights.reshape(len(rays), *middle[1:]) / slopes)[..., None]
    world: FloatArray = surface.cam_from_world.inverse().apply(in_cam.reshape(-1, 3)).reshape(rays.shape)
    return world


def _photograph_patches(
    surface: SurfacePoints,
    axes: tuple[FloatArray, FloatArray],
    levels: Sequence[NDArray[np.float32]],
    *,
    camera: PhotographCamera,
    size_hw: tuple[int, int],
) -> tuple[NDArray[np.float32], FloatArray]:
    """Return the patches (N, 21, 21) of the photograph, each from the level with about its resolution.

    Also returns the derivatives of the pixel by the patch's columns and rows, (N, 2, 2).
    """
    half = (SIZE - 1) // 2 + MARGIN
    steps = np.arange(-half, half + 1.0)
    rays = (
        surface.bearings[:, None, None]
        + steps[None, None, :, None] * axes[0][:, None, None]
        + steps[None, :, None, None] * axes[1][:, None, None]
    )
    points = _on_planes(surface, rays)
    pixels = camera.project(points.reshape(-1, 3), size_hw)[0].reshape(*rays.shape[:-1], 2)
    across = pixels[:, half, half + 1] - pixels[:, half, half - 1]
    down = pixels[:, half + 1, half] - pixels[:, half - 1, half]
    jacobians = 0.5 * np.stack([across, down], axis=-1)
    sample_px = np.sqrt(np.abs(np.linalg.det(jacobians)))
    # The levels' pixels may differ in size from the camera's, if the photograph was reduced.
    own = size_hw[1] / levels[0].shape[1]
    level_of = np.clip(np.rint(np.log2(np.maximum(sample_px / own, 1e-6))), 0, len(levels) - 1).astype(np.intp)
    patches = np.zeros(rays.shape[:-1], np.float32)
    for level in np.unique(level_of):
        here = level_of == level
        scale = np.array(levels[level].shape[::-1]) / np.array(size_hw[::-1])
        at = (pixels[here] * scale - 0.5).astype(np.float32).reshape(int(here.sum()), -1, 2)
        sampled = cv2.remap(levels[level], at[..., 0], at[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
        patches[here] = sampled.reshape(-1, *patches.shape[1:])
    return patches, jacobians
