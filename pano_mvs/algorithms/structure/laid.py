"""What speaks for and against a plane that was laid into the pixels of a view."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from pano_mvs.algorithms.panoramas import largest_channel
from pano_mvs.algorithms.ranges.agreement import pixels_containing
from pano_mvs.core.arrays import FloatArray, Mask, Picture
from pano_mvs.geometry import Rigid3
from pano_mvs.scene import RangeMap
from pano_mvs.scene.range_map import CONSISTENT_CONFIDENCE

# Share of a cell of the grid that is not masked.
_SHOWN = 0.999
# Relative difference of ranges of two views that are one place.
_SHARED = 0.03


@dataclass(frozen=True, eq=False)
class OtherView:
    """A view that planes are compared with.

    `range_map`: (H, W). `cam_from_world`: its pose. `picture`: (H, W, 3) RGB. `valid`: (H, W) where it shows the place;
    None: everywhere.
    """

    range_map: RangeMap
    cam_from_world: Rigid3
    picture: Picture
    valid: Mask | None = None


@dataclass(frozen=True, eq=False)
class Seen:
    """What another view shows at places, (h, w) each.

    `ratio`: its range there relative to the distance of the place; NaN where either is unknown. `confirmed`: whether
    that range is confirmed. `uncertainty`: relative standard deviation of that range; NaN where unknown. `colors`:
    (h, w, 3), its colours, NaN where it is masked.
    """

    ratio: FloatArray
    confirmed: Mask
    uncertainty: FloatArray
    colors: FloatArray


def seen_by(view: OtherView, places: FloatArray) -> Seen:
    """Return what a view shows at places (h, w, 3) of the world; NaN is nowhere."""
    height, width = places.shape[:2]
    known = np.isfinite(places).all(axis=-1)
    in_view = view.cam_from_world.apply(places[known])
    distance = np.linalg.norm(in_view, axis=-1)
    rays = in_view / distance[:, None]
    row, column = pixels_containing(rays, view.range_map.range.shape)
    small = cv2.resize(view.picture, (width, height), interpolation=cv2.INTER_AREA).astype(np.float64)
    if view.valid is not None:
        shown = cv2.resize(view.valid.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
        small[shown < _SHOWN] = np.nan
    ratio, uncertainty, confirmed = *np.full((2, *known.shape), np.nan), np.zeros(known.shape, np.bool_)
    colors = np.full(places.shape, np.nan)
    ratio[known] = view.range_map.range[row, column] / distance
    confirmed[known] = view.range_map.confidence[row, column] >= CONSISTENT_CONFIDENCE[0]
    if view.range_map.uncertainty is not None:
        uncertainty[known] = view.range_map.uncertainty[row, column]
    colors[known] = small[pixels_containing(rays, (height, width))]
    return Seen(ratio, confirmed, uncertainty, colors)


def laid_evidence(
    own: FloatArray,
    laid: FloatArray,
    *,
    picture: Picture,
    views: Sequence[Seen],
    at_own: Sequence[Seen],
    error: float,
) -> dict[str, FloatArray]:
    """Return what was measured of each pixel (h, w) that has a plane, NaN where it is not known.

    Args:
        own: range that the pixel has.
        laid: range on its plane.
        picture: (h, w, 3) RGB.
        views: what other views show at its place on the plane.
        at_own: what they show at the place of its own range.
        error: relative, of ranges that agree.

    Returns:
        `nearer` (logarithm of the range on the plane relative to its own, which may be that of something before the
        plane), `unlike` (median difference of its colour, in grey levels, to the views whose own ranges are not nearer
        than the place), `shared` (number of views that have a range at its own place), and `through` (sum over the
        views whose confirmed ranges lie behind the place, of the logarithm of 1 + how many standard deviations).
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        nearer = np.log(laid / own)
        gains = [_gain(picture, seen, near=np.abs(nearer) < error, error=error) for seen in views]
        different = [_difference(picture, seen, gain) for seen, gain in zip(views, gains, strict=True)]
        unlike = [
            np.where(seen.ratio < 1 - error, np.nan, difference)
            for seen, difference in zip(views, different, strict=True)
        ]
    return {
        "nearer": np.maximum(nearer, 0.0),
        "unlike": _median(unlike, own.shape),
        "shared": np.sum([np.zeros(own.shape), *(np.abs(seen.ratio - 1) < _SHARED for seen in at_own)], axis=0),
        "through": np.sum([np.zeros(own.shape), *(_through(seen, error) for seen in views)], axis=0),
    }


def _through(seen: Seen, error: float) -> FloatArray:
    with np.errstate(invalid="ignore", divide="ignore"):
        behind = seen.confirmed & (seen.ratio > 1 + error)
        # Ranges without a standard deviation agree within the error. The least one is about a thousandth.
        std = np.fmax(np.where(np.isnan(seen.uncertainty), error, seen.uncertainty), 1e-3)
        return np.where(behind, np.log1p(np.log(seen.ratio) / std), 0.0)


def _gain(picture: Picture, seen: Seen, *, near: Mask, error: float) -> FloatArray:
    """Return the ratio of the colours of a picture to those of another view, (3,), where both show one surface."""
    same = near & seen.confirmed & (np.abs(seen.ratio - 1) < error) & (seen.colors.min(axis=-1) > 8)
    if np.count_nonzero(same) < 100:
        return np.ones(3)
    return np.asarray(np.median(picture[same] / seen.colors[same], axis=0), np.float64)


def _difference(picture: Picture, seen: Seen, gain: FloatArray) -> FloatArray:
    return largest_channel(np.abs(picture - np.minimum(seen.colors * gain, 255.0)))


def _median(values: Sequence[FloatArray], shape: tuple[int, ...]) -> FloatArray:
    """Return the lower median (h, w) of the known values; NaN where there is none."""
    if not values:
        return np.full(shape, np.nan)
    ordered = np.sort(np.array(values), axis=0)  # NaN last
    middle = np.maximum(np.isfinite(ordered).sum(axis=0) - 1, 0) // 2
    return np.asarray(np.take_along_axis(ordered, middle[None], axis=0)[0], np.float64)
