"""One row for each panorama of the capture: its state, how much of it is known, how well its pose fits."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from pano_mvs.report.completeness import Shares
from pano_mvs.report.pictures import Picture
from pano_mvs.results.findings import doubts_of
from pano_mvs.results.residuals import Residuals

MOST_ROWS = 5000


@dataclass(frozen=True)
class Row:
    """One panorama.

    Attributes:
        name: of the image.
        registered: whether it has a pose; None if no stage made any.
        reason: why it was left out, "" if it was not.
        doubtful: why its pose is doubtful, "" if it is not.
        shares: of the sphere around it, if measured.
        completeness: share of pixels with a range, as its stage reported it, or None.
        consistent: share of pixels on which other views agree, likewise.
        links: number of pictures with which it has a common geometry.
        residual_deg: median reprojection residual, or None.
        p95_deg: 95 % of its residuals are smaller, or None.
        thumbnail: its preview, if there is one.
        group: number of its group, None where there is one group alone.
    """

    name: str
    registered: bool | None
    reason: str
    doubtful: str
    shares: Shares | None
    completeness: float | None
    consistent: float | None
    links: int
    residual_deg: float | None
    p95_deg: float | None
    thumbnail: Picture | None
    group: int | None = None

    @property
    def doubt(self) -> float:
        """What rows are sorted by, largest first: panoramas left out, doubtful ones, those of which least is known."""
        if self.reason or self.doubtful:
            return 4.0 if self.reason else 3.0
        known = (self.completeness or 0.0) + (self.consistent or 0.0)
        return round(2.0 - known, 4)


def panorama_rows(
    summary: Mapping[str, Any],
    *,
    shares: Mapping[str, Shares],
    residuals: Residuals | None,
    thumbnails: Mapping[str, Picture],
) -> tuple[Row, ...]:
    """Return the rows in the order of the capture, those left out behind; not more than 5,000.

    Args:
        summary: what run.json holds; every key may be missing.
        shares: image name to its shares of the sphere.
        residuals: of the points, if known.
        thumbnails: image name to its small picture.
    """
    poses, views = summary.get("poses") or {}, summary.get("views") or []
    registered = {str(name) for name in poses.get("registered") or []}
    rejected = {str(name): str(reason) for name, reason in (poses.get("rejected") or {}).items()}
    for name, told in (summary.get("rejected") or {}).items():
        rejected.setdefault(str(name), str(told.get("reason", "")))
    figures = {str(view.get("name", "")): view for view in views}
    links = Counter(
        name for first, second, inliers, *_ in poses.get("links") or [] if inliers for name in (first, second)
    )
    groups = poses.get("groups") or []
    group_of = {
        str(name): number for number, group in enumerate(groups) for name in group.get("images") or () if groups[1:]
    }
    doubts = doubts_of(summary)
    names = dict.fromkeys([*map(str, poses.get("registered") or []), *figures, *rejected, *doubts])
    rows = []
    for name in list(names)[:MOST_ROWS]:
        median, p95, _ = (residuals.views.get(name) if residuals else None) or (None, None, 0)
        view = figures.get(name, {})
        rows.append(
            Row(name, name in registered if poses else None, rejected.get(name, ""), doubts.get(name, ""),
                shares.get(name), _number(view.get("completeness")), _number(view.get("consistent")), links[name],
                median, p95, thumbnails.get(name), group_of.get(name))
        )  # fmt: skip
    return tuple(rows)


def _number(value: Any) -> float | None:
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None
