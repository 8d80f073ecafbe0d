"""The views that the page shows in full: panorama, range and confidence, stacked."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import InputError
from pano_mvs.io.images.preview import color_mapped, mark_unconfirmed, range_limits, scale_ticks
from pano_mvs.report.completeness import Shares, fact_of, shares_from_fact, shares_of
from pano_mvs.report.earlier_page import EarlierPage
from pano_mvs.results.pictures import Picture, picture, preview_panels, resized
from pano_mvs.results.records import ViewSummary
from pano_mvs.results.stored_values import StoredValues
from pano_mvs.scene.range_map import CONSISTENT_CONFIDENCE, FILLED_CONFIDENCE, WEAK_CONFIDENCE

VERSION = 3
"""Raise it when the pictures change: earlier pages' are then drawn again."""

MAX_CARDS = 36
WIDTH = 768
MAX_BYTES = 80_000
_TICKS_APART = 0.09
_DECODERS = 2  # a large panorama takes 100 MB while it is decoded
_PARTS = ("panorama", "range", "confidence")
# Relative standard deviations from this one (dark) to this one (bright), on a logarithmic scale.
UNCERTAINTY_LIMITS = 0.001, 0.2
# Colours of the low and high end of each class, distinguishable for colour-blind readers and in grey.
_CLASSES = (
    (FILLED_CONFIDENCE, (150, 95, 160), (196, 140, 204)),
    (WEAK_CONFIDENCE, (200, 130, 20), (245, 180, 60)),
    (CONSISTENT_CONFIDENCE, (10, 90, 110), (60, 190, 190)),
)
_INVALID = (96, 96, 96)


@dataclass(frozen=True)
class ViewCard:
    """One view as the page shows it in full.

    Attributes:
        name: of the image.
        pictures: the available images among `panorama`, `range`, `confidence` and `uncertainty`.
        shares: of the sphere, or None.
        ticks: (position on the colour scale from 0 to 1, range).
    """

    name: str
    pictures: Mapping[str, Picture]
    shares: Shares | None
    ticks: tuple[tuple[float, float], ...]


def chosen_views(views: Sequence[ViewSummary], most: int = MAX_CARDS, *, always: Collection[str] = ()) -> list[int]:
    """Return the positions of the views to show in full: all, or the least complete third and evenly spaced others.

    The views in `always` come first in that third, as far as there is room.
    """
    everything = list(range(len(views)))
    if len(views) <= most:
        return everything
    by_quality = sorted(everything, key=lambda idx: (views[idx].name not in always, _quality(views[idx]), idx))
    worst, rest = by_quality[: most // 3], sorted(by_quality[most // 3 :])
    evenly = [rest[round(at)] for at in np.linspace(0, len(rest) - 1, most - len(worst))]
    return sorted({*worst, *evenly})


def view_cards(
    out_dir: Path, views: Sequence[ViewSummary], results: StoredValues, *, kept: EarlierPage
) -> tuple[ViewCard, ...]:
    """Return the cards of views, reusing images of an earlier page that show the same values.

    Args:
        out_dir: the output folder, whose previews replace values that are not in the cache.
        views: of the run.
        results: the values.
        kept: the earlier page's.
    """

    def card(view: ViewSummary) -> ViewCard:
        name = view.name
        return _kept_card(results, kept, name) or _new_card(results, kept, name, out_dir=out_dir, preview=view.preview)

    with ThreadPoolExecutor(_DECODERS) as pool:
        return tuple(pool.map(card, views))


def confidence_colors(confidence: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return RGB colours (H, W, 3) of confidences (H, W): a hue per class, brighter if higher; invalid is grey."""
    table = np.empty((256, 3), np.uint8)
    table[0] = _INVALID
    for (low, high), dark, bright in _CLASSES:
        share = np.linspace(0, 1, high - low + 1)[:, None]
        table[low : high + 1] = np.rint((1 - share) * np.array(dark) + share * np.array(bright))
    return table[confidence]


def uncertainty_colors(uncertainty: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Return relative standard deviations (H, W) in colours (H, W, 3) RGB, from dark to bright; invalid is grey."""
    low, high = np.log(UNCERTAINTY_LIMITS)
    known = np.isfinite(uncertainty)
    share = (np.log(np.where(known, uncertainty, 1).astype(np.float32)) - low) / (high - low)
    colors = cv2.applyColorMap(np.rint(255 * np.clip(share, 0, 1)).astype(np.uint8), cv2.COLORMAP_CIVIDIS)
    rgb: NDArray[np.uint8] = cv2.cvtColor(colors, cv2.COLOR_BGR2RGB)
    rgb[~known] = _INVALID
    return rgb


def key_of(results: StoredValues, name: str, what: str, *, version: int) -> str:
    """Return the key of an image derived from a view's panorama and range map; "" if it has no range map."""
    digest = results.digest("ranges", name)
    return f"{digest[:24]}.{results.digest('images', name)[:16]}.{what}{version}" if digest else ""


def _quality(view: ViewSummary) -> float:
    return (view.completeness or 0.0) + (view.consistent or 0.0)


def _kept_card(results: StoredValues, kept: EarlierPage, name: str) -> ViewCard | None:
    stem = key_of(results, name, "v", version=VERSION)
    fact = kept.fact(stem) if stem else None
    parts = fact.get("parts") if isinstance(fact, dict) else None
    if not isinstance(fact, dict) or not isinstance(parts, list):
        return None
    found = {part: shown for part in parts if (shown := kept.picture(f"{stem}.{part}")) is not None}
    if len(found) < len(parts):
        return None
    try:
        ticks = tuple((float(at), float(value)) for at, value in fact["ticks"])
    except (KeyError, TypeError, ValueError):
        return None
    return ViewCard(name, found, shares_from_fact(fact.get("shares")), ticks)


def _new_card(results: StoredValues, kept: EarlierPage, name: str, *, out_dir: Path, preview: str) -> ViewCard:
    range_map, panorama = results.range_map(name), results.panorama(name)
    stem = key_of(results, name, "v", version=VERSION)
    pictures: dict[str, Picture] = {}
    shares, mask = None, None
    ticks: tuple[tuple[float, float], ...] = ()
    if panorama is not None:
        try:
            pictures["panorama"] = _part(panorama.load(), stem, "panorama")
            mask = panorama.load_mask()
        except InputError as error:
            results.notes.append(str(error))
    if range_map is not None:
        small = _shrunk(range_map.range)
        near, far = range_limits(small)
        confidence = _shrunk(range_map.confidence)
        pictures["range"] = _part(mark_unconfirmed(color_mapped(small, near, far), confidence), stem, "range")
        pictures["confidence"] = _part(confidence_colors(confidence), stem, "confidence")
        if range_map.uncertainty is not None:
            colors = uncertainty_colors(_shrunk(range_map.uncertainty.astype(np.float32)))
            pictures["uncertainty"] = _part(colors, stem, "uncertainty")
        fits = mask is not None and mask.shape == range_map.range.shape
        kept_pixels = mask if fits else None
        if range_map.sky is not None:
            kept_pixels = ~range_map.sky if kept_pixels is None else kept_pixels & ~range_map.sky
        shares = shares_of(range_map.confidence, kept_pixels)
        ticks = _ticks(near, far)
    if stem and all(part in pictures for part in _PARTS):  # a missing image may be available for the next page
        fact = {"ticks": ticks, "shares": fact_of(shares) if shares else None, "parts": list(pictures)}
        kept.keep(stem, fact)
    panels = () if all(part in pictures for part in _PARTS) else preview_panels(out_dir, preview)
    for part, panel in zip(_PARTS, panels, strict=False):
        pictures.setdefault(part, _part(panel, "", part))
    return ViewCard(
        name, {part: pictures[part] for part in (*_PARTS, "uncertainty") if part in pictures}, shares, ticks
    )


def _ticks(near: float, far: float) -> tuple[tuple[float, float], ...]:
    """Return the ticks of the scale of a range map, spaced so that no two labels overlap."""
    found: list[tuple[float, float]] = []
    for value in scale_ticks(near, far):
        at = round(float(np.log(value / near) / np.log(far / near)), 4)
        if 0.02 < at < 0.98 and (not found or at - found[-1][0] >= _TICKS_APART):
            found.append((at, value))
    return tuple(found)


def _part(image: NDArray[np.uint8], stem: str, part: str) -> Picture:
    return picture(resized(image, WIDTH), width=WIDTH, most_bytes=MAX_BYTES, key=f"{stem}.{part}" if stem else "")


def _shrunk(array: NDArray[Any]) -> NDArray[Any]:
    """Return a map at its displayed size, without mixing values."""
    if array.shape[1] <= WIDTH:
        return np.ascontiguousarray(array)
    size = WIDTH, round(array.shape[0] * WIDTH / array.shape[1])
    return np.asarray(cv2.resize(np.ascontiguousarray(array), size, interpolation=cv2.INTER_NEAREST))
