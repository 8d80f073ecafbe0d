"""A page that shows two runs side by side: what differs, and the range maps of both under a slider."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from numpy.typing import NDArray

from pano_mvs.io.images.preview import color_mapped, range_limits
from pano_mvs.results.pictures import evenly_spaced, picture
from pano_mvs_lineage.diff import RunDiff
from pano_mvs_lineage.range_changes import LIMIT, relative_difference, scales_of_views
from pano_mvs_lineage.stored_runs import StoredRun

_WIDTH, _MOST_BYTES, _MOST_VIEWS = 960, 120_000, 40


@dataclass(frozen=True)
class ViewPair:
    """The pictures of one view, as data URIs."""

    name: str
    before: str
    after: str
    difference: str  # where both have a range: white to red from 0 to 5 %, grey where one has none
    summary: str


def diff_page(found: RunDiff, *, cache: str | Path | None = None) -> str:
    """Return the page of a difference, one HTML file without references to others.

    At most 40 views are shown, those that changed most.
    """
    root = None if cache is None else Path(cache)
    old, new = StoredRun.open(found.before, root), StoredRun.open(found.after, root)
    changed = sorted(found.ranges, key=lambda one: (-one.changed, one.name))
    names = [one.name for one in changed[:_MOST_VIEWS]]
    if not names:
        names = evenly_spaced([name for name in old.output.views if name in new.output.views], 6)
    summaries = {one.name: str(one).partition(": ")[2] for one in changed}
    scales = scales_of_views(names, old, new)
    same = "the same ranges"
    views = [pair for name in names if (pair := _pair(name, old, new, scales[name], summaries.get(name, same)))]
    environment = Environment(
        loader=PackageLoader("pano_mvs_lineage", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    left_out = len(changed) - len(names) if changed else 0
    return environment.get_template("diff.html.j2").render(found=found, views=views, left_out=left_out)


def _pair(name: str, old: StoredRun, new: StoredRun, scale: float, summary: str) -> ViewPair | None:
    before, after = old.output.views[name].range_map, new.output.views[name].range_map
    if before is None or after is None:
        return None
    before = (scale * before).astype(np.float32)
    if after.shape != before.shape:
        after = cv2.resize(after, before.shape[::-1], interpolation=cv2.INTER_NEAREST).astype(np.float32)
    limits = range_limits(after)
    shown = [color_mapped(each, *limits) for each in (before, after)]
    shown.append(_error_colors(relative_difference(before, after)))
    one, other, difference = (picture(each, width=_WIDTH, most_bytes=_MOST_BYTES).uri for each in shown)
    return ViewPair(name, one, other, difference, summary)


def _error_colors(difference: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Return colours (H, W, 3): white to red from no difference to five times the limit, grey where there is none."""
    share = np.clip(np.nan_to_num(difference, nan=0.0) / (5 * LIMIT), 0, 1)[..., None]
    colors: NDArray[np.uint8] = np.rint((1 - share) * 255 + share * np.array([200, 20, 20])).astype(np.uint8)
    colors[~np.isfinite(difference)] = 128
    return colors
