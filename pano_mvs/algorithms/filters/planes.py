"""Lay planes through surfaces that show nothing to match: plain walls and ceilings.

On paint no window matches better than another, and what a sweep finds there is chance, now and then confirmed by other
views' chance. But such a surface is mostly flat, and its outline is seen well. So a plane is laid through the trusted
ranges of each connected, evenly coloured part of the picture and around it, if enough of them lie on one.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.filters.holes import large_holes
from pano_mvs.algorithms.filters.replacement import with_ranges
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import pad_panorama, pixel_solid_angle, ray_grid
from pano_mvs.scene import RangeMap
from pano_mvs.scene.range_map import CONSISTENT_CONFIDENCE, FILLED_CONFIDENCE

FloatArray = NDArray[np.float64]
Mask = NDArray[np.bool_]

_HYPOTHESES, _MAX_POINTS, _MIN_POINTS = 256, 3000, 30
# Colours change by less than this share from pixel to pixel within a surface.
_COLOR_STEP, _DARKEST = 0.02, 20.0
# Pixels without texture vote with this weight beside those of the outline.
_BARE_WEIGHT = 0.1
# The plane must be seen on most sides of the surface: carried on beyond what is seen it may lead anywhere.
_SECTORS, _MIN_SECTORS = 8, 6
_STEPS_BEYOND = 0.8, 1.3
# What was seen within this many tolerances of the plane was seen on it, only not well.
_SAME_SURFACE = 3.0


def lay_planes(
    range_map: RangeMap,
    guide: NDArray[np.uint8],
    *,
    rng: np.random.Generator,
    contrast: float = 8.0,
    min_area_deg2: float = 75.0,
    max_relative_error: float = 0.02,
    min_share: float = 0.25,
    min_confidence: int = CONSISTENT_CONFIDENCE[0],
    max_hole_deg: float = 20.0,
) -> RangeMap:
    """Return a range map with planes where the picture is plain.

    A plane is linear in the ray: 1 / r = a · F(u). For each connected part of the picture without contrast, a is found
    by RANSAC and least squares on the trusted pixels in it and within 2° around it, those with contrast counting ten
    times. It is believed if a share of `min_share` of them lies on it, on most sides of the part's middle, and all of
    the part comes to lie within their ranges, give or take a little. Then pixels of the part that are not on the plane
    are put there, with the confidence of filled pixels if they were far off; those that are on it keep what they have.

    Args:
        range_map: (H, W) with even W, the full sphere.
        guide: (H, W, 3) RGB picture.
        rng: draws the hypotheses.
        contrast: grey levels between the darkest and the brightest pixel around a pixel of a plain surface, at most.
        min_area_deg2: smaller parts are left as they are, in square degrees.
        max_relative_error: pixels on the plane differ from it by no more than this share.
        min_share: of the trusted pixels, by solid angle.
        min_confidence: of trusted pixels; 128 is consistent.
        max_hole_deg: holes that hold a disc of a larger diameter stay invalid (`large_holes`): a sky is no wall.

    Raises:
        UsageError: if guide and range map differ in size, or a limit is not positive.
    """
    height, width = range_map.range.shape
    if guide.shape != (height, width, 3) or guide.dtype != np.uint8:
        raise UsageError(f"the guide must be ({height}, {width}, 3) uint8 like the range map, got {guide.shape} "
                         f"{guide.dtype}")  # fmt: skip
    if not (contrast > 0 and min_area_deg2 > 0 and max_relative_error > 0 and 0 < min_share <= 1):
        raise UsageError("contrast, min_area_deg2 and max_relative_error must be positive, min_share in (0, 1]")
    labels, bare = plain_surfaces(guide, contrast)
    area = np.broadcast_to(pixel_solid_angle((height, width))[:, None], (height, width))
    trusted = range_map.valid & (range_map.confidence >= min_confidence)
    weight = np.where(bare, _BARE_WEIGHT, 1.0) * area
    margin = max(1, round(3 * height / 256))
    rays = ray_grid((height, width))
    inverse = 1 / range_map.range.astype(np.float64)
    open_sky = large_holes(range_map.valid, max_hole_deg)
    ranges, confidence = range_map.range.copy(), range_map.confidence.copy()
    for surface in _large_surfaces(labels, area * np.degrees(1) ** 2, min_area_deg2):
        support = _dilated(surface, margin) & trusted
        points = _drawn(support, weight, rng)
        if len(points) < _MIN_POINTS:
            continue
        plane, on_plane = fit_plane(
            rays[support][points], inverse[support][points], max_relative_error=max_relative_error, rng=rng
        )
        if on_plane.mean() < min_share or not _is_sound(
            plane, rays[surface], rays[support][points][on_plane], inverse[support][points][on_plane]
        ):
            continue
        laid = np.zeros_like(inverse)
        laid[surface] = rays[surface] @ plane
        with np.errstate(divide="ignore", invalid="ignore"):
            error = np.abs(inverse / laid - 1)
        off = surface & ~open_sky & ~(error <= max_relative_error)
        ranges[off] = 1 / laid[off]
        confidence[off & ~(error <= _SAME_SURFACE * max_relative_error)] = FILLED_CONFIDENCE[1]
    return with_ranges(range_map, ranges, confidence)


def plain_surfaces(guide: NDArray[np.uint8], contrast: float) -> tuple[NDArray[np.int64], Mask]:
    """Return the number of each pixel's plain part, (H, W), −1 for none, and which pixels have no contrast."""
    from pano_mvs.algorithms.filters.kernels_components import label_surfaces  # compiles on import

    radius = max(1, round(guide.shape[0] / 128))
    padded = pad_panorama(guide, 4 * radius).astype(np.float32)
    smooth = cv2.GaussianBlur(padded, (0, 0), 0.6 * radius)
    window = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
    spread = (cv2.dilate(smooth, window) - cv2.erode(smooth, window)).max(axis=-1)
    inner = slice(4 * radius, -4 * radius)
    bare: Mask = spread[inner, inner] < contrast
    luma = smooth[inner, inner].mean(axis=-1) + _DARKEST
    labels = label_surfaces(np.where(bare, luma, np.float32(np.nan)).astype(np.float32), _COLOR_STEP)
    return labels.reshape(bare.shape), bare


def fit_plane(
    rays: FloatArray, inverse: FloatArray, *, max_relative_error: float, rng: np.random.Generator
) -> tuple[FloatArray, Mask]:
    """Return the plane a (3,), 1 / r = a · ray, on which most points lie, and which do.

    Args:
        rays: (N, 3) unit rays, N ≥ 3.
        inverse: (N,) 1 / range along each.
        max_relative_error: largest |a · ray − 1 / r| · r of a point on the plane.
        rng: draws the triples.
    """
    triples = rng.integers(0, len(rays), (_HYPOTHESES, 3))
    bases = rays[triples]
    sound = np.abs(np.linalg.det(bases)) > 1e-6
    planes = np.linalg.solve(bases[sound], inverse[triples][sound][..., None])[..., 0]
    if not len(planes):
        return np.zeros(3), np.zeros(len(rays), np.bool_)
    # Relative residuals: a · (r ray) = 1 on the plane.
    points = rays / inverse[:, None]
    votes = (np.abs(points @ planes.T - 1) < max_relative_error).sum(axis=0)
    plane: FloatArray = planes[int(np.argmax(votes))]
    for _ in range(3):
        near = points[np.abs(points @ plane - 1) < max_relative_error]
        if len(near) >= 3:
            plane = np.asarray(np.linalg.lstsq(near, np.ones(len(near)), rcond=None)[0], np.float64)
    return plane, np.abs(points @ plane - 1) < max_relative_error


def _large_surfaces(labels: NDArray[np.int64], area: FloatArray, least: float) -> list[Mask]:
    """Return the parts that are large enough, largest first."""
    inside = labels >= 0
    sizes = np.bincount(labels[inside], area[inside], labels.size)
    large = np.flatnonzero(sizes >= least)
    return [labels == number for number in large[np.argsort(-sizes[large], kind="stable")]]


def _dilated(mask: Mask, margin: int) -> Mask:
    window = np.ones((2 * margin + 1, 2 * margin + 1), np.uint8)
    grown = cv2.dilate(pad_panorama(mask.astype(np.uint8), margin), window)[margin:-margin, margin:-margin]
    return np.asarray(grown > 0)


def _drawn(support: Mask, weight: FloatArray, rng: np.random.Generator) -> NDArray[np.intp]:
    """Return positions among the supporting pixels, drawn by their weights."""
    weights = weight[support]
    if len(weights) < _MIN_POINTS:
        return np.zeros(0, np.intp)
    return rng.choice(len(weights), _MAX_POINTS, p=weights / weights.sum())


def _is_sound(plane: FloatArray, surface: FloatArray, rays: FloatArray, inverse: FloatArray) -> bool:
    """Return whether a plane keeps within its points' ranges all over a surface, and is seen on most sides of it."""
    laid = surface @ plane
    low, high = _STEPS_BEYOND
    if len(rays) < _MIN_POINTS or laid.min() < low * inverse.min() or laid.max() > high * inverse.max():
        return False
    middle = surface.mean(axis=0)
    across = np.linalg.svd(middle[None])[2][1:]  # two directions at right angles to the middle
    angle = np.arctan2(*(rays @ across.T).T)
    sectors = np.floor((angle / (2 * np.pi) + 0.5) * _SECTORS).astype(np.int64) % _SECTORS
    return len(np.unique(sectors)) >= _MIN_SECTORS
