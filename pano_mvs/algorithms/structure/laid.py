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


@dataclass(frozen=True, eq=False)
class OtherView:
    """A view that planes are compared with.

    `range_map`: (H, W). `cam_from_world`: its pose. `picture`: (H, W, 3) RGB.
    """

    range_map: RangeMap
    cam_from_world: Rigid3
    picture: Picture


@dataclass(frozen=True, eq=False)
class Seen:
    """What another view shows at places, (h, w) each.

    `ratio`: its range there relative to the distance of the place; NaN where either is unknown. `confirmed`: whether
    that range is confirmed. `colors`: (h, w, 3), its colours.
    """

    ratio: FloatArray
    confirmed: Mask
    colors: FloatArray


def seen_by(view: OtherView, places: FloatArray) -> Seen:
    """Return what a view shows at places (h, w, 3) of the world; NaN is nowhere."""
    height, width = places.shape[:2]
    known = np.isfinite(places).all(axis=-1)
    in_view = view.cam_from_world.apply(places[known])
    distance = np.linalg.norm(in_view, axis=-1)
    rays = in_view / distance[:, None]
    row, column = pixels_containing(rays, view.range_map.range.shape)
    small = cv2.resize(view.picture, (width, height), interpolation=cv2.INTER_AREA)
    ratio, confirmed = np.full(known.shape, np.nan), np.zeros(known.shape, np.bool_)
    colors = np.full(places.shape, np.nan)
    ratio[known] = view.range_map.range[row, column] / distance
    confirmed[known] = view.range_map.confidence[row, column] >= CONSISTENT_CONFIDENCE[0]
    colors[known] = small[pixels_containing(rays, (height, width))]
    return Seen(ratio, confirmed, colors)


def laid_evidence(
    own: FloatArray, laid: FloatArray, *, picture: Picture, views: Sequence[Seen], error: float
) -> dict[str, FloatArray]:
    """Return what was measured of each pixel (h, w) that has a plane, NaN where it is not known.

    Args:
        own: range that the pixel has.
        laid: range on its plane.
        picture: (h, w, 3) RGB.
        views: what other views show at its place on the plane.
        error: relative, of ranges that agree.

    Returns:
        `nearer` (logarithm of the range on the plane relative to its own, which may be that of something before the
        plane), `clash` (least difference of its colour to views that confirm the plane there, in grey levels), and
        `unlike` (median difference to the views that confirm nothing nearer).
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        nearer = np.log(laid / own)
        gains = [_gain(picture, seen, near=np.abs(nearer) < error, error=error) for seen in views]
        different = [_difference(picture, seen, gain) for seen, gain in zip(views, gains, strict=True)]
        clash = [
            np.where(seen.confirmed & (np.abs(seen.ratio - 1) < error), difference, np.nan)
            for seen, difference in zip(views, different, strict=True)
        ]
        unlike = [
            np.where(seen.confirmed & (seen.ratio < 1 - error), np.nan, difference)
            for seen, difference in zip(views, different, strict=True)
        ]
    return {
        "nearer": np.maximum(nearer, 0.0),
        "clash": _ordered(clash, own.shape, share=0.0),
        "unlike": _ordered(unlike, own.shape, share=0.5),
    }


def _gain(picture: Picture, seen: Seen, *, near: Mask, error: float) -> FloatArray:
    """Return the ratio of the colours of a picture to those of another view, (3,), where both show one surface."""
    same = near & seen.confirmed & (np.abs(seen.ratio - 1) < error) & (seen.colors.min(axis=-1) > 8)
    if np.count_nonzero(same) < 100:
        return np.ones(3)
    return np.asarray(np.median(picture[same] / seen.colors[same], axis=0), np.float64)


def _difference(picture: Picture, seen: Seen, gain: FloatArray) -> FloatArray:
    return largest_channel(np.abs(picture - np.minimum(seen.colors * gain, 255.0)))


def _ordered(values: Sequence[FloatArray], shape: tuple[int, ...], *, share: float) -> FloatArray:
    """Return the value (h, w) that at most a share of the known ones lies below; NaN where there is none."""
    if not values:
        return np.full(shape, np.nan)
    ordered = np.sort(np.array(values), axis=0)  # NaN last
    last = np.isfinite(ordered).sum(axis=0) - 1
    at = np.floor(share * np.maximum(last, 0)).astype(np.intp)
    return np.asarray(np.take_along_axis(ordered, at[None], axis=0)[0], np.float64)
