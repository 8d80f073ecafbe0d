"""Rows of the report's table of panoramas: state, shares of the sphere, links and residuals."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

from pano_mvs.report.completeness import Shares
from pano_mvs.results.pictures import Picture
from pano_mvs.results.records import ViewSummary
from pano_mvs.results.residuals import Residuals
from pano_mvs.results.summary import RunSummary

MAX_ROWS = 5000


@dataclass(frozen=True)
class Row:
    """One panorama.

    Attributes:
        name: of the image.
        registered: whether it has a pose; None if no stage computed poses.
        reason: why it was left out, or "".
        doubtful: why its pose is doubtful, or "".
        shares: of the sphere around it, if measured.
        completeness: share of pixels with a range, as its stage reported it, or None.
        consistent: share of pixels on which other views agree, likewise.
        links: number of images with which it has a common geometry.
        residual_deg: median reprojection residual, or None.
        p95_deg: 95 % of its residuals are smaller, or None.
        thumbnail: its preview, or None.
        group: number of its group; None if there is only one group.
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
        """Sort key, largest first: panoramas left out, doubtful ones, then those with the smallest shares."""
        if self.reason or self.doubtful:
            return 4.0 if self.reason else 3.0
        known = (self.completeness or 0.0) + (self.consistent or 0.0)
        return round(2.0 - known, 4)


def panorama_rows(
    summary: RunSummary,
    *,
    shares: Mapping[str, Shares],
    residuals: Residuals | None,
    thumbnails: Mapping[str, Picture],
) -> tuple[Row, ...]:
    """Return at most 5,000 rows in the order of the capture, followed by images that were left out.

    Args:
        summary: of the run.
        shares: image name to its shares of the sphere.
        residuals: of the points, if known.
        thumbnails: image name to its small picture.
    """
    poses = summary.poses
    registered = set(poses.registered)
    rejected = {name: rejection.reason for name, rejection in summary.rejected.items()} | dict(poses.rejected)
    figures = {view.name: view for view in summary.views}
    links = Counter(name for link in poses.links if link.inliers for name in link[:2])
    group_of = {name: number for number, group in enumerate(poses.groups) for name in group.images if poses.groups[1:]}
    doubts = summary.doubtful_images
    order = [*poses.registered, *figures, *poses.rejected, *summary.rejected, *doubts]
    rows = []
    for name in list(dict.fromkeys(order))[:MAX_ROWS]:
        median, p95, _ = (residuals.views.get(name) if residuals else None) or (None, None, 0)
        view = figures.get(name, ViewSummary())
        rows.append(
            Row(
                name,
                name in registered if poses else None,
                rejected.get(name, ""),
                doubts.get(name, ""),
                shares.get(name),
                view.completeness,
                view.consistent,
                links[name],
                median,
                p95,
                thumbnails.get(name),
                group_of.get(name),
            )
        )
    return tuple(rows)
