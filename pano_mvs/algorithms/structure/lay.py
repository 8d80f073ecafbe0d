"""Lay the planes of a place into the range map of one view.

Each pixel gets one of the planes, or none (`labels`); pixels are moved to it where their own ranges are near it or not
confirmed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.filters.supported import has_texture
from pano_mvs.algorithms.filters.uncertainty import with_ranges
from pano_mvs.algorithms.structure.labels import plane_labels, share_of_enough
from pano_mvs.algorithms.structure.laid import OtherView, laid_evidence, seen_by
from pano_mvs.algorithms.structure.laid_coefficients import FITTED
from pano_mvs.algorithms.structure.matched import mismatch
from pano_mvs.algorithms.structure.mirrors import with_mirrors
from pano_mvs.algorithms.structure.outline import OUTLINE_UNCERTAINTY, room_labels, room_of
from pano_mvs.algorithms.structure.view import PlaneView, ScenePlane, grid_rows, on_grid, plane_ranges, plane_view
from pano_mvs.algorithms.structure.windows import window_labels
from pano_mvs.core.arrays import FloatArray, Mask, Picture
from pano_mvs.core.settings import Setting, checks_settings
from pano_mvs.geometry import Rigid3, pixel_solid_angle, ray_grid
from pano_mvs.scene import RangeMap
from pano_mvs.scene.range_map import CONSISTENT_CONFIDENCE, FILLED_CONFIDENCE, WEAK_CONFIDENCE, WINDOW_CONFIDENCE
from pano_mvs.scene.surfaces import Structure

LEAST_PROBABILITIES = 0.1, 0.5
"""A plane is laid from the first probability on where views confirm nothing, and from the second one where they confirm
half of the sphere and more: there, own ranges that are not confirmed are right more often (`share_of_enough`)."""

MAX_LAID_SOURCES = 4
"""More sources than this are not compared with planes."""


@checks_settings
def lay_structure(
    range_map: RangeMap,
    guide: Picture,
    structure: Structure,
    *,
    cam_from_world: Rigid3,
    sources: Sequence[OtherView],
    group: int = 0,
    valid: Mask | None = None,
    textured_error: Annotated[
        float,
        Setting(
            "relative error within which confirmed pixels with texture are moved; more if they are uncertain",
            gt=0,
            le=1,
        ),
    ] = 0.015,
    plain_error: Annotated[float, Setting("the same of pixels without texture", gt=0, le=1)] = 0.08,
) -> tuple[RangeMap, float]:
    """Move pixels to the planes of a place that they show.

    Nothing lies below the floor, the lowest level plane: what is not confirmed there, or has no range, is moved to it,
    unless the view confirms more pixels below that plane than on it.

    Args:
        range_map: (H, W) with even W, the full sphere.
        guide: (H, W, 3) RGB panorama.
        structure: planes in the world.
        cam_from_world: pose of the view.
        sources: other views; a pixel whose own range is off the plane is not moved where the fitted model
            (`laid_evidence`) holds that it shows something else.
        group: of the poses of the view.
        valid: (H, W) pixels that may have a range; None: all.

    Returns:
        The range map, and the share of the sphere that is on a plane. Pixels on a plane that were matched near it, and
        whose place another view confirms, are consistent (confidence 128 or more). For mirrors see `with_mirrors`.
    """
    found = proposed_planes(
        range_map,
        guide,
        structure,
        cam_from_world=cam_from_world,
        sources=sources,
        group=group,
        errors=(textured_error, plain_error),
    )
    size, planes, textured, tolerance = guide.shape[:2], found.planes, found.textured, found.tolerance
    other = found.off.copy()
    evidence = {name: values[found.off] for name, values in found.evidence.items()}
    least = np.interp(share_of_enough(range_map.confidence), (0.0, 1.0), LEAST_PROBABILITIES)
    other[found.off] = FITTED.probabilities(evidence) < least
    coarse = np.where(other, np.int16(-1), found.label)
    window = window_labels(found.view, coarse, found.known)
    label = _enlarged(np.where(window >= 0, window, coarse), size)
    agree = _enlarged(found.agree, size) > 0
    laid = _chosen(found.ranges_on, label)
    with np.errstate(invalid="ignore"):
        error = np.abs(range_map.range / laid - 1)
    matched, confirmed = (range_map.confidence >= least[0] for least in (WEAK_CONFIDENCE, CONSISTENT_CONFIDENCE))
    # Creases of single views confirm nothing, and correct nothing that is confirmed.
    alone = np.isin(label, np.flatnonzero(structure.uncertainties[planes] >= OUTLINE_UNCERTAINTY))
    near, agree = (error <= tolerance) & ~(alone & confirmed), agree & ~alone
    in_window = (_enlarged(window, size) >= 0) & ~(confirmed & (error > tolerance))
    unsure = np.where(textured, ~matched, ~confirmed) | (error <= found.explained) & ~(alone & confirmed) | found.sunk
    moved = np.isfinite(laid) & (near | unsure | in_window) & (True if valid is None else valid)
    kept = np.where(textured, range_map.confidence, np.minimum(range_map.confidence, np.uint8(WEAK_CONFIDENCE[1])))
    confidence = np.select(
        [in_window, near & matched & agree, near & matched, agree],
        [
            np.uint8(WINDOW_CONFIDENCE),
            np.maximum(range_map.confidence, np.uint8(CONSISTENT_CONFIDENCE[0])),
            kept,
            np.uint8(WEAK_CONFIDENCE[1]),
        ],
        np.uint8(FILLED_CONFIDENCE[1]),
    )
    result = with_ranges(
        range_map,
        np.where(moved, laid, range_map.range).astype(np.float32),
        np.where(moved, confidence, range_map.confidence),
    )
    moved &= result.valid
    result = _described(result, moved, structure, planes=planes, label=label, rotation=cam_from_world.rotation)
    return with_mirrors(result, structure, cam_from_world, group=group, valid=valid, laid=moved), float(
        (moved * pixel_solid_angle(size)[:, None]).sum() / (4 * np.pi)
    )


@dataclass(frozen=True, eq=False)
class Proposal:
    """The planes that the pixels of a view may show: (H, W), and (h, w) on the grid (`on_grid`).

    Attributes:
        view: what the search for planes reads of the view.
        planes: positions in the structure.
        known: the planes at these.
        ranges_on: returns the ranges (H, W) on one of them.
        textured: (H, W) whether the picture has texture.
        explained: (H, W) relative error of the own range that its uncertainty explains.
        tolerance: (H, W) largest relative error of an own range that is on its plane.
        sunk: (H, W) whether the pixel lies below the floor, or would.
        label: (h, w) position in `planes`; −1 for none.
        laid: (h, w) range on that plane; NaN without one.
        agree: (h, w) whether another view confirms a range on it.
        off: (h, w) whether the own range is not on the plane, or unknown.
        evidence: what was measured of each pixel (`laid_evidence`), (h, w) each.
    """

    view: PlaneView
    planes: NDArray[np.intp]
    known: list[ScenePlane]
    ranges_on: Callable[[int], FloatArray]
    textured: Mask
    explained: FloatArray
    tolerance: FloatArray
    sunk: Mask
    label: NDArray[np.int16]
    laid: FloatArray
    agree: Mask
    off: Mask
    evidence: dict[str, FloatArray]


def proposed_planes(
    range_map: RangeMap,
    guide: Picture,
    structure: Structure,
    *,
    cam_from_world: Rigid3,
    sources: Sequence[OtherView],
    group: int,
    errors: tuple[float, float],
) -> Proposal:
    """Return the plane of each pixel, and what speaks for it; the arguments are those of `lay_structure`."""
    textured_error, plain_error = errors
    planes = np.flatnonzero(structure.group_idx == group)
    size = range_map.range.shape[0], range_map.range.shape[1]
    rows = grid_rows(size[0])
    rays = ray_grid(size) @ cam_from_world.rotation
    textured = has_texture(guide)
    precise = textured & (range_map.confidence >= CONSISTENT_CONFIDENCE[0])
    # Ranges may be as far from their plane as their uncertainty explains.
    explained = np.full(size, textured_error)
    if range_map.uncertainty is not None:
        explained = np.maximum(3 * np.nan_to_num(range_map.uncertainty.astype(np.float64)), textured_error)
    tolerance = np.where(precise, np.minimum(explained, plain_error), plain_error)

    def ranges_on(number: int, some: FloatArray = rays) -> FloatArray:
        """Return the ranges of rays to a plane."""
        normal, offset = structure.normals_in_world[planes[number]], float(structure.offsets[planes[number]])
        return plane_ranges(some, cam_from_world.center, normal=normal, offset=offset)

    coarse_rays = on_grid(rays, rows)
    coarse_planes = [ranges_on(number, coarse_rays) for number in range(len(planes))]
    known = [
        ScenePlane(normal, float(structure.offsets[idx]), 1.0, uncertainty=1.0, is_level=abs(normal[1]) > 0.5)
        for idx, normal in zip(planes, structure.normals_in_world[planes], strict=True)
    ]
    view = plane_view(range_map, lambda: guide, cam_from_world)
    room = room_of(view, known)
    used = sources[:MAX_LAID_SOURCES]
    matched = mismatch(range_map, guide, structure, planes=planes, cam_from_world=cam_from_world, sources=used)
    label = plane_labels(
        coarse_planes,
        on_grid(range_map.range, rows),
        on_grid(range_map.confidence, rows),
        outlined=None if room is None else room_labels(room, coarse_rays, coarse_planes),
        matched=matched,
        textured=on_grid(textured, rows),
        tolerance=on_grid(tolerance, rows),
        guide=cv2.resize(guide, coarse_rays.shape[1::-1], interpolation=cv2.INTER_AREA),
    )
    sunk = np.zeros(size, np.bool_)
    floor = _floor(structure, planes)
    if floor is not None:
        sunk = _below(
            ranges_on(floor), range_map, error=plain_error, cosine=-rays @ structure.normals_in_world[planes[floor]]
        )
        label[on_grid(sunk, rows)] = floor
    laid = _chosen(coarse_planes.__getitem__, label)
    places = cam_from_world.center + coarse_rays * laid[..., None]
    views = [seen_by(view, places) for view in used]
    agree = np.zeros(laid.shape, np.bool_)
    for seen in views:
        with np.errstate(invalid="ignore"):
            agree |= seen.confirmed & (np.abs(seen.ratio - 1) < plain_error)
    own = on_grid(range_map.range, rows).astype(np.float64)
    colors = cv2.resize(guide, laid.shape[::-1], interpolation=cv2.INTER_AREA)
    with np.errstate(invalid="ignore"):
        off = np.isfinite(laid) & ~(np.abs(own / laid - 1) <= on_grid(tolerance, rows)) & ~on_grid(sunk, rows)
    own_places = cam_from_world.center + coarse_rays * own[..., None]
    at_own = [seen_by(view, own_places) for view in used]
    evidence = laid_evidence(own, laid, picture=colors, views=views, at_own=at_own, error=plain_error)
    return Proposal(
        view, planes, known, ranges_on, textured, explained, tolerance, sunk, label, laid, agree, off, evidence
    )


def _floor(structure: Structure, planes: NDArray[np.intp]) -> int | None:
    """Return the position in `planes` of the lowest one that is seen from above, in a world with y down."""
    level = [number for number, idx in enumerate(planes) if structure.normals_in_world[idx, 1] < -0.5]
    return max(level, key=lambda number: -float(structure.offsets[planes[number]]), default=None)


def _below(floor: FloatArray, range_map: RangeMap, *, error: float, cosine: FloatArray) -> Mask:
    """Return the pixels that are not confirmed below the floor, or have no range; none if more are confirmed there.

    `floor`: (H, W) ranges on it. `error`: relative, of a range on it. `cosine`: of the angle between ray and vertical.
    """
    # A floor that slopes by this angle must not be taken for the level one: nearer the horizon, nothing is moved up to
    # it.
    steep = np.isfinite(floor) & (cosine > np.radians(1.0) / error)
    with np.errstate(invalid="ignore"):
        on_it, below = np.abs(range_map.range / floor - 1) < error, ~(range_map.range <= floor * (1 + error))
    confirmed = range_map.confidence >= CONSISTENT_CONFIDENCE[0]
    area = pixel_solid_angle(floor.shape)[:, None]
    if (area * (steep & confirmed & below)).sum() > (area * (steep & confirmed & on_it)).sum():
        return np.zeros(floor.shape, np.bool_)
    return np.asarray(steep & below & ~confirmed)


def _chosen(ranges_on: Callable[[int], FloatArray], label: NDArray[np.int16]) -> FloatArray:
    """Return the range on each pixel's plane, NaN without one."""
    chosen = np.full(label.shape, np.nan)
    for number in np.unique(label[label >= 0]).tolist():
        here = label == number
        chosen[here] = ranges_on(number)[here]
    return chosen


def _described(
    range_map: RangeMap,
    moved: Mask,
    structure: Structure,
    *,
    planes: NDArray[np.intp],
    label: NDArray[np.int16],
    rotation: FloatArray,
) -> RangeMap:
    """Return the range map with the normals and the uncertainty of the planes where pixels are on one."""
    plane = planes[label[moved]]
    normals, uncertainty = range_map.normals_in_cam, range_map.uncertainty
    if normals is not None:
        normals = normals.copy()
        normals[moved] = (structure.normals_in_world[plane] @ rotation.T).astype(np.float16)
    if uncertainty is not None:
        uncertainty = uncertainty.copy()
        uncertainty[moved] = structure.uncertainties[plane].astype(np.float16)
    return replace(range_map, normals_in_cam=normals, uncertainty=uncertainty)


def _enlarged(pixels: NDArray[np.generic], size_hw: tuple[int, int]) -> NDArray[np.int16]:
    """Return pixels of the grid at full resolution."""
    return np.asarray(cv2.resize(pixels.astype(np.int16), size_hw[::-1], interpolation=cv2.INTER_NEAREST), np.int16)
