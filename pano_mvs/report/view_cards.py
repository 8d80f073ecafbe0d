"""The views that the page shows in full: panorama, range and confidence, stacked."""

from __future__ import annotations

import zlib
from collections.abc import Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import astuple, dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.panoramas import narrowed
from pano_mvs.core.errors import InputError
from pano_mvs.io.images.preview import color_mapped, mark_unconfirmed, range_limits, scale_ticks
from pano_mvs.report.earlier_page import EarlierPage
from pano_mvs.results.pictures import Picture, evenly_spaced, picture, preview_panels, resized
from pano_mvs.results.records import ViewSummary
from pano_mvs.results.stored_values import StoredValues
from pano_mvs.scene import RangeMap
from pano_mvs.scene.range_map import (
    CONSISTENT_CONFIDENCE,
    FILLED_CONFIDENCE,
    MIRROR_CONFIDENCE,
    WEAK_CONFIDENCE,
    WINDOW_CONFIDENCE,
)


@dataclass(frozen=True)
class Shares:
    """Shares of the sphere, which sum to 1."""

    consistent: float  # other views agree (confidence 128–255)
    weak: float  # seen, but not confirmed (64–127)
    filled: float  # interpolated, not seen (3–63), or at the pane of a mirror or window (1, 2)
    invalid: float  # no range
    masked: float  # excluded by a mask, or sky

    @property
    def complete(self) -> float:
        """The share of the unmasked sphere that has a range; 0 if all is masked."""
        return min(1.0, (self.consistent + self.weak + self.filled) / max(1e-9, 1 - self.masked))

    @property
    def confirmed(self) -> float:
        """The share of the unmasked sphere on which other views agree."""
        return min(1.0, self.consistent / max(1e-9, 1 - self.masked))


def shares_of(confidence: NDArray[np.uint8], mask: NDArray[np.bool_] | None = None) -> Shares:
    """Return the shares of a view by the solid angle of its pixels; large maps are sampled."""
    step = max(1, confidence.shape[0] // 256)
    sampled = np.asarray(confidence[step // 2 :: step, step // 2 :: step])
    height, width = sampled.shape
    elevation_rad = np.pi * (0.5 - (np.arange(height) + 0.5) / height)
    weights = np.repeat(np.cos(elevation_rad)[:, None], width, axis=1)
    weights /= weights.sum()
    kept = np.ones(sampled.shape, bool) if mask is None else mask[step // 2 :: step, step // 2 :: step]
    classes = np.digitize(sampled, [MIRROR_CONFIDENCE, WEAK_CONFIDENCE[0], CONSISTENT_CONFIDENCE[0]])
    classes[(classes == 0) & ~kept] = 4
    invalid, filled, weak, consistent, masked = np.bincount(classes.ravel(), weights.ravel(), minlength=5)
    return Shares(*(round(float(share), 6) for share in (consistent, weak, filled, invalid, masked)))


# Relative standard deviations from this one (dark) to this one (bright), on a logarithmic scale.
UNCERTAINTY_LIMITS = 0.001, 0.2
# Colours of the low and high end of each class, distinguishable for colour-blind readers and in grey.
_CLASSES = (
    ((MIRROR_CONFIDENCE, WINDOW_CONFIDENCE), (60, 60, 160), (60, 60, 160)),
    (FILLED_CONFIDENCE, (150, 95, 160), (196, 140, 204)),
    (WEAK_CONFIDENCE, (200, 130, 20), (245, 180, 60)),
    (CONSISTENT_CONFIDENCE, (10, 90, 110), (60, 190, 190)),
)
_INVALID = (96, 96, 96)


Ticks = tuple[tuple[float, float], ...]
Limits = tuple[float, float]


@dataclass(frozen=True)
class RangeScales:
    """The nearest and the farthest range of the colour scales of a view."""

    common: Limits  # of all views of its group
    own: Limits | None  # of this view; None if it has no ranges

    @property
    def differ(self) -> bool:
        """Whether the view looks different on its own scale."""
        ratios = [a / b for a, b in zip(self.common, self.own or self.common, strict=True)]
        # A view has a scale of its own only if an end of it differs from the common scale by more than this factor.
        return any(max(ratio, 1 / ratio) > 1.1 for ratio in ratios)

    @property
    def range_part(self) -> str:
        """The last part of the key of the range on the common scale."""
        return f"range{zlib.crc32(repr(self.common).encode()):08x}"


def common_limits(own: Mapping[str, Limits | None], groups: Mapping[str, int]) -> dict[int, Limits]:
    """Return the limits that suit all views of each group."""
    found: dict[int, list[Limits]] = {}
    for name, limits in own.items():
        if limits is not None:
            found.setdefault(groups.get(name, 0), []).append(limits)
    return {group: (min(near for near, _ in limits), max(far for _, far in limits)) for group, limits in found.items()}


def range_ticks(near: float, far: float) -> Ticks:
    """Return the ticks of a colour scale of ranges, spaced so that no two labels overlap."""
    found: list[tuple[float, float]] = []
    for value in scale_ticks(near, far):
        at = round(float(np.log(value / near) / np.log(far / near)), 4)
        if 0.02 < at < 0.98 and (not found or at - found[-1][0] >= 0.09):
            found.append((at, value))
    return tuple(found)


VERSION = 5  # raise it when the pictures change: earlier pages' are then drawn again
MAX_CARDS = 36
WIDTH = 768
MAX_BYTES = {"panorama": 75_000, "range": 55_000, "own_range": 50_000, "confidence": 35_000, "uncertainty": 45_000}
"""Largest size of each image, before base64 encoding."""

_PARTS = ("panorama", "range", "confidence")


@dataclass(frozen=True)
class ViewCard:
    """One view as the page shows it in full."""

    name: str
    # the available images among `panorama`, `range`, `confidence` and `uncertainty`
    pictures: Mapping[str, Picture]
    shares: Shares | None  # of the sphere, or None
    # (position on the colour scale from 0 to 1, range); the scale is common to all views of a group
    ticks: Ticks
    # the range on a scale of this view alone; None if that would look the same
    own_range: Picture | None = None
    own_ticks: Ticks = ()  # of that scale

    @property
    def has_uncertainty(self) -> bool:
        """Whether it shows the uncertainty of the ranges."""
        return "uncertainty" in self.pictures


def chosen_views(views: Sequence[ViewSummary], *, always: Collection[str] = ()) -> list[int]:
    """Return the positions of the views to show in full: all, or the least complete third and evenly spaced others.

    The views in `always` come first in that third, as far as there is room.
    """
    everything = list(range(len(views)))
    if len(views) <= MAX_CARDS:
        return everything
    quality = [(view.completeness or 0.0) + (view.consistent or 0.0) for view in views]
    by_quality = sorted(everything, key=lambda idx: (views[idx].name not in always, quality[idx], idx))
    worst, rest = by_quality[: MAX_CARDS // 3], sorted(by_quality[MAX_CARDS // 3 :])
    return sorted({*worst, *evenly_spaced(rest, MAX_CARDS - len(worst))})


def view_cards(
    out_dir: Path,
    views: Sequence[ViewSummary],
    results: StoredValues,
    *,
    kept: EarlierPage,
    groups: Mapping[str, int] | None = None,
) -> tuple[ViewCard, ...]:
    """Return the cards of views, reusing images of an earlier page that show the same values.

    Args:
        out_dir: the output folder, whose previews replace values that are not in the cache.
        groups: number of the group of each image; the views of a group share a colour scale, those of different groups
            do not, because their units of length differ. None: one group.
    """
    group_of = groups or {}
    with ThreadPoolExecutor(2) as pool:  # a large panorama takes 100 MB while it is decoded
        own = dict(
            zip(
                (view.name for view in views),
                pool.map(lambda view: _own_limits(results, kept, view.name), views),
                strict=True,
            )
        )
        common = common_limits(own, group_of)

        def card(view: ViewSummary) -> ViewCard:
            name = view.name
            scales = RangeScales(common.get(group_of.get(name, 0), (1.0, 2.0)), own[name])
            return _kept_card(results, kept, name, scales=scales) or _new_card(
                results, kept, view, out_dir=out_dir, scales=scales
            )

        return tuple(pool.map(card, views))


def key_of(results: StoredValues, name: str, what: str, *, version: int) -> str:
    """Return the key of an image derived from a view's panorama and range map; "" if it has no range map."""
    digest = results.digest("ranges", name)
    return f"{digest[:24]}.{results.digest('images', name)[:16]}.{what}{version}" if digest else ""


def _own_limits(results: StoredValues, kept: EarlierPage, name: str) -> Limits | None:
    """Return the limits of the colour scale of one view, rounded to four digits; None if it has no ranges."""
    key = key_of(results, name, "l", version=VERSION)
    fact = kept.fact(key) if key else None
    if fact is not None:
        return fact[0], fact[1]
    range_map = results.range_map(name)
    if range_map is None:
        return None
    small = narrowed(range_map.range, WIDTH)
    if not np.isfinite(small).any():
        return None
    near, far = (float(f"{limit:.4g}") for limit in range_limits(small))
    kept.keep(key, [near, far])
    return near, far


def _kept_card(results: StoredValues, kept: EarlierPage, name: str, *, scales: RangeScales) -> ViewCard | None:
    stem = key_of(results, name, "v", version=VERSION)
    fact = kept.fact(stem) if stem else None
    if fact is None:
        return None
    files = {part: scales.range_part if part == "range" else part for part in fact["parts"]}
    found = {part: shown for part, file in files.items() if (shown := kept.picture(f"{stem}.{file}")) is not None}
    own = kept.picture(f"{stem}.own") if scales.differ else None
    if len(found) < len(files) or (scales.differ and own is None):
        return None
    return _card(name, found, Shares(*fact["shares"]) if fact["shares"] else None, scales=scales, own_range=own)


def _card(
    name: str, pictures: Mapping[str, Picture], shares: Shares | None, *, scales: RangeScales, own_range: Picture | None
) -> ViewCard:
    ticks = range_ticks(*scales.common) if scales.own else ()
    own_ticks = range_ticks(*scales.own) if scales.own and own_range else ()
    return ViewCard(name, pictures, shares, ticks, own_range, own_ticks)


def _new_card(
    results: StoredValues, kept: EarlierPage, view: ViewSummary, *, out_dir: Path, scales: RangeScales
) -> ViewCard:
    name = view.name
    range_map, panorama = results.range_map(name), results.panorama(name)
    stem = key_of(results, name, "v", version=VERSION)
    pictures: dict[str, Picture] = {}
    shares, mask, own_range = None, None, None
    if panorama is not None:
        try:
            pictures["panorama"] = _part(panorama.load(), stem, "panorama")
            mask = panorama.load_mask()
        except InputError as error:
            results.notes.append(str(error))
    if range_map is not None:
        ranges, own_range = _range_pictures(range_map, stem, scales)
        pictures |= ranges
        kept_pixels = mask if mask is not None and mask.shape == range_map.range.shape else None
        if range_map.sky is not None:
            kept_pixels = ~range_map.sky if kept_pixels is None else kept_pixels & ~range_map.sky
        shares = shares_of(range_map.confidence, kept_pixels)
    if stem and all(part in pictures for part in _PARTS):  # a missing image may be available for the next page
        kept.keep(stem, {"shares": astuple(shares) if shares else None, "parts": list(pictures)})
    panels = () if all(part in pictures for part in _PARTS) else preview_panels(out_dir, view.preview)
    for part, panel in zip(_PARTS, panels, strict=False):
        pictures.setdefault(part, _part(panel, "", part))
    in_order = {part: pictures[part] for part in (*_PARTS, "uncertainty") if part in pictures}
    return _card(name, in_order, shares, scales=scales, own_range=own_range)


def _range_pictures(range_map: RangeMap, stem: str, scales: RangeScales) -> tuple[dict[str, Picture], Picture | None]:
    """Return the images of a range map, and its range on its own scale if that differs."""
    ranges, confidence = narrowed(range_map.range, WIDTH), narrowed(range_map.confidence, WIDTH)

    def colored(limits: Limits) -> NDArray[np.uint8]:
        return mark_unconfirmed(color_mapped(ranges, *limits), confidence)

    table = np.empty((256, 3), np.uint8)  # a hue for each class of confidences, brighter if higher
    table[0] = _INVALID
    for (low, high), dark, bright in _CLASSES:
        share = np.linspace(0, 1, high - low + 1)[:, None]
        table[low : high + 1] = np.rint((1 - share) * np.array(dark) + share * np.array(bright))
    pictures = {
        "range": _part(colored(scales.common), stem, "range", file=scales.range_part),
        "confidence": _part(table[confidence], stem, "confidence"),
    }
    if range_map.uncertainty is not None:
        uncertainty = narrowed(range_map.uncertainty, WIDTH).astype(np.float32)
        least, most = np.log(UNCERTAINTY_LIMITS)
        known = np.isfinite(uncertainty)
        steps = (np.log(np.where(known, uncertainty, 1).astype(np.float32)) - least) / (most - least)
        colors = cv2.applyColorMap(np.rint(255 * np.clip(steps, 0, 1)).astype(np.uint8), cv2.COLORMAP_CIVIDIS)
        rgb: NDArray[np.uint8] = cv2.cvtColor(colors, cv2.COLOR_BGR2RGB)
        rgb[~known] = _INVALID
        pictures["uncertainty"] = _part(rgb, stem, "uncertainty")
    differs = scales.own is not None and scales.differ
    own = _part(colored(scales.own), stem, "own_range", file="own") if differs and scales.own else None
    return pictures, own


def _part(image: NDArray[np.uint8], stem: str, part: str, *, file: str = "") -> Picture:
    key = f"{stem}.{file or part}" if stem else ""
    return picture(resized(image, WIDTH), width=WIDTH, most_bytes=MAX_BYTES[part], key=key)
