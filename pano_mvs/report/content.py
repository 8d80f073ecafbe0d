"""The content of the page, gathered from the summary, the cache and an earlier page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pano_mvs.report.advice import MAX_SUGGESTIONS, advice
from pano_mvs.report.camera_map import CameraMap, camera_maps, up_of
from pano_mvs.report.capture_facts import CaptureFacts, capture_facts
from pano_mvs.report.cloud_pictures import CloudPictures, cloud_pictures
from pano_mvs.report.cloud_points import TurnableCloud, turnable_cloud
from pano_mvs.report.completeness import Shares
from pano_mvs.report.earlier_page import EarlierPage
from pano_mvs.report.masked_areas import MaskedAreas, masked_areas
from pano_mvs.report.panorama_rows import Row, panorama_rows
from pano_mvs.report.thumbnails import measured_shares, thumbnails
from pano_mvs.report.view_cards import ViewCard, chosen_views, view_cards
from pano_mvs.results.figures import score_tables, side_by_side
from pano_mvs.results.next_time import Suggestion, marks_of
from pano_mvs.results.records import PairLink, PosesSummary, ScoresSummary, Verdict, ViewSummary
from pano_mvs.results.residuals import Histogram, Residuals, histogram, reprojection_residuals
from pano_mvs.results.stored_values import StoredValues
from pano_mvs.results.summary import RunSummary
from pano_mvs.results.verdict import verdict
from pano_mvs.scene.pairs_and_views import pair_name
from pano_mvs.scene.scores import NO_TRUTH

_MAX_REASONS = 300


@dataclass(frozen=True)
class Content:
    """The content of the page.

    Attributes:
        capture: what the report is about.
        verdict: the head of the page.
        advice: what to do next time, the most urgent first.
        groups: the poses of each group of cameras, the largest first.
        maps: the cameras of each group, from above and from the side.
        metric: images whose ranges are in metres.
        rejected_pairs: (first, second, candidates or None, reason) of pairs without a common geometry.
        pairs: number of compared pairs.
        cloud: pictures of the cloud.
        turnable: the cloud for the viewer in the page; None if there is none.
        cards: views shown in full.
        total_views: number of views.
        masked: what is masked in the panoramas.
        rows: one for each panorama.
        total_rows: number of panoramas.
        mean_shares: of the sphere, over all measured views.
        measured_views: number of these.
        residuals: of the points.
        pair_residuals: medians of the pairs' residuals.
        scores: (stage, tables) of each branch with scores.
        comparison: the medians of several branches side by side.
        notes: what could not be shown.
        facts: figures that the next page may reuse.
    """

    capture: CaptureFacts
    verdict: Verdict
    advice: tuple[Suggestion, ...]
    groups: tuple[PosesSummary, ...]
    maps: tuple[tuple[CameraMap, ...], ...]
    metric: frozenset[str]
    rejected_pairs: tuple[tuple[str, str, int | None, str], ...]
    pairs: int
    cloud: CloudPictures
    turnable: TurnableCloud | None
    cards: tuple[ViewCard, ...]
    total_views: int
    masked: MaskedAreas
    rows: tuple[Row, ...]
    total_rows: int
    mean_shares: Shares | None
    measured_views: int
    residuals: Residuals | None
    pair_residuals: Histogram | None
    scores: tuple[tuple[str, Mapping[str, Any]], ...]
    comparison: Mapping[str, Any]
    notes: tuple[str, ...]
    facts: Mapping[str, Any]


def gather(out_dir: Path, summary: RunSummary, values: StoredValues, *, earlier: EarlierPage) -> Content:
    """Return the content of the page; missing or damaged values are left out and named in the notes.

    Args:
        out_dir: the output folder.
        summary: of the run.
        values: the values of the run.
        earlier: the earlier page, whose images and figures are reused.
    """
    poses, views = summary.poses, summary.views
    groups = poses.by_group()
    rejected_pairs = _rejected_pairs(poses.links, values)
    reasons = {(first, second): why for first, second, _, why in rejected_pairs}
    record = values.poses
    residuals = reprojection_residuals(record) if record is not None else None
    chosen = [views[idx] for idx in chosen_views(views, always=poses.doubts)]
    group_of = {name: number for number, group in enumerate(groups) for name in group.registered}
    cards = view_cards(out_dir, chosen, values, kept=earlier, groups=group_of)
    shares = measured_shares(views, values, earlier) | {card.name: card.shares for card in cards if card.shares}
    rows = panorama_rows(
        summary, shares=shares, residuals=residuals, thumbnails=thumbnails(out_dir, views, values, kept=earlier)
    )
    known = {stage: scored for stage, scored in summary.scores_by_stage.items() if not _without_truth(scored)}
    scores = tuple((stage, score_tables(scored)) for stage, scored in known.items())
    total_rows = len({*poses.registered, *(view.name for view in views), *poses.rejected, *summary.rejected})
    judged = summary.model_copy(update={"views": tuple(_judged(view, shares) for view in views)})
    advised = advice(judged, values, earlier, chosen=[view.name for view in chosen])
    marked = advised[:MAX_SUGGESTIONS]
    return Content(
        capture=capture_facts(summary, values, panoramas=total_rows or len(values.refs.get("images", {}))),
        verdict=verdict(judged, residuals=residuals, image_width=_image_width(values)),
        advice=advised,
        groups=groups,
        maps=tuple(camera_maps(group, reasons, marks=marks_of(marked, number)) for number, group in enumerate(groups)),
        metric=frozenset(name for group in groups if group.metric for name in group.registered),
        rejected_pairs=rejected_pairs,
        pairs=len(poses.links),
        cloud=cloud_pictures(values, earlier, up=up_of(poses)),
        turnable=turnable_cloud(values, groups[0], earlier, up=up_of(poses)),
        cards=cards,
        total_views=len(views),
        masked=masked_areas(values, earlier),
        rows=rows,
        total_rows=total_rows,
        mean_shares=_mean(list(shares.values())),
        measured_views=len(shares),
        residuals=residuals,
        pair_residuals=histogram([link.residual_deg for link in poses.links if link.residual_deg is not None]),
        scores=scores,
        comparison=side_by_side(scores),
        notes=tuple(sorted(set(values.notes))),
        facts=earlier.facts,
    )


def _without_truth(scores: ScoresSummary) -> bool:
    """Return whether there is nothing to say but that nobody has a ground truth."""
    return not scores.poses and not scores.views and set(scores.notes) <= {NO_TRUTH}


def _rejected_pairs(links: Sequence[PairLink], values: StoredValues) -> tuple[tuple[str, str, int | None, str], ...]:
    """Return the pairs without inliers, those with the most candidates first, with reasons for the first 300."""
    rejected = sorted((link for link in links if not link.inliers), key=lambda link: -(link.candidates or 0))
    return tuple(
        (
            link.first,
            link.second,
            link.candidates,
            values.pair_reason(pair_name(link.first, link.second)) if idx < _MAX_REASONS else "",
        )
        for idx, link in enumerate(rejected)
    )


def _judged(view: ViewSummary, shares: Mapping[str, Shares]) -> ViewSummary:
    """Return a view with its shares of the unmasked sphere, if measured, instead of its shares of pixels."""
    own = shares.get(view.name)
    if own is None:
        return view
    measured = {"completeness": own.complete, "consistent": own.confirmed}
    return view.model_copy(update={"metrics": {**view.metrics, **measured}})


def _image_width(values: StoredValues) -> int | None:
    for name in values.refs.get("images", {}):
        panorama = values.panorama(name)
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
