"""SPHORB: corners and binary descriptors on a geodesic grid, unaffected by the seam and the poles.

Zhao, Feng, Wan, Zhang: "SPHORB: A Fast and Robust Binary Feature on the Sphere", IJCV 113, 2015: a pyramid of geodesic
    grids, a FAST segment test on the grid's rings, an orientation by the intensity centroid, and rotated binary tests
    (Rublee et al., "ORB", 2011). Beyond the paper, corners are located between the cells, at the peak of the Harris
    response, and patches are defined in the tangent plane, so that they are alike on all parts of a face.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property, lru_cache
from typing import Annotated

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from pano_mvs.algorithms.faces.layout import face_corners
from pano_mvs.algorithms.features.selection import MaxKeypoints, distinct_keypoints, spread_keypoints
from pano_mvs.algorithms.ranges.agreement import pixels_containing
from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.errors import UsageError
from pano_mvs.core.settings import Setting, checks_settings
from pano_mvs.geometry import pad_panorama
from pano_mvs.geometry.positions import positions_in_padded
from pano_mvs.scene import Features

_PAD_PX = 4
# Lattice steps (u, v) to the six neighbours, counter-clockwise; the axes include 60°.
NEIGHBOURS = np.array([[1, 0], [0, 1], [-1, 1], [-1, 0], [0, -1], [1, -1]])


@dataclass(frozen=True)
class GeodesicGrid:
    """Twenty overlapping triangular lattices that cover the sphere in nearly equal hexagonal cells.

    Every face of an icosahedron is divided into a lattice, so that each cell has six neighbours at fixed steps (Zhao
    et al., section 3). The usual grid is irregular at the twelve corners of the icosahedron and bends at its edges.
    Here every lattice continues smoothly beyond its face instead, by the size of a neighbourhood, so that no cell of a
    face has an irregular neighbourhood; a face owns the cells inside it.

    A position is a face and lattice coordinates (u, v), with u, v >= 0 and u + v <= steps inside the face; cell (u, v)
    of face f is element [f, v + margin, u + margin] of an array (20, side, side).
    """

    steps: int  # number of lattice steps along an edge
    margin: int  # number of cells by which each lattice extends beyond its face

    @property
    def side(self) -> int:
        """Number of cells along either axis of a face's array."""
        return self.steps + 1 + 2 * self.margin

    @property
    def spacing_rad(self) -> float:
        """Mean angle between neighbouring cells, that of 10 n² hexagons covering the sphere."""
        return float(np.sqrt(4 * np.pi / (10 * self.steps**2) * 2 / np.sqrt(3)))

    @cached_property
    def ring_offsets(self) -> NDArray[np.int64]:
        """Offsets in a flat face array of the 18 cells at three steps, in order around the centre."""
        return self.flat_offsets(hexagon_ring(3))

    def flat_offsets(self, cells_uv: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the offsets of lattice steps (..., 2) in a flat face array."""
        offsets: NDArray[np.int64] = cells_uv[..., 1] * self.side + cells_uv[..., 0]
        return offsets

    def bearings(self, face_idx: NDArray[np.integer], places_uv: FloatArray) -> FloatArray:
        """Return the unit bearings (N, 3) of positions (N, 2) on faces (N,), in the camera frame.

        With barycentric coordinates b of the lattice, the direction is Σ sin(b_k θ) V_k over the face's corners, where
        θ is the angle of an edge. Along an edge this is the great circle at constant speed.
        """
        rays = np.einsum("nk,nkj->nj", self._weights(places_uv), face_corners()[face_idx])
        unit: FloatArray = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
        return unit

    def lattice_from_tangent(self, face_idx: NDArray[np.integer], places_uv: FloatArray) -> FloatArray:
        """Return (N, 2, 2), from a small tangent-plane step in units of `spacing_rad` to lattice steps.

        The tangent plane's axes are the lattice's u axis e and bearing × e, right-handed on every face.
        """
        bearing = self.bearings(face_idx, places_uv)
        steps = [
            self.bearings(face_idx, places_uv + half) - self.bearings(face_idx, places_uv - half)
            for half in (np.array([0.5, 0.0]), np.array([0.0, 0.5]))
        ]
        first = steps[0] - np.sum(steps[0] * bearing, axis=1, keepdims=True) * bearing
        first /= np.linalg.norm(first, axis=1, keepdims=True)
        axes = np.stack([first, np.cross(bearing, first)], axis=1)
        tangent_from_lattice = axes @ np.stack(steps, axis=2) / self.spacing_rad
        return np.asarray(np.linalg.inv(tangent_from_lattice), np.float64)

    def sample(self, panorama: NDArray[np.uint8], *, interpolation: int = cv2.INTER_CUBIC) -> NDArray[np.uint8]:
        """Return a panorama (H, W) uint8 sampled at all cells, (20, side, side), across seam and poles."""
        height, width = panorama.shape
        first_map, second_map = _sampling_maps(self, (height, width))
        padded = pad_panorama(panorama, _PAD_PX)
        sampled = cv2.remap(padded, first_map, second_map, interpolation)
        return np.asarray(sampled, np.uint8).reshape(20, self.side, self.side)

    def _weights(self, places_uv: FloatArray) -> FloatArray:
        u, v = places_uv[..., 0] / self.steps, places_uv[..., 1] / self.steps
        # Neighbouring corners of an icosahedron are arctan(2) apart.
        return np.sin(float(np.arctan(2.0)) * np.stack([1 - u - v, u, v], axis=-1)).astype(np.float64)


def hexagon_ring(radius: int) -> NDArray[np.int64]:
    """Return the lattice steps (6 radius, 2) to the cells at distance `radius`, in order around the centre."""
    sides = [radius * NEIGHBOURS[k] + step * NEIGHBOURS[(k + 2) % 6] for k in range(6) for step in range(radius)]
    return np.array(sides, np.int64)


def plane_from_lattice(cells_uv: NDArray[np.generic]) -> FloatArray:
    """Return lattice steps (..., 2) as steps in the plane of the undistorted lattice, neighbours at distance 1."""
    plane: FloatArray = cells_uv @ np.array([[1.0, 0.0], [0.5, np.sqrt(0.75)]])
    return plane


@lru_cache(maxsize=16)
def _sampling_maps(grid: GeodesicGrid, size_hw: tuple[int, int]) -> tuple[NDArray[np.int16], NDArray[np.uint16]]:
    """Return the position of every cell in a padded panorama, in OpenCV's fixed-point form (1/32 pixel)."""
    steps = np.arange(-grid.margin, grid.steps + grid.margin + 1, dtype=np.float64)
    v, u = np.meshgrid(steps, steps, indexing="ij")
    weights = grid._weights(np.stack([u, v], axis=-1))
    maps = []
    for corners in face_corners():
        maps.append(positions_in_padded(weights @ corners, size_hw, _PAD_PX))
    stacked = np.concatenate(maps)
    first_map, second_map = cv2.convertMaps(stacked, None, cv2.CV_16SC2)
    first_map.setflags(write=False)
    second_map.setflags(write=False)
    return first_map, second_map


_SCALE = 1.2
_PATCH_RADIUS = 15  # number of cells from the centre to the farthest test
_TESTS = 256
_MARGIN = 32  # at least _CLEARANCE lattice steps, stretched by 1.42, starting 5 cells beyond a face
_CLEARANCE = 18  # number of cells around a corner that must not be masked: its patch, and the support of the smoothing
_PATCH_SIGMA = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class _Corners:
    """Corners of one level: faces (N,), lattice positions (N, 2), unit bearings (N, 3), and responses (N,)."""

    faces: NDArray[np.int64]
    places_uv: FloatArray
    bearings: FloatArray
    responses: NDArray[np.float32]

    def __getitem__(self, keep: NDArray[np.generic]) -> _Corners:
        return _Corners(self.faces[keep], self.places_uv[keep], self.bearings[keep], self.responses[keep])


@checks_settings
def extract_sphorb(
    image: NDArray[np.uint8],
    mask: NDArray[np.bool_],
    *,
    max_keypoints: MaxKeypoints = 10_000,
    fast_threshold: Annotated[int, Setting("lower values find more key points on plain walls", ge=1, le=254)] = 5,
    levels: int = 7,
) -> Features:
    """Extract the SPHORB key points of a panorama.

    Args:
        image: (H, W, 3) uint8 RGB, the full sphere.
        mask: (H, W) bool; no key point's patch reaches a False pixel.
        max_keypoints: maximum number of key points, spread evenly over the sphere.
        fast_threshold: minimum brightness difference of a corner in the segment test.
        levels: number of pyramid levels; cells grow by a factor of 1.2 from each to the next.

    Returns:
        Features with descriptors (N, 32) uint8, compared by Hamming distance.

    Raises:
        UsageError: if the shapes of image and mask do not match.
    """
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or mask.shape != image.shape[:2]:
        raise UsageError(
            f"features need an (H, W, 3) uint8 image and an (H, W) mask, got {image.shape} {image.dtype} and "
            f"{mask.shape}"
        )
    gray: NDArray[np.uint8] = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    grids = grid_pyramid(image.shape[1], levels)
    scales = np.array([grids[0].steps / grid.steps for grid in grids])
    # Standard deviations in cells: of the smoothing required by larger cells, and of the smoothing for stable corners.
    sigmas_px = np.sqrt(0.5**2 * (scales**2 - 1) + (0.65 * scales) ** 2)
    pictures = [grid.sample(smoothed) for grid, smoothed in zip(grids, smooth_panorama(gray, sigmas_px), strict=True)]
    found = [_detect(p, g, threshold=fast_threshold) for p, g in zip(pictures, grids, strict=True)]
    if not mask.all():
        found = [_unmasked(f, g, mask) for f, g in zip(found, grids, strict=True)]
    pixel_rad = 2 * np.pi / image.shape[1]
    chosen = _chosen(found, max_keypoints=max_keypoints, radius_rad=0.5 * pixel_rad)
    described = [_describe(p, g, c) for p, g, c in zip(pictures, grids, chosen, strict=True)]
    sizes = np.concatenate(
        [
            np.full(len(c.faces), 2 * _PATCH_RADIUS * g.spacing_rad, np.float32)
            for g, c in zip(grids, chosen, strict=True)
        ]
    )
    return _record(image, chosen, np.concatenate(described), sizes_rad=sizes)


def grid_pyramid(width: int, levels: int) -> list[GeodesicGrid]:
    """Return geodesic grids for a panorama: cells of one pixel's area at the equator, then 1.2 times wider each."""
    finest = width / np.sqrt(10 * np.pi)
    steps = [max(24, round(finest / _SCALE**level)) for level in range(levels)]
    return [GeodesicGrid(n, _MARGIN) for n in dict.fromkeys(steps)]


def _detect(pictures: NDArray[np.uint8], grid: GeodesicGrid, *, threshold: int) -> _Corners:
    from pano_mvs.algorithms.features import kernels_sphorb as kernels

    scores = np.zeros_like(pictures)
    neighbours = grid.flat_offsets(NEIGHBOURS)
    # A corner on the common edge of two faces is found by both, so that it is not missed by both.
    kernels.score_corners(pictures, grid.ring_offsets, grid.margin, 2, threshold, scores)
    cells = np.empty((np.count_nonzero(scores), 3), np.int64)
    cells = cells[: kernels.local_maxima(scores, neighbours, grid.margin, 1, cells)]
    window, weights = _harris_window()
    places, responses = np.empty((len(cells), 2)), np.empty(len(cells))
    kernels.refine_corners(
        pictures, cells, grid.flat_offsets(window), weights, neighbours, grid.margin, places, responses
    )
    faces = cells[:, 0]
    corners = _Corners(faces, places, grid.bearings(faces, places), responses.astype(np.float32))
    corners = corners[responses > 0]
    return corners[distinct_keypoints(corners.bearings, corners.responses, radius_rad=grid.spacing_rad)]


def _unmasked(corners: _Corners, grid: GeodesicGrid, mask: NDArray[np.bool_]) -> _Corners:
    """Keep corners without masked cells around them."""
    from pano_mvs.algorithms.features import kernels_sphorb as kernels

    valid = grid.sample(mask.astype(np.uint8), interpolation=cv2.INTER_NEAREST)
    clear = np.empty(len(corners.faces), np.bool_)
    turns = grid.lattice_from_tangent(corners.faces, corners.places_uv)
    kernels.disc_is_clear(valid, corners.faces, corners.places_uv, turns, lattice_disc(_CLEARANCE), grid.margin, clear)
    return corners[clear]


def _chosen(found: list[_Corners], *, max_keypoints: int, radius_rad: float) -> list[_Corners]:
    """Return the corners to keep of each level, spread over the sphere; coarse levels get fewer, as in ORB."""
    found = _distinct(found, radius_rad=radius_rad)
    shares = _SCALE ** -np.arange(len(found), dtype=np.float64)
    chosen: list[_Corners] = []
    room = max_keypoints
    for level in reversed(range(len(found))):
        quota = round(room * shares[level] / shares[: level + 1].sum())
        corners = found[level]
        chosen.insert(0, corners[spread_keypoints(corners.bearings, corners.responses, max_keypoints=quota)])
        room -= len(chosen[0].faces)
    return chosen


def _distinct(found: list[_Corners], *, radius_rad: float) -> list[_Corners]:
    """Keep the strongest of the corners that several levels found at the same position."""
    bearings, responses = (np.concatenate([getattr(c, name) for c in found]) for name in ("bearings", "responses"))
    kept = np.zeros(len(bearings), np.bool_)
    kept[distinct_keypoints(bearings, responses, radius_rad=radius_rad)] = True
    ends = np.cumsum([len(c.faces) for c in found])
    return [c[part] for c, part in zip(found, np.split(kept, ends[:-1]), strict=True)]


def _describe(pictures: NDArray[np.uint8], grid: GeodesicGrid, corners: _Corners) -> NDArray[np.uint8]:
    from pano_mvs.algorithms.features import kernels_sphorb as kernels

    side = grid.side
    smoothed = np.stack([cv2.filter2D(p, -1, _smoothing_kernel()) for p in pictures]).reshape(20, side, side)
    turns = grid.lattice_from_tangent(corners.faces, corners.places_uv)
    angles, bits = np.empty(len(corners.faces)), np.empty((len(corners.faces), _TESTS // 8), np.uint8)
    disc = lattice_disc(_PATCH_RADIUS)
    kernels.describe_corners(
        smoothed, corners.faces, corners.places_uv, turns, disc, binary_tests(), grid.margin, angles, bits
    )
    return bits


def _record(
    image: NDArray[np.uint8], chosen: list[_Corners], descriptors: NDArray[np.uint8], *, sizes_rad: NDArray[np.float32]
) -> Features:
    bearings = np.concatenate([c.bearings for c in chosen])
    scores = np.concatenate([c.responses for c in chosen])
    order = np.argsort(-scores, kind="stable")
    return Features(
        bearings=bearings[order],
        descriptors=descriptors[order],
        sizes_rad=sizes_rad[order],
        scores=scores[order],
        colors_rgb=image[pixels_containing(bearings[order], image.shape[:2])],
        metric="hamming",
        size_hw=(image.shape[0], image.shape[1]),
    )


@cache
def binary_tests() -> FloatArray:
    """Return the positions (256, 4) of the binary tests in the tangent plane, in cells, within the patch's radius.

    Both positions of a test are drawn from one Gaussian around the corner (Calonder et al., "BRIEF", 2010, layout II).
    """
    rng = np.random.default_rng(0x5B)
    kept: list[FloatArray] = []
    while len(kept) < _TESTS:
        pair = rng.normal(scale=_PATCH_RADIUS / 2.5, size=(2, 2))
        if np.all(np.hypot(*pair.T) <= _PATCH_RADIUS) and np.hypot(*(pair[0] - pair[1])) > 2:
            kept.append(pair.ravel())
    return np.array(kept)


@cache
def lattice_disc(radius: int) -> FloatArray:
    """Return a hexagonal lattice of steps (K, 2) within a radius in the tangent plane."""
    cells = np.stack(np.meshgrid(*[np.arange(-2 * radius, 2 * radius + 1)] * 2), axis=-1).reshape(-1, 2)
    plane = plane_from_lattice(cells)
    return plane[np.hypot(plane[:, 0], plane[:, 1]) <= radius]


@cache
def _harris_window() -> tuple[NDArray[np.int64], FloatArray]:
    rings = [np.zeros((1, 2), np.int64), *(hexagon_ring(r) for r in range(1, 3))]
    window = np.concatenate(rings)
    squared = np.sum(plane_from_lattice(window) ** 2, axis=1)
    return window, np.exp(-0.5 * squared) / 255**2


@cache
def _smoothing_kernel() -> FloatArray:
    """Return a Gaussian on the lattice, to be applied to a face's array."""
    reach = int(np.ceil(2 * _PATCH_SIGMA))
    v, u = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    kernel: FloatArray = np.exp(-0.5 * (u**2 + u * v + v**2) / _PATCH_SIGMA**2)
    kernel[u**2 + u * v + v**2 > reach**2] = 0
    kernel /= kernel.sum()
    return kernel


def smooth_panorama(panorama: NDArray[np.uint8], sigmas_px: FloatArray) -> list[NDArray[np.uint8]]:
    """Smooth a panorama by Gaussians, with one result for each width.

    Rows are smoothed by 1 / cos φ times as many pixels as columns. Towards the poles, the pixels of a row are narrower
    than at the equator; the additional sharpness along the row is removed as well, so that noise and detail are
    isotropic. Only within about two standard deviations of a pole is the smoothing weaker, because the rows are such
    small circles there.

    Args:
        panorama: (H, W) uint8, the full sphere.
        sigmas_px: (S,) standard deviations in pixels at the equator, not negative.

    Returns:
        S arrays (H, W) uint8.
    """
    height, width = panorama.shape
    spectrum = scipy.fft.rfft(panorama.astype(np.float32), axis=1)
    elevation = np.pi * (0.5 - (np.arange(height) + 0.5) / height)
    frequency = np.arange(spectrum.shape[1]) * (2 * np.pi / width)
    cosine = np.cos(elevation)[:, None]
    smoothed = []
    for sigma_px in sigmas_px:
        pixel_std = np.sqrt(1 / 12)  # of a box one pixel wide
        spread = (sigma_px**2 + (pixel_std * np.sin(elevation[:, None])) ** 2) / cosine**2
        decay = np.exp(-0.5 * spread * frequency**2).astype(np.float32)
        rows = scipy.fft.irfft(spectrum * decay, n=width, axis=1)
        smoothed.append(np.rint(_smooth_columns(rows, float(sigma_px))).clip(0, 255).astype(np.uint8))
    return smoothed


def _smooth_columns(panorama: NDArray[np.float32], sigma_px: float) -> NDArray[np.float32]:
    reach = min(int(np.ceil(4 * sigma_px)), *panorama.shape)
    if reach == 0:
        return panorama
    kernel = cv2.getGaussianKernel(2 * reach + 1, sigma_px)
    padded = pad_panorama(panorama, reach)
    smoothed = cv2.sepFilter2D(padded, -1, np.ones(1), kernel)
    return np.asarray(smoothed[reach:-reach, reach:-reach], np.float32)
