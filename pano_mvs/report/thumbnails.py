"""Small images of many views, from the previews in the output folder, and their shares of the sphere."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from pano_mvs.report.completeness import Shares, fact_of, shares_from_fact, shares_of
from pano_mvs.report.earlier_page import EarlierPage
from pano_mvs.report.view_cards import key_of
from pano_mvs.results.pictures import Picture, picture, preview_panels
from pano_mvs.results.records import ViewSummary
from pano_mvs.results.stored_values import StoredValues

MAX_THUMBNAILS = 1000
MAX_MEASURED = 1000
MAX_BYTES = 6_000
_WIDTH = 160
_THREADS = 2
_VERSION = 2


def thumbnails(
    out_dir: Path, views: Sequence[ViewSummary], results: StoredValues, *, kept: EarlierPage
) -> dict[str, Picture]:
    """Return small images of at most 1,000 evenly spaced views, by name."""
    chosen = [views[idx] for idx in _evenly(len(views), MAX_THUMBNAILS)]
    with ThreadPoolExecutor(_THREADS) as pool:
        found = pool.map(lambda view: _thumbnail(out_dir, view, results, kept=kept), chosen)
        return {view.name: small for view, small in zip(chosen, found, strict=True) if small is not None}


def measured_shares(views: Sequence[ViewSummary], results: StoredValues, kept: EarlierPage) -> dict[str, Shares]:
    """Return the shares of the sphere of at most 1,000 evenly spaced views, by name; the sky does not count."""
    found: dict[str, Shares] = {}
    for idx in _evenly(len(views), MAX_MEASURED):
        name = views[idx].name
        key = key_of(results, name, "s", version=_VERSION)
        shares = shares_from_fact(kept.fact(key)) if key else None
        if shares is None and key:
            confidence = results.confidence(name)
            sky = results.sky(name)
            shares = shares_of(confidence, None if sky is None else ~sky) if confidence is not None else None
            if shares is not None:
                kept.keep(key, fact_of(shares))
        if shares is not None:
            found[name] = shares
    return found


def _evenly(count: int, most: int) -> list[int]:
    return sorted({round(at) for at in np.linspace(0, count - 1, min(count, most))}) if count else []


def _thumbnail(out_dir: Path, view: ViewSummary, results: StoredValues, *, kept: EarlierPage) -> Picture | None:
    key = key_of(results, view.name, "t", version=_VERSION)
    known = kept.picture(key) if key else None
    if known is not None:
        return known
    panels = preview_panels(out_dir, view.preview, small=True)
    return picture(np.vstack(panels), width=_WIDTH, most_bytes=MAX_BYTES, key=key) if panels else None
