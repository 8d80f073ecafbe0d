"""The views that the page shows in full: panorama, range and confidence, one over the other."""

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
from pano_mvs.io.images.preview import color_mapped, range_limits, scale_ticks
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
# Confidence in colours that are apart for colour-blind eyes and in grey: low and high end of each class.
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
        pictures: what is shown → its picture: of `panorama`, `range`, `confidence` those that could be had.
        shares: of the sphere, or None.
        ticks: (share of the scale from near to far, range) of the colours of the range map.
    """

    name: str
    pictures: Mapping[str, Picture]
    shares: Shares | None
    ticks: tuple[tuple[float, float], ...]


def chosen_views(views: Sequence[ViewSummary], most: int = MAX_CARDS, *, always: Collection[str] = ()) -> list[int]:
    """Return the positions of the views to show in full: all; of many, the least complete third and others evenly.

    The views named in `always` come first in that third, as far as there is room.
    """
    everything = list(range(len(views)))
    if len(views) <= most:
        return everything
    by_quality = sorted(everything, key=lambda idx: (views[idx].name not in always, _quality(views[idx]), idx))
    worst, rest = by_quality[: most // 3], sorted(by_quality[most // 3 :])
    evenly = [rest[round(at)] for at in np.linspace(0, len(rest) - 1, most - len(worst))]
    return sorted({*worst, *evenly})


def view_cards(
    out_dir: Path, views: Sequence[ViewSummary], results: StoredValues, kept: EarlierPage
) -> tuple[ViewCard, ...]:
    """Return the cards of views; what an earlier page shows of the same values is taken from there.

    Args:
        out_dir: the output folder, for previews that stand in for what is not in the store.
        views: of the run.
        results: the values.
        kept: the earlier page's.
    """

    def card(view: ViewSummary) -> ViewCard:
        name = view.name
        return _kept_card(results, kept, name) or _new_card(results, kept, name, out_dir, view.preview)

    with ThreadPoolExecutor(_DECODERS) as pool:
        return tuple(pool.map(card, views))


def confidence_colors(confidence: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return confidence (H, W) in colours (H, W, 3) RGB: by class, brighter with more of it; invalid is grey."""
    table = np.empty((256, 3), np.uint8)
    table[0] = _INVALID
    for (low, high), dark, bright in _CLASSES:
        share = np.linspace(0, 1, high - low + 1)[:, None]
        table[low : high + 1] = np.rint((1 - share) * np.array(dark) + share * np.array(bright))
    return table[confidence]


def key_of(results: StoredValues, name: str, what: str, version: int) -> str:
    """Return the key of something that is made from a view's panorama and range map; "" if it has no range map."""
    digest = results.digest("ranges", name)
    return f"{digest[:24]}.{results.digest('images', name)[:16]}.{what}{version}" if digest else ""


def _quality(view: ViewSummary) -> float:
    return (view.completeness or 0.0) + (view.consistent or 0.0)


def _kept_card(results: StoredValues, kept: EarlierPage, name: str) -> ViewCard | None:
    stem = key_of(results, name, "v", VERSION)
    fact = kept.fact(stem) if stem else None
    found = {part: shown for part in _PARTS if (shown := kept.picture(f"{stem}.{part}")) is not None}
    if not isinstance(fact, dict) or len(found) < len(_PARTS):
        return None
    try:
        ticks = tuple((float(at), float(value)) for at, value in fact["ticks"])
    except (KeyError, TypeError, ValueError):
        return None
    return ViewCard(name, found, shares_from_fact(fact.get("shares")), ticks)


def _new_card(results: StoredValues, kept: EarlierPage, name: str, out_dir: Path, preview: str) -> ViewCard:
    range_map, panorama = results.range_map(name), results.panorama(name)
    stem = key_of(results, name, "v", VERSION)
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
        pictures["range"] = _part(color_mapped(small, near, far), stem, "range")
        pictures["confidence"] = _part(confidence_colors(_shrunk(range_map.confidence)), stem, "confidence")
        fits = mask is not None and mask.shape == range_map.range.shape
        kept_pixels = mask if fits else None
        if range_map.sky is not None:
            kept_pixels = ~range_map.sky if kept_pixels is None else kept_pixels & ~range_map.sky
        shares = shares_of(range_map.confidence, kept_pixels)
        ticks = _ticks(near, far)
    if stem and len(pictures) == len(_PARTS):  # what is missing may be back for the next page
        kept.keep(stem, {"ticks": ticks, "shares": fact_of(shares) if shares else None})
    panels = preview_panels(out_dir, preview) if len(pictures) < len(_PARTS) else ()
    for part, panel in zip(_PARTS, panels, strict=False):
        pictures.setdefault(part, _part(panel, "", part))
    return ViewCard(name, {part: pictures[part] for part in _PARTS if part in pictures}, shares, ticks)


def _ticks(near: float, far: float) -> tuple[tuple[float, float], ...]:
    """Return where on the scale of a range map which ranges are written, so that no two overlap."""
    found: list[tuple[float, float]] = []
    for value in scale_ticks(near, far):
        at = round(float(np.log(value / near) / np.log(far / near)), 4)
        if 0.02 < at < 0.98 and (not found or at - found[-1][0] >= _TICKS_APART):
            found.append((at, value))
    return tuple(found)


def _part(image: NDArray[np.uint8], stem: str, part: str) -> Picture:
    return picture(resized(image, WIDTH), width=WIDTH, most_bytes=MAX_BYTES, key=f"{stem}.{part}" if stem else "")


def _shrunk(array: NDArray[Any]) -> NDArray[Any]:
    """Return a map at the size at which it is shown, no value of which is a mixture of others."""
    if array.shape[1] <= WIDTH:
        return np.ascontiguousarray(array)
    size = WIDTH, round(array.shape[0] * WIDTH / array.shape[1])
    return np.asarray(cv2.resize(np.ascontiguousarray(array), size, interpolation=cv2.INTER_NEAREST))
