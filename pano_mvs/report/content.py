"""Everything that the page shows of a run's results, gathered from the summary, the store and an earlier page."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pano_mvs.report.camera_map import CameraMap, camera_maps, up_of
from pano_mvs.report.cloud_pictures import CloudPictures, cloud_pictures
from pano_mvs.report.completeness import Shares
from pano_mvs.report.earlier_page import EarlierPage
from pano_mvs.report.panoramas import Row, panorama_rows
from pano_mvs.report.thumbnails import measured_shares, thumbnails
from pano_mvs.report.view_cards import ViewCard, chosen_views, view_cards
from pano_mvs.results.figures import score_tables, side_by_side
from pano_mvs.results.findings import scores_by_stage
from pano_mvs.results.residuals import Histogram, Residuals, histogram, reprojection_residuals
from pano_mvs.results.stored_values import StoredValues
from pano_mvs.results.verdict import Verdict, verdict
from pano_mvs.scene.index import pair_name

_MOST_REASONS = 300
_NO_POSES: Mapping[str, Any] = {"registered": [], "rejected": {}, "doubts": {}, "confirmed": {}, "centers": [],
                                "links": [], "frame": "", "scale": "", "metric": False}  # fmt: skip


@dataclass(frozen=True)
class Content:
    """What the page shows.

    Attributes:
        verdict: the head of the page.
        poses: as in run.json, without gaps.
        groups: of poses, as in run.json; one where it is silent of them.
        maps: the cameras of each group, from above and from the side.
        metric: images whose ranges are in metres.
        rejected_pairs: (first, second, candidates or None, reason) of pairs without a common geometry.
        pairs: number of pairs that were looked at.
        cloud: pictures of the cloud.
        cards: views shown in full.
        total_views: number of views.
        rows: one for each panorama.
        total_rows: number of panoramas.
        mean_shares: of the sphere, over all measured views.
        residuals: of the points.
        pair_residuals: medians of the pairs' residuals.
        scores: (stage, tables) of each branch that has some.
        comparison: the medians of several branches side by side.
        notes: what could not be shown.
    """

    verdict: Verdict
    poses: Mapping[str, Any]
    groups: tuple[Mapping[str, Any], ...]
    maps: tuple[tuple[CameraMap, ...], ...]
    metric: frozenset[str]
    rejected_pairs: tuple[tuple[str, str, int | None, str], ...]
    pairs: int
    cloud: CloudPictures
    cards: tuple[ViewCard, ...]
    total_views: int
    rows: tuple[Row, ...]
    total_rows: int
    mean_shares: Shares | None
    residuals: Residuals | None
    pair_residuals: Histogram | None
    scores: tuple[tuple[str, Mapping[str, Any]], ...]
    comparison: Mapping[str, Any]
    notes: tuple[str, ...]


def gather(out_dir: Path, summary: Mapping[str, Any], results: StoredValues, kept: EarlierPage) -> Content:
    """Return what the page shows; what is missing or damaged is left out and told.

    Args:
        out_dir: the output folder.
        summary: what run.json holds; every key may be missing.
        results: the values behind it.
        kept: the earlier page's pictures and figures; those that go on are marked.
    """
    known = dict(summary.get("poses") or {})
    poses = {name: known.get(name) or empty for name, empty in _NO_POSES.items()} | {"up": known.get("up")}
    views = summary.get("views") or []
    links = poses["links"]
    groups = pose_groups(poses | {"groups": known.get("groups")})
    rejected_pairs = _rejected_pairs(links, results)
    record = results.poses
    residuals = reprojection_residuals(record) if record is not None else None
    cards = view_cards(out_dir, [views[idx] for idx in chosen_views(views, always=poses["doubts"])], results, kept)
    shares = measured_shares(views, results, kept) | {card.name: card.shares for card in cards if card.shares}
    rows = panorama_rows(summary, shares=shares, residuals=residuals,
                         thumbnails=thumbnails(out_dir, views, results, kept))  # fmt: skip
    scores = tuple((stage, score_tables(scored)) for stage, scored in scores_by_stage(summary).items())
    judged = dict(summary) | {"views": [_judged(view, shares) for view in views]}
    return Content(
        verdict=verdict(judged, residuals=residuals, image_width=_image_width(results)),
        poses=poses,
        groups=groups,
        maps=tuple(
            camera_maps(group, {(first, second): why for first, second, _, why in rejected_pairs}) for group in groups
        ),
        metric=frozenset(str(name) for group in groups if group["metric"] for name in group["registered"]),
        rejected_pairs=rejected_pairs,
        pairs=len(links),
        cloud=cloud_pictures(results, kept, up=up_of(poses)),
        cards=cards,
        total_views=len(views),
        rows=rows,
        total_rows=len({*map(str, poses["registered"]), *(str(view.get("name", "")) for view in views),
                        *map(str, poses["rejected"]), *map(str, summary.get("rejected") or {})}),
        mean_shares=_mean(list(shares.values())),
        residuals=residuals,
        pair_residuals=histogram([link[4] for link in links if len(link) > 4 and link[4] is not None]),
        scores=scores,
        comparison=side_by_side(scores),
        notes=tuple(sorted(set(results.notes))),
    )  # fmt: skip


def pose_groups(poses: Mapping[str, Any]) -> tuple[Mapping[str, Any], ...]:
    """Return the groups of poses, each as the poses of a run that has one group alone.

    Args:
        poses: as in run.json, without gaps; where it names no groups, or one, it is returned as it is.
    """
    groups = poses.get("groups") or []
    if len(groups) < 2:
        return (poses,)
    centers = dict(zip(map(str, poses["registered"]), poses["centers"], strict=False))
    found = []
    for group in groups:
        names = dict.fromkeys(str(name) for name in group.get("images") or [])
        found.append({
            "registered": list(names),
            "centers": [centers[name] for name in names if name in centers],
            "links": [link for link in poses["links"] if link[0] in names and link[1] in names],
            "frame": group.get("frame", ""), "scale": group.get("scale", ""), "metric": group.get("metric", False),
            "doubts": {name: poses["doubts"][name] for name in names if name in poses["doubts"]},
            "up": group.get("up"), "points": group.get("points"), "nearest_pair": group.get("nearest_pair"),
        })  # fmt: skip
    return tuple(found)


def _rejected_pairs(links: Any, results: StoredValues) -> tuple[tuple[str, str, int | None, str], ...]:
    """Return the pairs without inliers, those with most candidates first, and why, of the first 300."""
    rejected = [(str(first), str(second), more[0] if more else None) for first, second, inliers, *more in links
                if not inliers]  # fmt: skip
    rejected.sort(key=lambda pair: -(pair[2] or 0))
    return tuple(
        (first, second, candidates, results.pair_reason(pair_name(first, second)) if idx < _MOST_REASONS else "")
        for idx, (first, second, candidates) in enumerate(rejected)
    )


def _judged(view: Mapping[str, Any], shares: Mapping[str, Shares]) -> dict[str, Any]:
    """Return a view with its shares of the unmasked sphere, where they were measured, in place of its pixels'."""
    own = shares.get(str(view.get("name", "")))
    return dict(view) | ({"completeness": own.complete, "consistent": own.confirmed} if own else {})


def _image_width(results: StoredValues) -> int | None:
    for name in results.refs.get("images", {}):
        panorama = results.panorama(name)
        return panorama.size_hw[1] if panorama is not None else None
    return None


def _mean(shares: list[Shares]) -> Shares | None:
    if not shares:
        return None
    count = len(shares)
    return Shares(
        consistent=sum(one.consistent for one in shares) / count,
        weak=sum(one.weak for one in shares) / count,
        filled=sum(one.filled for one in shares) / count,
        invalid=sum(one.invalid for one in shares) / count,
        masked=sum(one.masked for one in shares) / count,
    )
