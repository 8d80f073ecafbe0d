"""Small pictures of very many views, from the previews in the output folder, and their shares of the sphere."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from pano_mvs.report.completeness import Shares, fact_of, shares_from_fact, shares_of
from pano_mvs.report.earlier_page import EarlierPage
from pano_mvs.report.pictures import Picture, picture, preview_panels
from pano_mvs.report.view_cards import key_of
from pano_mvs.results.stored_values import StoredValues

MOST_THUMBNAILS = 1000
MOST_MEASURED = 1000
MOST_BYTES = 9_000
_WIDTH = 160
_THREADS = 2
_VERSION = 1


def thumbnails(
    out_dir: Path, views: Sequence[Mapping[str, Any]], results: StoredValues, kept: EarlierPage
) -> dict[str, Picture]:
    """Return image name to a small picture of its preview, of at most 1,000 views, evenly apart."""
    chosen = [views[idx] for idx in _evenly(len(views), MOST_THUMBNAILS)]
    with ThreadPoolExecutor(_THREADS) as pool:
        found = pool.map(lambda view: _thumbnail(out_dir, view, results, kept), chosen)
        return {str(view["name"]): small for view, small in zip(chosen, found, strict=True) if small is not None}


def measured_shares(views: Sequence[Mapping[str, Any]], results: StoredValues, kept: EarlierPage) -> dict[str, Shares]:
    """Return image name to its shares of the sphere, of at most 1,000 views, evenly apart; masks are not looked at."""
    found: dict[str, Shares] = {}
    for idx in _evenly(len(views), MOST_MEASURED):
        name = str(views[idx].get("name", ""))
        key = key_of(results, name, "s", _VERSION)
        shares = shares_from_fact(kept.fact(key)) if key else None
        if shares is None and key:
            confidence = results.confidence(name)
            shares = shares_of(confidence) if confidence is not None else None
            if shares is not None:
                kept.keep(key, fact_of(shares))
        if shares is not None:
            found[name] = shares
    return found


def _evenly(count: int, most: int) -> list[int]:
    return sorted({round(at) for at in np.linspace(0, count - 1, min(count, most))}) if count else []


def _thumbnail(out_dir: Path, view: Mapping[str, Any], results: StoredValues, kept: EarlierPage) -> Picture | None:
    key = key_of(results, str(view.get("name", "")), "t", _VERSION)
    known = kept.picture(key) if key else None
    if known is not None:
        return known
    panels = preview_panels(out_dir, str(view.get("preview") or ""), small=True)
    return picture(np.vstack(panels), width=_WIDTH, most_bytes=MOST_BYTES, key=key) if panels else None
