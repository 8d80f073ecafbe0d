"""Fit planes to surfaces without texture: plain walls and ceilings.

On uniform paint no window matches better than another, and the result of a sweep is random, sometimes confirmed by
chance in other views. But such a surface is mostly flat, and its outline is seen well. So a plane is fitted to the
reliable ranges in and around each connected, uniformly coloured part of the panorama, if enough of them lie on one.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Annotated

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.filters.data_term import MaxHoleDeg, require_guide
from pano_mvs.algorithms.filters.fill import large_holes
from pano_mvs.algorithms.filters.uncertainty import with_ranges
from pano_mvs.algorithms.panoramas import largest_channel, squarely_dilated
from pano_mvs.core.arrays import FloatArray, Mask
from pano_mvs.core.settings import Setting, checks_settings
from pano_mvs.geometry import pad_panorama, pixel_solid_angle, ray_grid
from pano_mvs.scene import RangeMap
from pano_mvs.scene.range_map import CONSISTENT_CONFIDENCE, FILLED_CONFIDENCE

_MIN_POINTS = 30


@checks_settings
def lay_planes(
    range_map: RangeMap,
    guide: NDArray[np.uint8],
    *,
    rng: np.random.Generator,
    contrast: Annotated[float, Setting("maximum contrast around a pixel of a plain surface, grey levels", gt=0)] = 8.0,
    min_area_deg2: Annotated[float, Setting("minimum area of a surface, in square degrees", gt=0)] = 75.0,
    max_relative_error: Annotated[float, Setting("maximum relative error of a pixel on the plane", gt=0)] = 0.02,
    min_share: Annotated[float, Setting("minimum share of reliable pixels on the plane", gt=0, le=1)] = 0.25,
    parallel_share: Annotated[
        float,
        Setting(
            "share of reliable pixels on a plane below which one parallel to a clear plane is preferred; 0: never",
            ge=0,
            le=1,
        ),
    ] = 0.35,
    min_confidence: Annotated[
        int, Setting("minimum confidence of reliable pixels", ge=1, le=255)
    ] = CONSISTENT_CONFIDENCE[0],
    max_hole_deg: MaxHoleDeg = 20.0,
) -> RangeMap:
    """Fit planes to the ranges of uniformly coloured surfaces.

    A plane is linear in the ray: 1 / r = a · F(u). For each connected part of the panorama without contrast, a is found
    by RANSAC and least squares on the reliable pixels in it and within 2° around it; pixels with contrast have ten
    times the weight. The plane is accepted if at least a share of `min_share` of these pixels lies on it, on most sides
    of the part's centre, and if the whole part is about within the range of their values. Pixels of the part that are
    not on the plane are then moved to it, with the confidence of filled pixels if they were far off; pixels on it are
    unchanged.

    If less than `parallel_share` of a part's reliable pixels lie on its plane, most of them match by chance, and so may
    the plane. Rooms have parallel surfaces: a plane parallel to that of another part, on which most reliable pixels
    lie, is taken instead if it fits nearly as many.

    Args:
        range_map: (H, W) with even W, the full sphere.
        guide: (H, W, 3) RGB panorama.
        rng: draws the hypotheses.

    Raises:
        UsageError: if guide and range map differ in size, or a setting is out of bounds.
    """
    require_guide(guide, range_map)
    rays = ray_grid((guide.shape[0], guide.shape[1]))
    fits = list(
        _plane_fits(
            range_map,
            guide,
            rng=rng,
            contrast=contrast,
            min_area_deg2=min_area_deg2,
            max_relative_error=max_relative_error,
            min_confidence=min_confidence,
        )
    )
    valid = [fit.is_valid(rays, min_share) for fit in fits]
    clear = [
        fit.plane / np.linalg.norm(fit.plane)
        for fit, is_valid in zip(fits, valid, strict=True)
        if is_valid and fit.share >= 0.8  # of the reliable pixels: a clear plane
    ]
    open_sky = large_holes(range_map.valid, max_hole_deg)
    ranges, confidence = range_map.range.copy(), range_map.confidence.copy()
    for fit, is_valid in zip(fits, valid, strict=True):
        chosen = fit
        if fit.share < parallel_share:
            # The best plane with a clear normal, unless the free fit holds clearly more pixels.
            found = [_plane_along(fit, normal, max_relative_error=max_relative_error) for normal in clear]
            best = max(found, key=lambda other: other.share, default=fit)
            # It replaces an unclear one if it has this share of its pixels.
            chosen = best if best.share >= 0.8 * fit.share else fit
        if not (is_valid if chosen is fit else chosen.is_valid(rays, min_share)):
            continue
        surface = fit.surface & ~open_sky
        laid = rays[surface] @ chosen.plane
        with np.errstate(divide="ignore", invalid="ignore"):
            error = np.abs(1 / range_map.range[surface].astype(np.float64) / laid - 1)
            ranges[surface] = np.where(error <= max_relative_error, ranges[surface], 1 / laid)
        # Ranges within this many tolerances of the plane belong to it, but are imprecise.
        far_off = ~(error <= 3.0 * max_relative_error)
        confidence[surface] = np.where(far_off, np.uint8(FILLED_CONFIDENCE[1]), confidence[surface])
    return with_ranges(range_map, ranges, confidence)


@dataclass(frozen=True, eq=False)
class _PlaneFit:
    """The plane of one plain part.

    `surface`: (H, W) its pixels. `rays`: (N, 3) of reliable pixels in and around it, drawn by weight. `inverse`: (N,)
    their 1 / range. `plane`: (3,), 1 / range = plane · ray. `on_plane`: (N,) which of the reliable pixels are on it.
    """

    surface: Mask
    rays: FloatArray
    inverse: FloatArray
    plane: FloatArray
    on_plane: Mask

    @property
    def share(self) -> float:
        """Share of the reliable pixels on the plane."""
        return float(self.on_plane.mean())

    def is_valid(self, rays: FloatArray, min_share: float) -> bool:
        """Return whether enough reliable pixels are on the plane, on most sides; `rays` are those of all pixels."""
        on = self.on_plane
        return self.share >= min_share and _is_valid(
            self.plane, rays[self.surface], self.rays[on], inverse=self.inverse[on]
        )


def _plane_fits(
    range_map: RangeMap,
    guide: NDArray[np.uint8],
    *,
    rng: np.random.Generator,
    contrast: float,
    min_area_deg2: float,
    max_relative_error: float,
    min_confidence: int,
) -> Iterator[_PlaneFit]:
    """Yield the best plane of each plain part that has enough reliable pixels, largest part first; see `lay_planes`."""
    height, width = range_map.range.shape
    labels, bare = plain_surfaces(guide, contrast)
    area = np.broadcast_to(pixel_solid_angle((height, width))[:, None], (height, width))
    trusted = range_map.valid & (range_map.confidence >= min_confidence)
    # Weight of pixels without texture relative to those of the outline.
    weight = np.where(bare, 0.1, 1.0) * area
    margin = max(1, round(3 * height / 256))
    rays, inverse = ray_grid((height, width)), 1 / range_map.range.astype(np.float64)
    inside = labels >= 0
    sizes = np.bincount(labels[inside], (area * np.degrees(1) ** 2)[inside], labels.size)
    large = np.flatnonzero(sizes >= min_area_deg2)
    for number in large[np.argsort(-sizes[large], kind="stable")]:
        surface = labels == number
        support = squarely_dilated(surface, margin) & trusted
        points = _drawn(support, weight, rng)
        if len(points) < _MIN_POINTS:
            continue
        around, seen = rays[support][points], inverse[support][points]
        plane, on_plane = fit_plane(around, seen, max_relative_error=max_relative_error, rng=rng)
        yield _PlaneFit(surface, around, seen, plane, on_plane)


def _plane_along(fit: _PlaneFit, normal: FloatArray, *, max_relative_error: float) -> _PlaneFit:
    """Return the plane with a normal, at the distance on which most reliable pixels agree; they face one side of it."""
    cosine = fit.rays @ normal
    if np.median(cosine) < 0:
        normal, cosine = -normal, -cosine
    # Pixels that see a parallel plane at a more grazing angle than this cosine say nothing about its distance.
    facing = cosine > 0.1
    if not facing.any():
        return replace(fit, on_plane=np.zeros_like(fit.on_plane))
    logs = np.sort(np.log(fit.inverse[facing] / cosine[facing]))
    stop = np.searchsorted(logs, logs + 2 * max_relative_error, side="right")
    first = int(np.argmax(stop - np.arange(len(logs))))
    plane = np.exp(np.median(logs[first : stop[first]])) * normal
    return replace(fit, plane=plane, on_plane=np.abs(fit.rays @ plane / fit.inverse - 1) < max_relative_error)


def plain_surfaces(guide: NDArray[np.uint8], contrast: float) -> tuple[NDArray[np.int64], Mask]:
    """Return the index of each pixel's plain part, (H, W), −1 for none, and which pixels have no contrast."""
    from pano_mvs.algorithms.filters.kernels_fill import label_surfaces  # compiles on import

    radius = max(1, round(guide.shape[0] / 128))
    padded = pad_panorama(guide, 4 * radius).astype(np.float32)
    smooth = cv2.GaussianBlur(padded, (0, 0), 0.6 * radius)
    window = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
    spread = largest_channel(cv2.dilate(smooth, window) - cv2.erode(smooth, window))
    inner = slice(4 * radius, -4 * radius)
    bare: Mask = spread[inner, inner] < contrast
    # Within a surface, colours change by less than this share from pixel to pixel.
    luma = smooth[inner, inner].mean(axis=-1) + 20.0
    labels = label_surfaces(np.where(bare, luma, np.float32(np.nan)).astype(np.float32), 0.02)
    return labels.reshape(bare.shape), bare


def fit_plane(
    rays: FloatArray, inverse: FloatArray, *, max_relative_error: float, rng: np.random.Generator
) -> tuple[FloatArray, Mask]:
    """Return the plane a (3,), 1 / r = a · ray, with most inliers, and the inliers.

    `rays`: (N, 3) unit rays, N ≥ 3. `inverse`: (N,) 1 / range along each. `max_relative_error`: largest |a · ray − 1 /
    r| · r of a point on the plane. `rng`: draws the triples.
    """
    triples = rng.integers(0, len(rays), (256, 3))
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


def _drawn(support: Mask, weight: FloatArray, rng: np.random.Generator) -> NDArray[np.intp]:
    """Return positions among the supporting pixels, drawn by weight."""
    weights = weight[support]
    if len(weights) < _MIN_POINTS:
        return np.zeros(0, np.intp)
    return rng.choice(len(weights), 3000, p=weights / weights.sum())


def _is_valid(plane: FloatArray, surface: FloatArray, rays: FloatArray, *, inverse: FloatArray) -> bool:
    """Return whether a plane stays within its points' ranges on the whole surface, and is seen on most sides of it."""
    laid = surface @ plane
    low, high = 0.8, 1.3
    if len(rays) < _MIN_POINTS or laid.min() < low * inverse.min() or laid.max() > high * inverse.max():
        return False
    middle = surface.mean(axis=0)
    across = np.linalg.svd(middle[None])[2][1:]  # two directions perpendicular to the middle
    angle = np.arctan2(*(rays @ across.T).T)
    # The plane must be seen on most of eight sides of the surface: extrapolation is unreliable.
    sectors = np.floor((angle / (2 * np.pi) + 0.5) * 8).astype(np.int64) % 8
    return len(np.unique(sectors)) >= 6
